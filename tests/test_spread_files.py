"""The files of the studies: what was drawn comes back, and no interrupted write harms them."""

from __future__ import annotations

import json
import sys

import jax
import numpy as np
import pytest
from stored_studies import BOOK

from studies import __main__, quantiles, read_spread, write_spread

DRAWS = [
    {"table": np.array([[1.0, np.nan], [np.inf, 2.00004]]), "number": np.array(3.0)},
    {"table": np.array([[-np.inf, 0], [-1e-9, 1e6]]), "number": np.nan},
]
HEAD = {"rows": ["σ₂₀", "Π"], "columns": ["a", "b"], "seeds": [0, 1]}


def test_files_give_back_what_was_drawn(tmp_path):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    stored = read_spread(str(path))
    assert list(stored) == ["table", "number"]
    np.testing.assert_array_equal(
        stored["table"], [[[1, np.nan], [np.inf, 2]], [[-np.inf, 0], [-1e-9, 1e6]]]
    )  # four decimals, and small numbers stay
    np.testing.assert_array_equal(stored["number"], [3, np.nan])
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) == len(DRAWS) + 2  # a line for each draw, to see what changed
    assert {**json.loads(text), "draws": None} == {**HEAD, "draws": None}
    assert "σ₂₀" in text
    assert [p.name for p in tmp_path.iterdir()] == ["spread.json"]


@pytest.mark.parametrize("broken", ["os.replace", "os.fsync"])
def test_an_interrupted_write_leaves_the_old_file_whole(tmp_path, monkeypatch, broken):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    before = path.read_bytes()

    def refuse(*args):
        raise OSError("full")

    monkeypatch.setattr(broken, refuse)
    with pytest.raises(OSError, match="full"):
        write_spread(path, HEAD, DRAWS[:1])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_draw_that_cannot_be_written_leaves_the_old_file_whole(tmp_path):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_spread(path, HEAD, [*DRAWS, {"table": "soon"}])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_quantiles_are_values_and_may_be_infinite():
    draws = np.array([[3, 1], [1, np.inf], [2, np.inf], [np.inf, np.inf]])
    np.testing.assert_array_equal(quantiles(draws, 0.5), [2, np.inf])
    np.testing.assert_array_equal(quantiles(draws, [0, 0.75, 1])[:, 0], [1, 3, np.inf])


def test_the_command_line_writes_the_draws_of_the_first_seeds(tmp_path, monkeypatch):
    def study(*, key):
        return {"table": jax.random.key_data(key).astype(float)}

    monkeypatch.setitem(__main__.STUDIES, "quadratic", (study, "new/spread.json", {"rows": ["a"]}))
    monkeypatch.setattr(__main__, "BOOK", tmp_path)
    monkeypatch.setattr(sys, "argv", ["studies", "quadratic", "--draws", "3"])
    __main__.main()
    path = tmp_path / "new" / "spread.json"
    np.testing.assert_array_equal(read_spread(path)["table"], [[0, 0], [0, 1], [0, 2]])
    assert json.loads(path.read_text(encoding="utf-8"))["seeds"] == [0, 1, 2]
    other = tmp_path / "other.json"
    monkeypatch.setattr(sys, "argv", [*sys.argv[:2], "--draws", "1", "--out", str(other)])
    __main__.main()
    assert read_spread(other)["table"].shape == (1, 2)


def test_every_study_has_a_file_in_the_book():
    files = {name for _, name, _ in __main__.STUDIES.values()}
    assert {str(path.relative_to(BOOK)) for path in BOOK.rglob("*_spread.json")} == files
