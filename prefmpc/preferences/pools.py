"""Random weights, random states, and the pools of closed loops that people compare."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    finite_array,
    instance,
    leading_shape,
    nonnegative,
    positive_int,
    require_x64,
    sequence,
    single,
)
from prefmpc._matrices import psd_matrix
from prefmpc._random import generator
from prefmpc.preferences.trajectories import Trajectory, rollout
from prefmpc.systems.linear import LinearSystem


def random_weights(
    nx: int,
    nu: int,
    *,
    key: Any,
    shape: tuple[int, ...] = (),
    low: float = 0.1,
    high: float = 10.0,
    coupling: float = 0.1,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw predominantly diagonal weights Q ``(*shape, nx, nx)`` and R ``(*shape, nu, nu)``.

    Each is MᵀM/2 + diag(U[low, high]) with M = ``coupling`` · standard normal. The paper (section
    III-A) says "predominantly diagonal, with diagonal elements in [0.1, 10]" and no more; this
    reading gives its row "Random" of Table I.
    """
    require_x64()
    nx, nu = positive_int("nx", nx), positive_int("nu", nu)
    if not 0 < nonnegative("low", low) < nonnegative("high", high):
        raise ValueError(f"low and high must satisfy 0 < low < high, got {low} and {high}")
    coupling, shape = nonnegative("coupling", coupling), leading_shape("shape", shape)
    rng = generator(key)

    def draw(n: int) -> np.ndarray:
        M = coupling * rng.standard_normal((*shape, n, n))
        d = rng.uniform(low, high, (*shape, n))
        return np.swapaxes(M, -1, -2) @ M / 2 + d[..., None] * np.eye(n)

    return draw(nx), draw(nu)


def random_states(radius: ArrayLike, *, key: Any, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Draw states ``(*shape, nx)``, each entry uniform in [−radius, radius]; radius is (nx,)."""
    radius = np.asarray(finite_array("radius", radius, ndim=1))
    if not radius.size or (radius < 0).any():
        raise ValueError(f"radius must not be negative or empty, got {radius}")
    shape = leading_shape("shape", shape)
    return generator(key).uniform(-1.0, 1.0, (*shape, radius.size)) * radius


def lqr_pool(
    system: LinearSystem,
    size: int,
    steps: int,
    *,
    key: Any,
    radius: ArrayLike | None = None,
    x0: ArrayLike | None = None,
    weights: tuple[ArrayLike, ArrayLike] | None = None,
    saturate: bool = True,
) -> Trajectory:
    """Simulate ``size`` closed loops, each with its own random x(0) and its own random LQR.

    This is how the paper (section III-A) makes the trajectories that people compare, but for one
    thing: the inputs keep the limits of ``system`` unless ``saturate`` is False.

    Parameters
    ----------
    radius : array (nx,)
        x(0) is uniform in [−radius, radius].
    x0 : array (size, nx)
        Initial states of your own, instead of ``radius``: give some of them several times to
        compare trajectories with the same x(0).
    weights : (Q, R), optional
        Stacks (size, nx, nx) and (size, nu, nu) of LQR weights; default: `random_weights`.
    saturate : bool
        Apply u = clip(−K x, u_min, u_max), so that people compare what the plant can do. From a
        far x(0) an unstable plant may then escape. False: u = −K x beyond the limits too; the
        paper mentions no limits here, and its results are reproduced without.

    Returns
    -------
    Trajectory
        With leading dimension ``size``.
    """
    instance("system", system, LinearSystem)
    single("system", system)
    size = positive_int("size", size)
    rng = generator(key)
    if (radius is None) == (x0 is None):
        raise ValueError("radius or x0 must be given, and not both of them")
    if weights is None:
        Q, R = random_weights(system.nx, system.nu, key=rng, shape=(size,))
    else:
        Q, R = _stacks(weights, size, system)
    if x0 is None:
        starts = random_states(radius, key=rng, shape=(size,))  # type: ignore[arg-type]
        if starts.shape[-1] != system.nx:
            raise ValueError(f"radius must have shape ({system.nx},), got {starts.shape[1:]}")
    else:
        starts = finite_array("x0", x0)
        if starts.shape != (size, system.nx):
            raise ValueError(f"x0 must have shape {(size, system.nx)}, got {starts.shape}")
    gains = np.stack([system.lqr(q, r)[0] for q, r in zip(Q, R, strict=True)])
    return rollout(system, starts, gains, steps, saturate=saturate)


def _stacks(weights: Any, size: int, system: LinearSystem) -> list[np.ndarray]:
    """Return Q (size, nx, nx) and R (size, nu, nu), or raise a ValueError."""
    given = sequence("weights", weights)
    if len(given) != 2:
        raise ValueError(f"weights must be (Q, R), got {len(given)} entries")
    out = []
    for i, n in enumerate((system.nx, system.nu)):
        stack = psd_matrix(f"weights[{i}]", given[i], definite=i == 1)
        if stack.shape != (size, n, n):
            raise ValueError(f"weights[{i}] must have shape {(size, n, n)}, got {stack.shape}")
        out.append(stack)
    return out


def pairs_from_one_start(
    trajectories: Trajectory, size: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random pairs, first and second (size,), of trajectories (n_t,) with the same x(0)."""
    _, group = np.unique(np.asarray(trajectories.x[:, 0]), axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    count = np.bincount(group)
    begin = np.cumsum(count) - count
    place = np.argsort(order) - begin[group]  # of each trajectory among those with its start
    candidates = np.flatnonzero(count[group] > 1)
    if not candidates.size:
        raise ValueError(
            "trajectories must hold two with the same x(0) for same_start=True, "
            f"all {order.size} start in different states"
        )
    first = rng.choice(candidates, size)
    mates = count[group[first]]
    gap = 1 + rng.integers(0, mates - 1)
    return first, order[begin[group[first]] + (place[first] + gap) % mates]
