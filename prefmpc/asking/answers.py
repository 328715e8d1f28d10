"""Answers: what counts as one, and how they stand in a log."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np

from prefmpc._checks import number
from prefmpc.asking.questions import Question
from prefmpc.preferences.comparisons import Comparisons, compared
from prefmpc.preferences.logs import answers_of


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


def comparisons_of(answers: list[Answer]) -> Comparisons:
    """Return what was answered as a data set; a ValueError if nothing was."""
    questions = [a.question for a in answers]
    sides = [q.first for q in questions], [q.second for q in questions]
    return compared(*sides, np.array([a.label for a in answers]))


def line_of(count: int, answer: Answer) -> dict[str, Any]:
    """Return the line of a log for the answer to a question."""
    label = None if np.isnan(answer.label) else answer.label
    return {
        "answer": label,
        "number": count,
        "batch": answer.batch,
        "question": vars(answer.question),
    }


def judgement_of(count: int, pair: int, label: float, sides: dict[str, Any]) -> dict[str, Any]:
    """Return the line of a log for an answer to a pair of a blind test after so many answers.

    Parameters
    ----------
    label : float
        P(first preferred), NaN if the answer is taken back.
    sides : dict
        Trajectories ``first`` and ``second``, and which one is ``learned``.
    """
    return {"blind": pair, "number": count, "answer": None if np.isnan(label) else label, **sides}


def replayed(
    lines: list[dict[str, Any]], path: str | os.PathLike[str]
) -> tuple[list[Answer], tuple[int, int]]:
    """Return the answers that the lines of a log leave, and the batch of the last line."""
    logged, last = answers_of(lines, path)
    answers = [Answer(Question(**a.question), a.label, a.batch) for a in logged]
    return answers, (0, 1) if last is None else last.batch
