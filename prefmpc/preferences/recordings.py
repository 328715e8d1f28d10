"""Recordings that do not last equally long: σ sums over the steps that each of them has."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import flag, function, indices, instances
from prefmpc._pytree import register_pytree, set_fields
from prefmpc.preferences.trajectories import Trajectory, check_finite


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Recordings:
    """Trajectories of one plant, of any lengths, in the order in which they are given.

    Nothing is padded: those that last equally long are kept as one batch.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Single ones, or batches with one leading dimension.
    per_step : bool
        σ of a recording is then the mean over its steps, σ / N, instead of the sum: else a long
        recording costs more than a short one that is as good at every step.

    Raises
    ------
    ValueError
        If there is none, one holds NaN, or the numbers of states, inputs or outputs differ, or
        one has a set point or an input before u_0 where another has none.
    """

    parts: tuple[Trajectory, ...]
    """One batch for each length."""
    order: np.ndarray
    """(n,): place of each recording in the batches, one after the other."""
    per_step: bool = False

    def __init__(self, trajectories: Sequence[Trajectory], *, per_step: bool = False) -> None:
        given = instances("trajectories", trajectories, Trajectory)
        for i, one in enumerate(given):
            if len(one.batch_shape) > 1:
                raise ValueError(
                    f"trajectories[{i}] must be one or a batch, got shape {one.batch_shape}"
                )
            _alike(i, one, given[0])
        batches = [
            one if one.batch_shape else jax.tree.map(lambda leaf: np.asarray(leaf)[None], one)
            for one in given
        ]
        for i, one in enumerate(batches):
            check_finite(f"trajectories[{i}]", one, "closed loops that failed?")
        lengths = np.array([one.horizon for one in batches])
        sizes = np.array([len(one) for one in batches])
        each = np.repeat(lengths, sizes)
        parts = tuple(
            jax.tree.map(
                lambda *leaves: np.concatenate(leaves),
                *(b for b, n in zip(batches, lengths, strict=True) if n == length),
            )
            for length in np.unique(lengths)
        )
        order = np.argsort(np.argsort(each, kind="stable"), kind="stable")
        set_fields(self, parts=parts, order=order, per_step=flag("per_step", per_step))

    def __len__(self) -> int:
        """Number of recordings n."""
        return len(self.order)

    @property
    def horizons(self) -> np.ndarray:
        """Number of steps N of each recording (n,)."""
        each = [np.full(len(part), part.horizon) for part in self.parts]
        return np.concatenate(each)[self.order]

    def __getitem__(self, index: Any) -> Any:
        """Return one recording, a Trajectory, for a whole number; else `Recordings`."""
        if isinstance(index, int | np.integer):
            if not -len(self) <= index < len(self):
                raise IndexError(f"index must lie in [{-len(self)}, {len(self) - 1}], got {index}")
            place = int(self.order[index])
            for part in self.parts:
                if place < len(part):
                    return part[place]
                place -= len(part)
        chosen = np.arange(len(self))[
            index if isinstance(index, slice) else indices("index", index)
        ]
        if chosen.ndim != 1 or not chosen.size:
            raise IndexError(f"index must choose recordings in one dimension, got {index}")
        return Recordings([self[int(i)] for i in chosen], per_step=self.per_step)

    def apply(self, measure: Callable[[Trajectory], ArrayLike]) -> Any:
        """Return a function of a batch, such as σ, of every recording (n, ...).

        Divided by the number of steps if ``per_step``. The function may return a tree of arrays.
        """
        function("measure", measure, 1)
        values = [
            jax.tree.map(lambda leaf, n=part.horizon: np.asarray(leaf) / n, measure(part))
            if self.per_step
            else measure(part)
            for part in self.parts
        ]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[self.order], *values)


register_pytree(Recordings, static=("per_step",))


def _alike(i: int, one: Trajectory, model: Trajectory, name_of: str = "trajectories") -> None:
    for name, what in (("x", "states"), ("u", "inputs"), ("y", "outputs")):
        got, wanted = (getattr(side, name).shape[-1] for side in (one, model))
        if got != wanted:
            note = " (outputs that are not given are the states)" if name == "y" else ""
            raise ValueError(
                f"{name_of}[{i}] must have {wanted} {what} as the first one, got {got}{note}"
            )
    for name in ("x_r", "u_r", "y_r", "u_before"):
        got, wanted = (getattr(side, name) is not None for side in (one, model))
        if got != wanted:
            have = "have" if wanted else "have no"
            raise ValueError(f"{name_of}[{i}] must {have} {name} as the first one")


def batches(trajectories: Trajectory | Recordings) -> tuple[Trajectory, ...]:
    """Return the batches of equally long trajectories."""
    return trajectories.parts if isinstance(trajectories, Recordings) else (trajectories,)


def applied(measure: Callable[[Trajectory], Any], trajectories: Trajectory | Recordings) -> Any:
    """Return a function of a batch, of all trajectories (n, ...)."""
    if isinstance(trajectories, Recordings):
        return trajectories.apply(measure)
    return measure(trajectories)


def joined(pools: Sequence[Trajectory | Recordings]) -> tuple[Trajectory | Recordings, list[int]]:
    """Return several pools as one, and where each begins; a pool that comes twice stays one.

    A Trajectory if all are, and last equally long. A ValueError says what does not fit.
    """
    flags = {isinstance(pool, Recordings) and pool.per_step for pool in pools}
    if len(flags) > 1:
        raise ValueError(
            "sets must all sum over steps or all take the mean, got per_step=True in some: "
            "make Recordings(..., per_step=True) of the others' trajectories"
        )
    once = list({id(pool): pool for pool in pools}.values())
    begin = np.cumsum([0, *map(len, once)])
    offsets = {id(pool): int(k) for pool, k in zip(once, begin, strict=False)}
    places = [offsets[id(pool)] for pool in pools]
    models = [batches(pool)[0] for pool in once]
    for i, pool in enumerate(models):
        _alike(i, pool, models[0], "sets")
    if len(once) == 1:
        return once[0], places
    plain = [pool for pool in once if isinstance(pool, Trajectory)]
    if len(plain) == len(once) and len({pool.horizon for pool in plain}) == 1:
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *plain), places
    each = [
        [pool] if isinstance(pool, Trajectory) else [pool[i] for i in range(len(pool))]
        for pool in once
    ]
    return Recordings([one for some in each for one in some], per_step=flags.pop()), places
