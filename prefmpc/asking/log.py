"""The log of an interview: a line of JSON for each answer, on the disk before the next question."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from prefmpc._checks import to_numpy
from prefmpc.preferences.logs import FIELDS
from prefmpc.preferences.trajectories import Trajectory


def to_json(value: Any) -> Any:
    """Return arrays and trajectories as lists; infinite numbers as texts. Nothing is rounded."""
    if isinstance(value, Trajectory):
        parts = {name: getattr(value, name) for name in FIELDS}
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
