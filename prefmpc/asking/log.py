"""The log of an interview: a line of JSON for each answer, on the disk before the next question."""

from __future__ import annotations

import contextlib
import json
import os
import weakref
from collections.abc import Callable, Iterator
from io import FileIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from prefmpc._checks import to_numpy
from prefmpc._files import try_lock
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

    Nobody else may write to it in the meantime: each line is written under a lock, and only if
    the file is as it was left. Who wants to be the only one for longer takes `hold`.

    Parameters
    ----------
    path : path-like
        A file that begins with a whole line.
    size : int
        Bytes to keep of it: what comes after them is a line that was torn when its writer was
        killed.
    """

    _holders: ClassVar[weakref.WeakValueDictionary[str, Log]] = weakref.WeakValueDictionary()

    def __init__(self, path: str | os.PathLike[str], size: int) -> None:
        self.path, self._size = Path(path), size
        self._end = self.path.stat().st_size
        self._held: FileIO | None = None
        self.notes: Callable[[], dict[str, Any]] = dict
        """What is added to each line."""

    def append(self, line: dict[str, Any]) -> None:
        """Write one line, and wait until it is on the disk; an error leaves no half of it.

        Raises
        ------
        BlockingIOError
            If somebody else holds the log.
        ValueError
            If somebody else has written to it since it was read.
        """
        data = encoded({**line, **self.notes()})
        with self._locked() as file:
            try:
                file.truncate(self._size)
                file.seek(self._size)
                rest = memoryview(data)
                while rest:  # unbuffered: what is not written now will not be written later
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
                self._size += len(data)
            finally:
                self._end = os.fstat(file.fileno()).st_size

    def hold(self) -> int:
        """Lock the file until `release`, or until this process ends; errors as in `append`.

        In the same process the newest one gets it: a cell may be run again. A torn last line is
        removed, and its size returned.
        """
        place = os.path.realpath(self.path)
        if (other := self._holders.get(place)) is not None:
            other.release()
        with self._locked() as file:
            self._held = os.fdopen(os.dup(file.fileno()), "r+b", buffering=0)
            weakref.finalize(self, self._held.close)
            self._holders[place] = self
            torn = self._end - self._size
            file.truncate(self._size)
            os.fsync(file.fileno())
            self._end = self._size
        return torn

    def release(self) -> None:
        """Let others write to the file."""
        if self._held is not None:
            self._held.close()
            self._held = None

    @contextlib.contextmanager
    def _locked(self) -> Iterator[FileIO]:
        """Open the file for writing, locked, and check that it is as it was left."""
        with (
            open(self.path, "r+b", buffering=0) if self._held is None else _kept(self._held) as file
        ):
            if self._held is None and not try_lock(file):
                raise BlockingIOError(
                    f"{self.path} is in use: another session writes its answers to this log"
                )
            now, there = os.fstat(file.fileno()), os.stat(self.path)
            if now.st_size != self._end or not os.path.samestat(now, there):
                raise ValueError(
                    f"log must be as it was left, but {self.path} was changed by somebody else: "
                    "load it again"
                )
            yield file


def _kept(file: FileIO) -> contextlib.AbstractContextManager[FileIO]:
    return contextlib.nullcontext(file)


def encoded(line: dict[str, Any]) -> bytes:
    """Return a line of the log."""
    return (json.dumps(to_json(to_numpy(line)), ensure_ascii=False) + "\n").encode()
