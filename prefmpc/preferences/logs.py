"""Logs of interviews: a line of JSON for the beginning, and one for each answer or undo.

The answers of a blind test stand there too. Nothing is learned from them: they are checked and
passed over.

They come back from other computers and from people's hands: every line is checked when it is read.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from prefmpc._checks import finite_array, is_whole, number
from prefmpc.preferences.trajectories import Trajectory

FORMAT = 1
FIELDS = ("x", "u", "y", "x_r", "u_r", "y_r", "u_before")


class LoggedAnswer(NamedTuple):
    """A line of a log that is an answer."""

    label: float
    """P(first preferred), NaN for a skipped question."""
    batch: tuple[int, int]
    """How many answers there were when its batch was made, and the size of the batch."""
    question: dict[str, Any]
    """Trajectories ``first`` and ``second``; gain, sure, probability, number and repeats."""


def read(path: str | os.PathLike[str]) -> tuple[list[dict[str, Any]], int]:
    """Return the whole lines of a log, and how many bytes they take.

    A last line that is torn does not count: its answer was never acknowledged.

    Raises
    ------
    ValueError
        If the file is no log, or is damaged elsewhere than at its end.
    """
    data = Path(path).read_bytes()
    lines: list[dict[str, Any]] = []
    size = 0
    pieces = data.split(b"\n")
    for place, piece in enumerate(pieces[:-1], 1):
        try:
            line = json.loads(piece)
            if not isinstance(line, dict):
                raise ValueError("a line must be an object")
        except (ValueError, RecursionError) as error:
            if not data[size + len(piece) + 1 :].strip(b"\0\n"):
                break
            raise ValueError(f"path must be a log, {path} is damaged in line {place}") from error
        lines.append(line)
        size += len(piece) + 1
    if not lines:
        raise ValueError(f"path must be a log of an interview, {path} has no whole line")
    with at_line(path, 1):
        version = lines[0].get("prefmpc interview")
        if version != FORMAT or isinstance(version, bool):
            raise ValueError(f"prefmpc interview must be format {FORMAT}, got {version!r}")
    return lines, size


@contextlib.contextmanager
def at_line(path: str | os.PathLike[str], place: int) -> Iterator[None]:
    """Say in which line of a log is what a ValueError complains of."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"path must be a log, {path} has in line {place}: {error}") from error


def answers_of(
    lines: list[dict[str, Any]], path: str | os.PathLike[str]
) -> tuple[list[LoggedAnswer], LoggedAnswer | None]:
    """Return the answers that all lines but the first leave, and that of the last line.

    Raises
    ------
    ValueError
        If a field of a line is missing or not what it must be.
    """
    answers: list[LoggedAnswer] = []
    last = None
    for place, line in enumerate(lines[1:], 2):
        with at_line(path, place):
            if "undo" in line:
                _equal("undo", line["undo"], len(answers) - 1)
                last = answers.pop()
            elif "blind" in line:
                _check_blind(line)
            else:
                last = _answer(line, len(answers))
                _alike(last, answers[0] if answers else last)
                answers.append(last)
    return answers, last


def _check_blind(line: dict[str, Any]) -> None:
    """Check an answer to a pair of a blind test; null is one that was taken back."""
    for name in ("blind", "number"):
        value = _field(line, name)
        if not is_whole(value) or value < 0:
            raise ValueError(f"{name} must be a whole number, got {value!r:.50}")
    if _field(line, "answer") is not None:
        _number("answer", line["answer"], 0, 1)
    if (learned := _field(line, "learned")) not in ("first", "second"):
        raise ValueError(f'learned must be "first" or "second", got {learned!r:.50}')
    for side in ("first", "second"):
        _trajectory(line, side, "")


def _answer(line: dict[str, Any], count: int) -> LoggedAnswer:
    _equal("number", _field(line, "number"), count)
    value = _field(line, "answer")
    label = float("nan") if value is None else _number("answer", value, 0, 1)
    batch = _field(line, "batch")
    if not isinstance(batch, list) or len(batch) != 2 or not all(map(is_whole, batch)):
        raise ValueError(f"batch must hold two whole numbers, got {batch!r}")
    start, size = batch
    if not 0 <= start <= count < start + size:
        raise ValueError(f"batch must hold number {count}, got {batch}")
    stored = _field(line, "question")
    if not isinstance(stored, dict):
        raise ValueError(f"question must be an object, got {stored!r:.50}")
    question: dict[str, Any] = {name: _trajectory(stored, name) for name in ("first", "second")}
    for name, most in (("gain", np.inf), ("sure", 1), ("probability", 1)):
        question[name] = _number(f"question.{name}", _field(stored, name, "question."), 0, most)
    _equal("question.number", _field(stored, "number", "question."), count)
    repeats = _field(stored, "repeats", "question.")
    if repeats is not None and not (is_whole(repeats) and 0 <= repeats < count):
        raise ValueError(f"question.repeats must be an earlier number or null, got {repeats!r}")
    return LoggedAnswer(label, (start, size), {**question, "number": count, "repeats": repeats})


def _field(line: dict[str, Any], name: str, within: str = "") -> Any:
    if name not in line:
        raise ValueError(f"{within}{name} is missing")
    return line[name]


def _equal(name: str, value: Any, wanted: int) -> None:
    if not is_whole(value) or value != wanted or wanted < 0:
        raise ValueError(
            f"{name} must be {wanted if wanted >= 0 else 'after an answer'}, got {value!r:.50}"
        )


def _number(name: str, value: Any, least: float, most: float) -> float:
    if isinstance(value, str | list):
        raise ValueError(f"{name} must be a number, got {value!r:.50}")
    wish = f"be finite and at least {least}" if most == np.inf else f"lie in [{least}, {most}]"
    return number(name, value, holds=lambda v: least <= v <= most and v < np.inf, wish=wish)


def _trajectory(question: dict[str, Any], side: str, path: str = "question.") -> Trajectory:
    stored = _field(question, side, path)
    within = f"{path}{side}."
    if not isinstance(stored, dict):
        raise ValueError(f"{path}{side} must be an object, got {stored!r:.50}")
    for name in ("x", "u", "y"):
        _field(stored, name, within)
    parts = {name: finite_array(within + name, stored[name]) for name in FIELDS if name in stored}
    try:
        trajectory = Trajectory(**parts)
    except ValueError as error:
        raise ValueError(f"{path}{side}: {error}") from None
    if trajectory.batch_shape:
        raise ValueError(f"{within}x must have 2 dimensions, got {trajectory.x.shape}")
    return trajectory


def _alike(answer: LoggedAnswer, model: LoggedAnswer) -> None:
    """Raise a ValueError unless all trajectories have the same shapes."""
    for side in ("first", "second"):
        for name in ("x", "u", "y"):
            got = getattr(answer.question[side], name).shape
            wanted = getattr(model.question["first"], name).shape
            if got != wanted:
                raise ValueError(
                    f"question.{side}.{name} must have shape {wanted} as those before, got {got}"
                )
