"""Where questions come from: x(0), closed loops of posterior samples, or a pool of recordings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from prefmpc._checks import finite_array, function, instance
from prefmpc.asking.loops import Loops, finite_loops
from prefmpc.asking.questions import pairs_of
from prefmpc.preferences.pools import random_states
from prefmpc.preferences.trajectories import Trajectory, failed
from prefmpc.systems.sets import Polyhedron

MOST_PAIRS = 4000


class States:
    """x(0) of a system: from a box, of a list, or from a function of the user's.

    Parameters
    ----------
    x0 : array (nx,), array (m, nx), or function
        Half-widths of a box about the origin; a list to choose from; or (generator, n) ↦ (n, nx).
    nx : int
    constraints : Polyhedron, optional
        Over (x, u): each x(0) must keep those of its rows that are about x alone.
    """

    def __init__(self, x0: Any, nx: int, constraints: Polyhedron | None) -> None:
        self._rows = None
        if constraints is not None:
            about_x = (constraints.H[:, nx:] == 0).all(axis=1)
            self._rows = Polyhedron(constraints.H[about_x][:, :nx], constraints.h[about_x])
        self.given: Any
        if callable(x0):
            function("x0", x0, 2)
            self.given = x0
        else:
            self.given = np.asarray(finite_array("x0", x0))
            if self.given.ndim not in (1, 2) or self.given.shape[-1] != nx or not self.given.size:
                raise ValueError(
                    f"x0 must be a radius ({nx},), a list of states (m, {nx}) or a function, "
                    f"got shape {self.given.shape}"
                )
            if self.given.ndim == 1 and (self.given < 0).any():
                raise ValueError(f"x0 must not be negative if it is a radius, got {self.given}")
            self._inside(self.given if self.given.ndim == 2 else np.diag(self.given))
        self.nx = nx

    def size(self) -> np.ndarray | None:
        """Return the largest deviation (nx,) of each state, None for a function."""
        return None if callable(self.given) else np.abs(np.atleast_2d(self.given)).max(axis=0)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return x(0) (count, nx), or all of a shorter list."""
        if callable(self.given):
            states = np.asarray(finite_array("what x0 returns", self.given(rng, count)))
            if states.shape != (count, self.nx):
                raise ValueError(f"x0 must return shape ({count}, {self.nx}), got {states.shape}")
        elif self.given.ndim == 1:
            states = random_states(self.given, key=rng, shape=(count,))
        elif len(self.given) <= count:
            states = self.given
        else:
            states = self.given[np.sort(rng.choice(len(self.given), count, replace=False))]
        self._inside(states)
        return states

    def _inside(self, states: np.ndarray) -> None:
        if self._rows is not None and not (good := self._rows.contains(states)).all():
            bad = states[np.argmin(good)]
            raise ValueError(f"x0 must lie within the constraints, got {bad}")


class Shown:
    """Trajectories to choose from: (M,) of them, in pairs (2, n), and whose loops they are."""

    def __init__(
        self, trajectories: Trajectory, start: np.ndarray, source: np.ndarray, pairs: np.ndarray
    ) -> None:
        self.trajectories, self.start, self.source, self.pairs = trajectories, start, source, pairs


def loops_shown(loops: Loops, models: Any, x0: np.ndarray, rng: np.random.Generator) -> Shown:
    """Return the closed loops of c models from m states, in pairs from one x(0)."""
    runs = loops(models, x0)
    good = finite_loops(runs)
    source, start = np.nonzero(good)
    trajectories = jax.tree.map(lambda leaf: np.asarray(leaf)[good], runs)
    return Shown(trajectories, start, source, pairs_of(start, rng, MOST_PAIRS))


def pool_shown(pool: Trajectory, rng: np.random.Generator) -> Shown:
    """Return the recordings of a pool in pairs, from one x(0) if there are such."""
    starts = np.asarray(pool.x)[:, 0]
    _, start = np.unique(starts, axis=0, return_inverse=True)
    pairs = pairs_of(start, rng, MOST_PAIRS)
    return Shown(pool, start, np.full(len(pool), -1), pairs)


def check_pool(pool: Any) -> Trajectory:
    """Return a pool of at least two finite recordings as NumPy arrays, or raise a ValueError."""
    instance("pool", pool, Trajectory)
    if len(pool.batch_shape) != 1 or len(pool) < 2:
        raise ValueError(
            "pool must hold at least two trajectories along one axis, "
            f"got batch shape {pool.batch_shape}"
        )
    if failed(pool).any():
        raise ValueError(f"pool must be finite, got {int(failed(pool).sum())} with NaN")
    return jax.tree.map(np.asarray, pool)


Pool = Trajectory | Callable[[np.random.Generator], Trajectory]
