"""The log of an interview: a line of JSON for each answer, on the disk before the next question."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from prefmpc._checks import to_numpy
from prefmpc._pytree import bypass_init
from prefmpc.preferences.trajectories import Trajectory

FORMAT = 1
_FIELDS = ("x", "u", "y", "x_r", "u_r", "y_r", "u_before")


def to_json(value: Any) -> Any:
    """Return arrays and trajectories as lists; infinite numbers as texts. Nothing is rounded."""
    if isinstance(value, Trajectory):
        parts = {name: getattr(value, name) for name in _FIELDS}
        return {name: to_json(part) for name, part in parts.items() if part is not None}
    if isinstance(value, dict):
        return {name: to_json(part) for name, part in value.items()}
    if hasattr(value, "shape"):
        return to_json(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [to_json(part) for part in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


def trajectory_from(stored: dict[str, Any]) -> Trajectory:
    """Return the trajectory that `to_json` wrote."""
    return bypass_init(
        Trajectory,
        **{
            name: np.array(stored[name], dtype=np.float64) if name in stored else None
            for name in _FIELDS
        },
    )


class Log:
    """A file to which lines are appended, each of them on the disk when `append` returns.

    Parameters
    ----------
    path : path-like
        A file that begins with a whole line.
    size : int
        Bytes to keep of it: what comes after them is a line that was torn when its writer was
        killed.
    """

    def __init__(self, path: str | os.PathLike[str], size: int) -> None:
        self.path, self._size = Path(path), size

    def append(self, line: dict[str, Any]) -> None:
        """Write one line, and wait until it is on the disk; an error leaves no half of it."""
        data = encoded(line)
        with open(self.path, "r+b") as file:
            file.truncate(self._size)
            file.seek(self._size)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._size += len(data)


def encoded(line: dict[str, Any]) -> bytes:
    """Return a line of the log."""
    return (json.dumps(to_json(to_numpy(line)), ensure_ascii=False) + "\n").encode()


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
    for number, piece in enumerate(pieces[:-1], 1):
        try:
            line = json.loads(piece)
            if not isinstance(line, dict):
                raise ValueError("a line must be an object")
        except ValueError as error:
            if not data[size + len(piece) + 1 :].strip(b"\0\n"):
                break
            raise ValueError(f"path must be a log, {path} is damaged in line {number}") from error
        lines.append(line)
        size += len(piece) + 1
    if not lines or lines[0].get("prefmpc interview") != FORMAT:
        raise ValueError(f"path must be a log of an interview in format {FORMAT}, got {path}")
    return lines, size
