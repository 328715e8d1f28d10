"""Files of answers: a line of JSON for each trajectory, then one for each answer."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from prefmpc._checks import finite_array, flag, is_whole, number, positive_int
from prefmpc._files import atomic_write
from prefmpc.preferences.codings import NOBODY, RANKING, filled
from prefmpc.preferences.logs import FIELDS, at_line
from prefmpc.preferences.recordings import Recordings
from prefmpc.preferences.trajectories import Trajectory

FORMAT = 1
HEAD = "prefmpc answers"


def write_lines(answers: Any, path: str | os.PathLike[str], overwrite: bool) -> Path:
    """Write answers to a new file, whose path is returned."""
    target = Path(path)
    if target.suffix != ".jsonl":
        raise ValueError(f"path must end in .jsonl, got {str(path)!r}")
    pool = answers.trajectories
    per_step = isinstance(pool, Recordings) and pool.per_step
    with atomic_write(target, overwrite=flag("overwrite", overwrite)) as file:

        def put(line: dict[str, Any]) -> None:
            file.write(json.dumps(line).encode() + b"\n")

        put({HEAD: FORMAT, "per_step": per_step, "trajectories": len(pool)})
        for i in range(len(pool)):
            one = pool[i]
            fields = {name: getattr(one, name) for name in FIELDS}
            put({k: np.asarray(v).tolist() for k, v in fields.items() if v is not None})
        for row, grades, answer in zip(answers.shown, answers.grades, answers.answers, strict=True):
            shown = [int(item) for item in row if item != NOBODY]
            if grades == RANKING:
                put({"shown": shown, "ranked": int(answer)})
            else:
                put({"shown": shown, "grades": int(grades), "answer": float(answer)})
    return target


def read_lines(path: str | os.PathLike[str]) -> tuple[Any, ...] | None:
    """Return trajectories, shown, grades and answers of a file; None if it is another kind's."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a path, got {type(path).__name__}")
    if Path(path).suffix != ".jsonl":
        return None
    lines = Path(path).read_bytes().split(b"\n")
    try:
        head = json.loads(lines[0])
    except (ValueError, RecursionError):
        return None
    if not isinstance(head, dict) or HEAD not in head:
        return None
    with at_line(path, 1):
        if head[HEAD] != FORMAT or isinstance(head[HEAD], bool):
            raise ValueError(f"{HEAD} must be format {FORMAT}, got {head[HEAD]!r}")
        per_step = flag("per_step", head.get("per_step"))
        count = positive_int("trajectories", head.get("trajectories"))
    pool: list[Trajectory] = []
    rows: list[list[int]] = []
    values: list[tuple[int, float]] = []
    for place, text in enumerate(lines[1:], 2):
        if not text:
            continue
        with at_line(path, place):
            line = _object(text)
            if len(pool) < count:
                pool.append(_trajectory(line))
            else:
                row, value = _answer(line)
                rows.append(row)
                values.append(value)
    if len(pool) < count:
        raise ValueError(f"path must hold {count} trajectories, {path} has {len(pool)}")
    trajectories = Recordings(pool, per_step=True) if per_step else _alone_or_joined(pool)
    grades, answers = np.array(values, dtype=float).reshape(-1, 2).T
    return trajectories, filled(rows), grades.astype(int), answers


def _alone_or_joined(pool: list[Trajectory]) -> Any:
    recordings = Recordings(pool)
    return recordings.parts[0] if len(recordings.parts) == 1 else recordings


def _object(text: bytes) -> dict[str, Any]:
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        line = None
    if not isinstance(line, dict):
        raise ValueError(f"a line must be an object, got {text[:50]!r}")
    return line


def _trajectory(line: dict[str, Any]) -> Trajectory:
    for name in ("x", "u"):
        if name not in line:
            raise ValueError(f"{name} is missing")
    parts = {name: finite_array(name, line[name]) for name in FIELDS if name in line}
    one = Trajectory(**parts)
    if one.batch_shape:
        raise ValueError(f"x must have 2 dimensions, got {one.x.shape}")
    return one


def _answer(line: dict[str, Any]) -> tuple[list[int], tuple[int, float]]:
    shown = line.get("shown")
    if not isinstance(shown, list) or not all(map(is_whole, shown)):
        raise ValueError(f"shown must be a list of whole numbers, got {shown!r:.50}")
    wanted = ("ranked",) if "ranked" in line else ("grades", "answer")
    for name in wanted:
        if not isinstance(line.get(name), int | float):
            raise ValueError(f"{name} must be a number, got {line.get(name)!r:.50}")
    if "ranked" in line:
        return shown, (RANKING, number("ranked", line["ranked"]))
    if not is_whole(line["grades"]):
        raise ValueError(f"grades must be a whole number, got {line['grades']!r}")
    return shown, (line["grades"], number("answer", line["answer"]))
