"""Data sets of compared pairs: who was shown against whom, and what was answered."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, flag, function, indices, instances, positive_int
from prefmpc._files import atomic_write
from prefmpc._pytree import set_fields, stacked
from prefmpc._random import generator
from prefmpc.preferences.logs import answers_of, read
from prefmpc.preferences.names import names_of
from prefmpc.preferences.people import Preference, asked
from prefmpc.preferences.pools import pairs_from_one_start
from prefmpc.preferences.recordings import joined
from prefmpc.preferences.trajectories import Trajectory, check_finite

_OPTIONAL = dict.fromkeys(("x_r", "u_r", "y_r", "u_before"), 2)
"""What a trajectory may have beside x, u and y, and the version of the format that brought it.

A file has the least version that holds all that is in it: who reads older ones refuses it instead
of losing a part.
"""
_WHO = 3
"""The version that brought who gave each answer."""

_FORMAT_VERSIONS = tuple(range(1, 1 + _WHO))


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Comparisons:
    """A data set D of compared pairs: who was shown against whom, and what was answered.

    Parameters
    ----------
    trajectories : Trajectory
        With leading dimension n_t, all finite: drop closed loops that failed.
    first, second : int array (n,)
        Which trajectories stand in each pair.
    labels : array (n,)
        P(first is preferred) in [0, 1]: 1 first, 0 second, 0.5 cannot say.
    who : array (n,) of whole numbers or of texts, optional
        Who gave each answer. Two names that differ in blanks or in case only raise a UserWarning.

    Raises
    ------
    ValueError
        If there is no pair, an index points nowhere, a label lies outside [0, 1], a trajectory
        holds NaN, or ``who`` does not name somebody for each label.
    """

    trajectories: Trajectory
    first: np.ndarray
    second: np.ndarray
    labels: np.ndarray
    who: np.ndarray | None

    def __init__(
        self,
        trajectories: Trajectory,
        first: ArrayLike,
        second: ArrayLike,
        labels: ArrayLike,
        who: Any = None,
    ) -> None:
        check_pool(trajectories)
        labels = np.asarray(finite_array("labels", labels, ndim=1, booleans=True))
        if labels.size == 0:
            raise ValueError("labels must hold at least one comparison, got an empty data set")
        if labels.min() < 0 or labels.max() > 1:
            i = int(np.flatnonzero((labels < 0) | (labels > 1))[0])
            raise ValueError(
                f"labels must lie in [0, 1] (P(first is preferred)), got {labels[i]:g} at index {i}"
            )
        first = _pair_indices("first", first, labels.size, len(trajectories))
        second = _pair_indices("second", second, labels.size, len(trajectories))
        who = names_of(who, labels.size)
        pairs = {"first": first, "second": second, "labels": labels, "who": who}
        set_fields(self, trajectories=trajectories, **pairs)

    def __len__(self) -> int:
        """Number of comparisons n_p."""
        return int(self.labels.size)

    @property
    def pairs(self) -> tuple[Trajectory, Trajectory]:
        """The first and the second trajectory of every pair, each with leading dimension n_p."""
        return self.trajectories[self.first], self.trajectories[self.second]

    @classmethod
    def random(
        cls,
        trajectories: Trajectory,
        preference: Preference,
        size: int,
        *,
        key: Any,
        same_start: bool = False,
    ) -> Comparisons:
        """Draw ``size`` random pairs of two different trajectories and ask ``preference``.

        Pairs are drawn independently, so that one may come up twice. ``preference`` is called
        once, with two batches; wrap a function of single pairs in `one_by_one`. Pairs that it
        does not answer (NaN) are left out: there are then fewer than ``size``.

        Parameters
        ----------
        same_start : bool
            Draw only pairs with the same x(0), so that nothing but the control differs. The
            trajectories must then hold some that start alike (see `lqr_pool`).
        """
        check_pool(trajectories)
        function("preference", preference, 2)
        size = positive_int("size", size)
        count = len(trajectories)
        if count < 2:
            raise ValueError(f"trajectories must hold at least two to compare, got {count}")
        rng = generator(key)
        if flag("same_start", same_start):
            first, second = pairs_from_one_start(trajectories, size, rng)
        else:
            first = rng.integers(0, count, size)
            second = (first + rng.integers(1, count, size)) % count
        labels = asked("preference", preference, trajectories[first], trajectories[second])
        answered = ~np.isnan(labels)
        if not answered.any():
            raise ValueError(f"preference must answer some pairs, it answered none of {size}")
        return cls(trajectories, first[answered], second[answered], labels[answered])

    def sampled(self, *, key: Any) -> Comparisons:
        """Draw an answer 0 or 1 for every pair, 1 with the probability that its label gives."""
        answers = generator(key).uniform(size=len(self)) < self.labels
        return self._with(labels=answers.astype(float))

    @classmethod
    def from_arrays(
        cls,
        x_first: ArrayLike,
        u_first: ArrayLike,
        x_second: ArrayLike,
        u_second: ArrayLike,
        labels: ArrayLike,
        *,
        y_first: ArrayLike | None = None,
        y_second: ArrayLike | None = None,
        who: Any = None,
    ) -> Comparisons:
        """Build a data set from your own recordings: plain arrays and labels.

        Parameters
        ----------
        x_first, x_second : array (n, N + 1, nx)
        u_first, u_second : array (n, N, nu)
        labels : array (n,)
            P(first is preferred): 1 first, 0 second, 0.5 cannot say.
        y_first, y_second : array (n, N, ny), optional
        who : array (n,), optional
            Who gave each answer.
        """
        first = _recorded("first", x_first, u_first, y_first)
        second = _recorded("second", x_second, u_second, y_second)
        for name in ("x", "u", "y"):
            a, b = (getattr(side, name).shape for side in (first, second))
            if len(a) != 3 or a != b:
                raise ValueError(
                    f"{name}_first and {name}_second must have equal shapes with one leading "
                    f"dimension, got {a} and {b}"
                )
        n = len(first)
        answers = finite_array("labels", labels, booleans=True)
        if answers.size and answers.shape != (n,):
            raise ValueError(f"labels must have shape ({n},), one a pair, got {answers.shape}")
        both = jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)
        return cls(both, np.arange(n), np.arange(n, 2 * n), answers, who)

    @classmethod
    def concatenate(cls, sets: Sequence[Comparisons]) -> Comparisons:
        """Put data sets together, one after the other; a pool that they share stays one.

        A ValueError says what does not fit: ``who`` is told in all sets or in none, by names of
        one kind. `Answers.concatenate` takes any lengths, and answers of other kinds.
        """
        given: list[Any] = instances("sets", sets, Comparisons)
        kinds = {None if one.who is None else one.who.dtype.kind for one in given}
        if len(kinds) > 1:
            named = [type(one.who).__name__ if one.who is None else one.who.dtype for one in given]
            raise ValueError(f"sets must all say who answered in one way, or none, got {named}")
        trajectories, offsets = joined([one.trajectories for one in given])
        if not isinstance(trajectories, Trajectory):
            lengths = sorted({one.trajectories.horizon for one in given})
            raise ValueError(
                f"sets must be about equally long trajectories, got {lengths} steps; "
                "Answers.concatenate takes recordings of different lengths"
            )
        first, second = (
            np.concatenate([getattr(one, side) + k for one, k in zip(given, offsets, strict=True)])
            for side in ("first", "second")
        )
        labels = np.concatenate([one.labels for one in given])
        who = None if None in kinds else np.concatenate([one.who for one in given])
        return cls(trajectories, first, second, labels, who)

    def subset(self, index: ArrayLike) -> Comparisons:
        """Return the comparisons chosen by an integer or boolean index, in that order."""
        chosen, n = indices("index", index), len(self)
        if chosen.dtype == bool:
            fits = chosen.shape == (n,) and bool(chosen.any())
        else:
            inside = (chosen >= -n) & (chosen < n)
            fits = chosen.ndim == 1 and chosen.size > 0 and bool(inside.all())
        if not fits:
            raise ValueError(f"index must choose among the {n} comparisons, got {chosen}")
        return self._with(**{name: value[chosen] for name, value in self._each().items()})

    def _each(self) -> dict[str, np.ndarray]:
        """Return what there is one of for each comparison, by name."""
        names = ("first", "second", "labels") + (() if self.who is None else ("who",))
        return {name: getattr(self, name) for name in names}

    def _with(self, **changed: Any) -> Comparisons:
        """Return a copy in which some fields are others."""
        return Comparisons(**{**vars(self), **changed})

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write everything to one ``.npz`` file; an interrupted write leaves an old file whole.

        A file that is replaced keeps its permissions, and a symbolic link is followed. What a
        killed process left behind is removed by the next `save` to the same file.

        Raises
        ------
        FileExistsError
            If ``path`` exists and ``overwrite`` is False. Of several processes that save to one
            new path at once, one succeeds.
        ValueError
            If ``path`` does not end in ``.npz``.
        OSError
            If the file cannot be written.
        """
        target = Path(path)
        if target.suffix != ".npz":
            raise ValueError(f"path must end in .npz, got {str(path)!r}")
        with atomic_write(target, overwrite=flag("overwrite", overwrite)) as file:
            np.savez_compressed(file, **self._stored())
        return target

    def _stored(self) -> dict[str, Any]:
        T = self.trajectories
        arrays = {"x": T.x, "u": T.u, "y": T.y}
        optional = {name: getattr(T, name) for name in _OPTIONAL}
        optional = {name: value for name, value in optional.items() if value is not None}
        # A reader that does not know set points must refuse them, not lose them.
        version = max((_OPTIONAL[name] for name in optional), default=1)
        version = version if self.who is None else _WHO
        stored = {"format_version": version, **arrays, **optional, **self._each()}
        return {name: np.asarray(value) for name, value in stored.items()}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Comparisons:
        """Read a file that `save` wrote, or the log of an interview, which ends in ``.jsonl``.

        A ValueError says what is wrong with any other file, of a log with line and field.
        """
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"path must be a path, got {type(path).__name__}")
        if Path(path).suffix == ".jsonl":
            answers, _ = answers_of(read(path)[0], path)
            first, second = ([a.question[side] for a in answers] for side in ("first", "second"))
            return compared(first, second, np.array([a.label for a in answers]))
        try:
            with np.load(Path(path), allow_pickle=False) as file:
                stored = {name: file[name] for name in file.files}
        except FileNotFoundError:
            raise
        except Exception as error:
            raise ValueError(f"path must be a readable .npz file, got {path}: {error}") from None
        wanted = {"format_version", "x", "u", "y", "first", "second", "labels"}
        if missing := sorted(wanted - stored.keys()):
            raise ValueError(f"path must be a file of saved comparisons, {path} lacks {missing}")
        version = stored["format_version"]
        if version.shape != () or version not in _FORMAT_VERSIONS:
            raise ValueError(
                f"path must hold format version {_FORMAT_VERSIONS}, got {version} in {path}"
            )
        optional = {name: stored[name] for name in _OPTIONAL if name in stored}
        trajectories = Trajectory(stored["x"], stored["u"], stored["y"], **optional)
        first, second, labels = (stored[name] for name in ("first", "second", "labels"))
        return cls(trajectories, first, second, labels, stored.get("who"))


