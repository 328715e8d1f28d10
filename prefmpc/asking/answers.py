"""Answers: what counts as one, and how they stand in a log."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np

from prefmpc._checks import number
from prefmpc.asking.log import trajectory_from
from prefmpc.asking.questions import Question


class Answer(NamedTuple):
    """A question and its answer."""

    question: Question
    label: float
    """P(first preferred), NaN for a skipped question."""
    batch: tuple[int, int]
    """How many answers there were when its batch was made, and the size of the batch."""


def label_of(value: Any) -> float:
    """Return P(first preferred), NaN for a skipped question; a ValueError if it is no answer."""
    if value is None or (isinstance(value, str) and value == "skip"):
        return float("nan")
    if isinstance(value, str):
        if value in ("first", "second"):
            return float(value == "first")
    else:
        p = number("value", value)
        if 0 <= p <= 1:
            return p
    raise ValueError(
        f'value must be "first", "second", "skip", None or a probability in [0, 1], got {value!r}'
    )


def line_of(count: int, answer: Answer) -> dict[str, Any]:
    """Return the line of a log for the answer to a question."""
    label = None if np.isnan(answer.label) else answer.label
    return {
        "answer": label,
        "number": count,
        "batch": answer.batch,
        "question": vars(answer.question),
    }


def _from_line(line: dict[str, Any]) -> Answer:
    stored = line["question"]
    sides = {side: trajectory_from(stored[side]) for side in ("first", "second")}
    label = float("nan") if line["answer"] is None else float(line["answer"])
    start, size = line["batch"]
    return Answer(Question(**{**stored, **sides}), label, (start, size))


def replayed(
    lines: list[dict[str, Any]], path: str | os.PathLike[str]
) -> tuple[list[Answer], tuple[int, int]]:
    """Return the answers that the lines of a log leave, and the batch of the last line."""
    answers: list[Answer] = []
    batch = (0, 1)
    for place, line in enumerate(lines, 2):
        try:
            if "undo" in line:
                batch = answers.pop().batch
                fits = len(answers) == line["undo"]
            else:
                fits = len(answers) == line["number"]
                answers.append(_from_line(line))
                batch = answers[-1].batch
        except (KeyError, IndexError, TypeError, ValueError):
            fits = False
        if not fits:
            raise ValueError(f"path must be a log, {path} makes no sense in line {place}")
    return answers, batch
