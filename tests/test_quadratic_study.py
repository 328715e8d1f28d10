"""The studies of case study 1: repeatable, and what the book says."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from stored_studies import BOOK, TIME, head_of

from prefmpc import accuracy, phi
from prefmpc.learning.training import best_restart
from studies import (
    COLUMNS,
    PAPER_TABLE_I,
    QUADRATIC_Q,
    QUADRATIC_R,
    ROWS,
    SIZES,
    VARIANTS,
    distinct_case,
    error_rates,
    quadratic_case,
    quadratic_data,
    read_spread,
)
from studies.quadratic import DISTINCT_COLUMNS, DISTINCT_ROWS

SPREAD = BOOK / "case_studies" / "quadratic_spread.json"
DISTINCT_SPREAD = BOOK / "case_studies" / "distinct_spread.json"


@pytest.fixture(scope="module")
def draw():
    return quadratic_case(key=jax.random.key(0))


def test_the_book_s_table_is_what_the_code_gives(draw):
    stored = read_spread(SPREAD)["paper"][0]
    kept = [i for i in range(len(COLUMNS)) if i != TIME]
    shares, costs = kept[:2], kept[2:]
    np.testing.assert_array_equal(np.isnan(draw.table[:, kept]), np.isnan(stored[:, kept]))
    np.testing.assert_allclose(draw.table[:, shares], stored[:, shares], atol=0.5)
    np.testing.assert_allclose(draw.table[:, costs], stored[:, costs], atol=0.02)
    assert np.isnan(stored[:, TIME]).all()  # times belong to a machine


def test_the_stored_tables_are_complete():
    head, count = head_of(SPREAD)
    assert head["rows"] == ROWS == tuple(PAPER_TABLE_I)
    assert head["columns"] == COLUMNS
    stored = read_spread(SPREAD)
    assert tuple(stored) == VARIANTS
    for tables in stored.values():
        assert tables.shape == (count, len(ROWS), len(COLUMNS))
        assert np.isfinite(tables[:, :, 3:]).all()


def test_a_draw_is_deterministic(draw):
    again = quadratic_case(key=jax.random.key(0))
    kept = np.arange(len(COLUMNS)) != TIME
    np.testing.assert_array_equal(again.table[:, kept], draw.table[:, kept])
    np.testing.assert_array_equal(again.pool.x, draw.pool.x)


def test_the_table_is_made_of_the_loops(draw):
    assert list(draw.phi) != []
    reference = np.asarray(phi(draw.loops["From Π"], QUADRATIC_Q, QUADRATIC_R)).mean()
    for row, name in enumerate(ROWS):
        values = np.asarray(phi(draw.loops[name], QUADRATIC_Q, QUADRATIC_R)) / reference
        assert values.shape == (200,)
        np.testing.assert_allclose(
            draw.table[row, 3:], [values.mean(), values.max(), values.min()], rtol=1e-12
        )
        # All controllers start from the same states, and none leaves the input bounds.
        np.testing.assert_array_equal(draw.loops[name].x[:, 0], draw.loops["From Π"].x[:, 0])
        assert (np.abs(draw.loops[name].u) <= 1).all()
    assert draw.table[0, 3] == pytest.approx(1)
    for row, n in enumerate(SIZES, start=2):
        model = draw.fits[n].model
        assert draw.table[row, 1] == pytest.approx(100 * accuracy(model, draw.test))
    # What the study is about: more answers help, and even 20 beat guessing.
    assert draw.table[6, 3] < draw.table[2, 3] < draw.table[1, 3]


def test_data_are_drawn_apart():
    _, pool, train, test = quadratic_data(key=jax.random.key(2000))
    assert [len(train[n]) for n in SIZES] == list(SIZES)
    assert len(test) == 500
    assert not np.isin(test.trajectories.x, pool.x).any()
    _, pool, _, test = quadratic_data(key=jax.random.key(2000), shared_pool=True)
    np.testing.assert_array_equal(test.trajectories.x, pool.x)


def test_error_rates_are_one_minus_accuracy(draw):
    models = draw.fits[20].models
    expected = [1 - accuracy(models[i], draw.test) for i in (0, 5)]
    np.testing.assert_allclose(error_rates(models, draw.test)[[0, 5]], expected, atol=1e-12)


def test_the_best_restart_is_one_that_may_be_used():
    good, bad = "converged", "out_of_bounds"
    assert best_restart([0.0, 2, 1], np.array([bad, good, good]), np.zeros(3)) == 2
    assert best_restart([1.0, 1, 1], np.array([good] * 3), np.array([3.0, 1, 2])) == 1
    assert best_restart([np.nan, 1], np.array([bad, good]), np.array([np.nan, 1])) == 1
    assert best_restart([0.0, 1], np.array([bad, bad]), np.zeros(2)) is None


def test_the_book_s_distinct_pairs_are_what_the_code_gives():
    stored = read_spread(DISTINCT_SPREAD)["table"]
    head, count = head_of(DISTINCT_SPREAD)
    assert (head["rows"], head["columns"]) == (DISTINCT_ROWS, DISTINCT_COLUMNS)
    assert stored.shape == (count, len(DISTINCT_ROWS), len(DISTINCT_COLUMNS))
    table = distinct_case(key=jax.random.key(0))
    np.testing.assert_allclose(table[:, :2], stored[0, :, :2], atol=0.5)
    np.testing.assert_allclose(table[:, 2], stored[0, :, 2], atol=0.02)