def compared(first: list[Trajectory], second: list[Trajectory], labels: np.ndarray) -> Comparisons:
    """Return pairs of single trajectories as a data set without those that were skipped (NaN)."""
    given = np.flatnonzero(~np.isnan(labels))
    if not given.size:
        raise ValueError("comparisons need at least one answer, there is none")
    sides = [first[i] for i in given] + [second[i] for i in given]
    both = stacked(sides)
    n = given.size
    return Comparisons(both, np.arange(n), np.arange(n, 2 * n), labels[given])


def _recorded(side: str, x: ArrayLike, u: ArrayLike, y: ArrayLike | None) -> Trajectory:
    try:
        return Trajectory(x, u, y)
    except ValueError as error:
        names = f"x_{side}, u_{side} and y_{side}"
        uneven = "; Recordings and Answers take different lengths" * ("inhomog" in str(error))
        raise ValueError(f"{names} do not fit: {error}{uneven}") from None


def check_pool(trajectories: Any) -> None:
    """Raise a ValueError unless these are trajectories with one leading dimension, all finite."""
    if not isinstance(trajectories, Trajectory):
        raise ValueError(
            f"trajectories must be a Trajectory, got {type(trajectories).__name__}; "
            "from plain arrays: Comparisons.from_arrays"
        )
    if len(trajectories.batch_shape) != 1:
        raise ValueError(
            "trajectories must have one leading dimension (n_t trajectories), "
            f"got batch shape {trajectories.batch_shape}"
        )
    check_finite("trajectories", trajectories, "closed loops that failed?")


def _pair_indices(name: str, value: ArrayLike, size: int, count: int) -> np.ndarray:
    index = indices(name, value)
    if index.shape != (size,) or index.dtype == bool:
        raise ValueError(
            f"{name} must hold {size} whole numbers, one for each label, "
            f"got shape {index.shape} of {index.dtype}"
        )
    if index.min() < 0 or index.max() >= count:
        raise ValueError(
            f"{name} must point into the {count} trajectories (0 to {count - 1}), "
            f"got {index.min()} to {index.max()}"
        )
    return index
