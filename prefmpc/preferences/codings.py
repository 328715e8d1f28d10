"""How answers are written down: labels, scales and rankings, checked where they come in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from prefmpc._checks import is_whole, number, positive_int, sequence

NOBODY = -1
"""Stands in `Answers.shown` where fewer trajectories were shown than in other answers."""

RANKING = 0
"""Stands in `Answers.grades` for a ranking."""

Coding = Literal["words", "signs", "booleans"] | Mapping[Any, float]
"""What labels of pairs mean; see `Answers.from_labels`."""

WORDS = {"first": 1.0, "tie": 0.5, "second": 0.0}


def check_answers(shown: np.ndarray, grades: np.ndarray, answers: np.ndarray, count: int) -> None:
    """Raise a ValueError that names the first answer that is none about ``count`` trajectories."""
    there = shown != NOBODY
    sizes = there.sum(axis=1)
    ranked = grades == RANKING
    _refuse(
        "shown",
        (shown < NOBODY).any(1) | (shown >= count).any(1),
        f"point into the {count} trajectories (0 to {count - 1})",
        shown,
    )
    _refuse("shown", (there[:, 1:] & ~there[:, :-1]).any(1), "be filled up with −1 behind", shown)
    _refuse("grades", (grades < 0) | (grades == 1), "be at least 2, or 0 for a ranking", grades)
    _refuse(
        "shown",
        np.where(ranked, sizes < 2, (sizes < 1) | (sizes > 2)),
        "hold one or two trajectories for a grade and at least two for a ranking",
        shown,
    )
    low, high = np.where(ranked, 1, 0), np.where(ranked, sizes, 1)
    whole = ~ranked | (answers == np.round(answers))
    _refuse(
        "answers",
        (answers < low) | (answers > high) | ~whole,
        "lie in [0, 1], of a ranking be how many are ranked",
        answers,
    )
    order = np.sort(shown, axis=1)
    twice = ((order[:, 1:] == order[:, :-1]) & (order[:, 1:] != NOBODY)).any(axis=1)
    _refuse("shown", ranked & twice, "hold no trajectory twice in a ranking", shown)


def _refuse(name: str, bad: Any, wish: str, values: np.ndarray) -> None:
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(f"{name} must {wish}, got {values[i].tolist()} at index {i}")


def marks_of(coding: Any, grades: int | None) -> int:
    """Return how many marks the scale of a coding has, or raise a ValueError."""
    named = isinstance(coding, str) and coding in ("words", "signs", "booleans")
    if not named and not (isinstance(coding, Mapping) and coding):
        raise ValueError(
            f'coding must be "words", "signs", "booleans" or a mapping of labels, got {coding!r}'
        )
    if grades is None:
        if not named:
            raise ValueError("grades must be given with a coding of your own")
        return 2 if coding == "booleans" else 3
    if positive_int("grades", grades) < 2:
        raise ValueError(f"grades must be at least 2, got {grades}")
    if coding == "signs" and grades % 2 == 0 and grades > 2:
        raise ValueError(f"grades must be odd, or 2, for signs, got {grades}")
    return int(grades)


def grade_of(i: int, label: Any, coding: Coding, marks: int) -> float:
    """Return the grade in [0, 1] that a label means, or raise a ValueError."""
    label = getattr(label, "item", lambda: label)()  # of NumPy's own scalars
    if isinstance(coding, Mapping):
        try:
            known = label in coding
        except TypeError:
            known = False
        if not known:
            raise ValueError(
                f"labels[{i}] must be one of those of coding, {list(coding)}, got {label!r}"
            )
        grade = number(f"coding[{label!r}]", coding[label])
        if not 0 <= grade <= 1:
            raise ValueError(f"coding must give grades in [0, 1], got {grade} for {label!r}")
        return grade
    if coding == "words":
        if not isinstance(label, str) or label not in WORDS:
            raise ValueError(f"labels[{i}] must be one of {list(WORDS)}, got {label!r}")
        return WORDS[label]
    if coding == "booleans":
        if not isinstance(label, bool):
            raise ValueError(f"labels[{i}] must be True or False, got {label!r}")
        return float(label)
    most = max(1, (marks - 1) // 2)
    if (
        isinstance(label, bool)
        or not isinstance(label, int | float)
        or label not in range(-most, most + 1)
    ):
        raise ValueError(f"labels[{i}] must be a whole number in −{most} to {most}, got {label!r}")
    return (label / most + 1) / 2


def items_of(name: str, value: Any) -> list[int]:
    """Return indices of different trajectories as a list, or raise a ValueError."""
    items = sequence(name, value)
    if not items or not all(map(is_whole, items)):
        raise ValueError(f"{name} must hold whole numbers, one a trajectory, got {items!r}")
    if repeated := sorted({int(item) for item in items if items.count(item) > 1}):
        raise ValueError(f"{name} must hold no trajectory twice, got {repeated} again")
    return [int(item) for item in items]


def filled(rows: Sequence[Sequence[int]]) -> np.ndarray:
    """Return rows of different lengths as one array, filled up with −1."""
    width = max(map(len, rows), default=1)
    out = np.full((len(rows), width), NOBODY)
    for row, items in zip(out, rows, strict=True):
        row[: len(items)] = items
    return out
