"""The files in the book that hold what the studies drew."""

from __future__ import annotations

import json
from pathlib import Path

from studies import COLUMNS

BOOK = Path(__file__).parents[1] / "book"
TIME = COLUMNS.index("time s")


def head_of(path, least=50):
    head = json.loads(path.read_text(encoding="utf-8"))
    seeds = head["seeds"]
    assert seeds == list(range(len(head.pop("draws"))))
    assert len(seeds) >= least
    return {name: tuple(value) for name, value in head.items()}, len(seeds)
