"""The stored race of the competitors: a table of what was drawn."""

from __future__ import annotations

import json

import numpy as np
from stored_studies import BOOK

from studies import read_spread
from studies.asking import COUNTS, PEOPLE

PATH = BOOK / "extensions" / "asking_peers.json"


def test_the_table_is_that_of_the_draws():
    head = json.loads(PATH.read_text(encoding="utf-8"))
    regret = read_spread(PATH)["regret"]
    shape = len(head["people"]), len(head["strategies"]), len(head["counts"])
    assert regret.shape == (len(head["seeds"]), *shape)
    assert head["seeds"] == list(range(len(regret)))
    assert set(head["people"]) <= set(PEOPLE)
    assert head["counts"] == list(COUNTS)
    rows = head["table"]
    columns = ("median", "quantile 90 %", "median from", "median to")
    median, most, low, high = (np.array([r[c] for r in rows]).reshape(shape) for c in columns)
    assert {r["draws"] for r in rows} == {len(regret)}
    np.testing.assert_allclose(median, np.median(regret, axis=0), atol=2e-4)
    np.testing.assert_allclose(most, np.quantile(regret, 0.9, axis=0), atol=2e-4)
    assert (low <= median).all()
    assert (median <= high).all()
    assert [rows[0][name] for name in ("people", "competitor", "answers")] == [
        head["people"][0],
        head["strategies"][0],
        head["counts"][0],
    ]
