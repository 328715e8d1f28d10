"""Threads that share a solver take turns; copies of its owner get one of their own."""

from __future__ import annotations

import threading
from typing import Any


class Turns:
    """Owns a lock, and a solver that is set up when it is needed: no copy can share these."""

    _lock: Any
    _solver: Any

    def __init__(self) -> None:
        self.__setstate__({})

    def __getstate__(self) -> dict[str, Any]:
        """Return all that a copy can have."""
        return {k: v for k, v in self.__dict__.items() if k not in ("_solver", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what was pickled or copied."""
        self.__dict__.update(state, _solver=None, _lock=threading.RLock())
