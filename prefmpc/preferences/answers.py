"""Answers of every kind: pairs, ties, strengths, rankings, best of many, acceptable or not."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, indices, instance, is_whole, positive_int, sequence
from prefmpc._pytree import register_pytree, set_fields
from prefmpc.preferences.answer_files import read_lines, write_lines
from prefmpc.preferences.codings import (
    NOBODY,
    RANKING,
    Coding,
    check_answers,
    filled,
    grade_of,
    items_of,
    marks_of,
)
from prefmpc.preferences.comparisons import Comparisons, check_pool
from prefmpc.preferences.recordings import Recordings, joined
from prefmpc.preferences.trajectories import Trajectory

Pool = Trajectory | Recordings


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Answers:
    """What people said of one, two or many trajectories, whatever they were asked.

    An answer is a grade on a scale, or a ranking:

    - one trajectory on a scale of 2: acceptable (1) or not (0); of 5: its stars, from 0 to 1;
    - two on a scale of 2: which is better, 1 the first, 0 the second, as in `Comparisons`; of 3:
      the same where "no difference" (0.5) is an answer of its own; of 5: much better (1),
      better (0.75), no difference, worse, much worse (0);
    - two or more in a ranking: best first, as far as they were ranked.

    A grade between two marks of the scale is both of them, with weights: "cannot say".

    Parameters
    ----------
    trajectories : Trajectory or Recordings
        With leading dimension n_t, all finite.
    shown : int array (n, k)
        Which trajectories each answer is about; −1 fills up the rows of those about fewer.
    grades : int array (n,)
        How many marks the scale has, at least 2; 0 for a ranking.
    answers : array (n,)
        Grades in [0, 1], 1 the best or the first; of a ranking, how many of those that were shown
        are ranked. These stand first in ``shown``, best first; the others are behind them.

    Raises
    ------
    ValueError
        If there is no answer, an index points nowhere, a ranking repeats an item, or an answer
        lies outside its scale.
    """

    trajectories: Any
    shown: np.ndarray
    grades: np.ndarray
    answers: np.ndarray

    def __init__(
        self, trajectories: Pool, shown: ArrayLike, grades: ArrayLike, answers: ArrayLike
    ) -> None:
        if not isinstance(trajectories, Recordings):
            check_pool(trajectories)
        given = np.asarray(finite_array("answers", answers, ndim=1, booleans=True))
        n, count = given.size, len(trajectories)
        if not n:
            raise ValueError("answers must hold at least one, got an empty data set")
        rows, scale = indices("shown", shown), indices("grades", grades)
        if rows.ndim != 2 or len(rows) != n or rows.dtype == bool:
            raise ValueError(f"shown must have shape ({n}, k), one row an answer, got {rows.shape}")
        if scale.shape != (n,) or scale.dtype == bool:
            raise ValueError(f"grades must have shape ({n},), one an answer, got {scale.shape}")
        check_answers(rows, scale, given, count)
        set_fields(self, trajectories=trajectories, shown=rows, grades=scale, answers=given)

    def __len__(self) -> int:
        """Number of answers n."""
        return int(self.answers.size)

    @property
    def sizes(self) -> np.ndarray:
        """How many trajectories each answer is about (n,)."""
        return (self.shown != NOBODY).sum(axis=1)

    def subset(self, index: ArrayLike) -> Answers:
        """Return the answers chosen by an integer or boolean index, in that order."""
        which = indices("index", index)
        try:
            chosen = np.arange(len(self))[which]
        except IndexError:
            chosen = np.zeros(0, dtype=int)
        if chosen.ndim != 1 or not chosen.size:
            raise ValueError(f"index must choose among the {len(self)} answers, got {index}")
        parts = self.shown[chosen], self.grades[chosen], self.answers[chosen]
        return Answers(self.trajectories, *parts)

    def check_same_start(self) -> Answers:
        """Return these answers if whatever was shown together starts alike and lasts equally long.

        Otherwise more differs than the control: a ValueError names the first such answer.
        """
        T = self.trajectories
        parts = T.parts if isinstance(T, Recordings) else (T,)
        order = T.order if isinstance(T, Recordings) else slice(None)
        x0 = np.concatenate([np.asarray(part.x[:, 0]) for part in parts])[order]
        steps = np.concatenate([np.full(len(part), part.horizon) for part in parts])[order]
        others = np.where(self.shown == NOBODY, self.shown[:, :1], self.shown)
        for what, values in (("last equally long", steps[:, None]), ("start alike", x0)):
            apart = (values[others] != values[others[:, :1]]).any(axis=(1, 2))
            if apart.any():
                i = int(np.argmax(apart))
                got = [values[j].tolist() for j in self.shown[i, : self.sizes[i]]]
                raise ValueError(
                    f"answers must be about trajectories that {what}, answer {i} is about {got}"
                )
        return self

    @classmethod
    def from_comparisons(cls, comparisons: Comparisons) -> Answers:
        """Return compared pairs as answers on a scale of 2: the same likelihood.

        Who answered is not kept: `fit_raters` and the like take the comparisons themselves.
        """
        instance("comparisons", comparisons, Comparisons)
        shown = np.stack([comparisons.first, comparisons.second], axis=1)
        grades = np.full(len(comparisons), 2)
        return cls(comparisons.trajectories, shown, grades, comparisons.labels)

    @classmethod
    def from_labels(
        cls,
        trajectories: Pool,
        first: ArrayLike,
        second: ArrayLike,
        labels: Sequence[Any] | np.ndarray,
        *,
        coding: Coding,
        grades: int | None = None,
    ) -> Answers:
        """Read answers about pairs in the coding in which they were written down.

        Parameters
        ----------
        trajectories : Trajectory or Recordings
        first, second : int array (n,)
            Which trajectories stand in each pair.
        labels : sequence (n,)
        coding : {"words", "signs", "booleans"} or a mapping
            "words": "first", "second" and "tie"; "signs": whole numbers, 1 where the first is
            better, −1 where the second is, 0 for a tie, and up to ±g on a scale of 2 g + 1;
            "booleans": whether the first is better. A mapping says of each label which grade in
            [0, 1] it is, 1 where the first is (much) better: ``{-1: 1.0, 1: 0.0}`` for costs.
        grades : int, optional
            Marks of the scale. Default: 3 for words and signs, 2 for booleans. A tie on a scale of
            2 is a half of each answer. With a mapping it must be given.
        """
        marks = marks_of(coding, grades)
        sides = [indices(name, side) for name, side in (("first", first), ("second", second))]
        entries = sequence("labels", labels)
        if any(side.shape != (len(entries),) for side in sides):
            raise ValueError(
                f"first and second must have shape ({len(entries)},), one a label, "
                f"got {sides[0].shape} and {sides[1].shape}"
            )
        values = np.array([grade_of(i, label, coding, marks) for i, label in enumerate(entries)])
        return cls(trajectories, np.stack(sides, axis=1), np.full(values.size, marks), values)

    @classmethod
    def from_ratings(
        cls, trajectories: Pool, ratings: ArrayLike, *, stars: int, index: ArrayLike | None = None
    ) -> Answers:
        """Read stars, 1 (worst) to ``stars`` (best), that single trajectories were given.

        They are not turned into pairs: between one number of stars and the next lies a threshold
        for σ, which is learned along. Two stars are "unacceptable" and "acceptable".

        Parameters
        ----------
        trajectories : Trajectory or Recordings
        ratings : array (n,)
            Whole numbers; for ``stars=2`` also booleans, True for acceptable.
        stars : int
            At least 2.
        index : int array (n,), optional
            Which trajectory each rating is about. Default: the first n.
        """
        if positive_int("stars", stars) < 2:
            raise ValueError(f"stars must be at least 2, got {stars}")
        given = indices("ratings", ratings)
        which = np.arange(given.size) if index is None else indices("index", index)
        if given.ndim != 1 or which.shape != given.shape:
            raise ValueError(
                "ratings and index must have one dimension and equal lengths, "
                f"got {given.shape} and {which.shape}"
            )
        if given.dtype == bool:
            if stars != 2:
                raise ValueError(f"ratings must be whole numbers for {stars} stars, got booleans")
            given = 1 + given
        outside = (given < 1) | (given > stars)
        if outside.any():
            i = int(np.argmax(outside))
            raise ValueError(f"ratings must lie in 1 to {stars} stars, got {given[i]} at index {i}")
        return cls(
            trajectories, which[:, None], np.full(given.size, stars), (given - 1) / (stars - 1)
        )

    @classmethod
    def from_rankings(
        cls,
        trajectories: Pool,
        rankings: Sequence[Sequence[int]] | np.ndarray,
        *,
        shown: Sequence[Sequence[int]] | np.ndarray | None = None,
    ) -> Answers:
        """Read rankings, best first, each a sequence of indices of trajectories.

        Parameters
        ----------
        trajectories : Trajectory or Recordings
        rankings : sequence of sequences of int
        shown : sequence of sequences of int, optional
            What was to be ranked, where not all of it was: those that are missing in a ranking
            are behind those in it, in an order that nobody told. Default: what is ranked.
        """
        ranked = [
            items_of(f"rankings[{i}]", r) for i, r in enumerate(sequence("rankings", rankings))
        ]
        rows = ranked
        if shown is not None:
            sets = [items_of(f"shown[{i}]", s) for i, s in enumerate(sequence("shown", shown))]
            if len(sets) != len(ranked):
                raise ValueError(f"shown must hold {len(ranked)} sets, got {len(sets)}")
            rows = []
            for i, (order, all_of) in enumerate(zip(ranked, sets, strict=True)):
                if unknown := sorted(set(order) - set(all_of)):
                    raise ValueError(f"rankings[{i}] must rank what is shown, got {unknown}")
                rows.append(order + [item for item in all_of if item not in order])
        return cls(
            trajectories,
            filled(rows),
            np.full(len(rows), RANKING),
            np.array([len(order) for order in ranked], dtype=float),
        )

    @classmethod
    def from_choices(
        cls,
        trajectories: Pool,
        shown: Sequence[Sequence[int]] | np.ndarray,
        chosen: Sequence[int] | np.ndarray,
    ) -> Answers:
        """Read which one of several was the best.

        Parameters
        ----------
        trajectories : Trajectory or Recordings
        shown : sequence of sequences of int
            The trajectories among which each answer chooses.
        chosen : sequence of int
            The best of each, by its index among all trajectories.
        """
        best = [[item] for item in sequence("chosen", chosen)]
        sets = sequence("shown", shown)
        if len(best) != len(sets):
            raise ValueError(
                f"shown and chosen must be equally many, got {len(sets)} and {len(best)}"
            )
        for i, (one, all_of) in enumerate(zip(best, sets, strict=True)):
            if not is_whole(one[0]) or one[0] not in sequence(f"shown[{i}]", all_of):
                raise ValueError(f"chosen[{i}] must be among those shown, got {one[0]!r}")
        return cls.from_rankings(trajectories, best, shown=sets)

    @classmethod
    def concatenate(cls, sets: Sequence[Answers | Comparisons]) -> Answers:
        """Put data sets together, one after the other; a pool that they share stays one.

        Where these last differently long, they become `Recordings`. A ValueError says what does
        not fit: numbers of states, inputs or outputs, set points.
        """
        given = [as_answers(f"sets[{i}]", one) for i, one in enumerate(sequence("sets", sets))]
        if not given:
            raise ValueError("sets must hold at least one data set, got none")
        pool, offsets = joined([one.trajectories for one in given])
        width = max(one.shown.shape[1] for one in given)
        rows = [
            np.pad(
                np.where(one.shown == NOBODY, NOBODY, one.shown + offset),
                ((0, 0), (0, width - one.shown.shape[1])),
                constant_values=NOBODY,
            )
            for one, offset in zip(given, offsets, strict=True)
        ]
        parts = [
            np.concatenate([getattr(one, name) for one in given]) for name in ("grades", "answers")
        ]
        return cls(pool, np.concatenate(rows), *parts)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write a ``.jsonl`` file: a line for each trajectory, then one for each answer.

        An interrupted write leaves an old file whole; see `Comparisons.save` for what is raised.
        """
        return write_lines(self, path, overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Answers:
        """Read a file that `save` wrote, or any that `Comparisons.load` reads.

        A ValueError says what is wrong with another, with line and field.
        """
        stored = read_lines(path)
        return cls.from_comparisons(Comparisons.load(path)) if stored is None else cls(*stored)


register_pytree(Answers)


def as_answers(name: str, value: Any) -> Answers:
    """Return a data set of either kind as answers, or raise a ValueError."""
    check_data(name, value)
    return value if isinstance(value, Answers) else Answers.from_comparisons(value)


def check_data(name: str, value: Any) -> None:
    """Raise a ValueError unless ``value`` is a data set to learn from: of either kind."""
    if not isinstance(value, Answers):
        instance(name, value, Comparisons)
