"""The files in the book that hold what the studies drew."""

from __future__ import annotations

import json
import os
from pathlib import Path

from studies import COLUMNS

# A draw of every study takes ten minutes: a part of it does, unless all is asked for.
WHOLE = os.environ.get("PREFMPC_STUDIES") == "all"
BOOK = Path(__file__).parents[1] / "book"
TIME = COLUMNS.index("time s")


def head_of(path, least=50):
    head = json.loads(path.read_text(encoding="utf-8"))
    seeds = head["seeds"]
    assert seeds == list(range(len(head.pop("draws"))))
    assert len(seeds) >= least
    return {name: tuple(value) for name, value in head.items()}, len(seeds)
