"""The studies of settling times: what the code gives is what the book says."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from stored_studies import BOOK, TIME, head_of

from prefmpc import Trajectory, accuracy, max_input, settling_time
from studies import (
    PAPER_TABLE_II,
    SETTLING_COLUMNS,
    SETTLING_ROWS,
    SETTLING_SIZES,
    SETTLING_VARIANTS,
    diagonal_weights,
    read_spread,
    settling_case,
    settling_data,
    ties_case,
)
from studies.settling import TIES_COLUMNS, TIES_ROWS, coarse_preference

SETTLING_SPREAD = BOOK / "case_studies" / "settling_spread.json"
TIES_SPREAD = BOOK / "case_studies" / "ties_spread.json"
KEY = jax.random.key(2000)


@pytest.fixture(scope="module")
def settled():
    return settling_case(key=jax.random.key(0))


def test_the_book_s_settling_table_is_what_the_code_gives(settled):
    stored = read_spread(SETTLING_SPREAD)
    table = stored["table"][0]
    assert np.isnan(table[..., TIME]).all()
    kept = [0, 1, 3, 5]
    np.testing.assert_array_equal(np.isnan(settled.table[..., kept]), np.isnan(table[..., kept]))
    np.testing.assert_allclose(settled.table[..., :2], table[..., :2], atol=1)
    np.testing.assert_allclose(settled.table[..., 3], table[..., 3], atol=1)
    np.testing.assert_allclose(settled.table[..., 5], table[..., 5], rtol=0.05)
    assert settled.data_kappa == stored["data κ"][0]


def test_the_stored_settling_tables_are_complete():
    head, count = head_of(SETTLING_SPREAD)
    assert head["variants"] == SETTLING_VARIANTS == tuple(PAPER_TABLE_II)
    assert head["rows"] == SETTLING_ROWS
    assert head["columns"] == SETTLING_COLUMNS
    stored = read_spread(SETTLING_SPREAD)
    assert stored["table"].shape == (count, 2, len(SETTLING_ROWS), len(SETTLING_COLUMNS))
    assert not np.isnan(stored["table"][..., 3:]).any()  # but inf: some never settle
    assert np.isfinite(stored["table"][..., 5]).all()
    assert stored["data κ"].shape == (count,)


def test_the_settling_table_is_made_of_the_loops(settled):
    reference = settled.loops["with Πᵤ"]["Random"].x[:, 0]
    for v, variant in enumerate(SETTLING_VARIANTS):
        for r, name in enumerate(SETTLING_ROWS):
            loops = settled.loops[variant][name]
            assert loops.batch_shape == (200,)
            np.testing.assert_array_equal(loops.x[:, 0], reference)
            kappa = settling_time(loops, 0.1)
            expected = [np.median(kappa), kappa.max(), max_input(loops).mean()]
            np.testing.assert_allclose(settled.table[v, r, 3:], expected, rtol=1e-12)
        for r, n in enumerate(SETTLING_SIZES, start=2):
            model = settled.fits[variant][n].model
            shares = [settled.train[variant][n], settled.test[variant]]
            expected = [100 * accuracy(model, data) for data in shares]
            np.testing.assert_allclose(settled.table[v, r, :2], expected)
    assert settled.data_kappa == np.median(settling_time(settled.pool, 0.1))


def test_both_variants_ask_about_the_same_pairs():
    system, pool, train, test = settling_data(key=KEY, sizes=(20, 300))
    assert np.isinf(system.u_max).all()
    sets = {n: [train[v][n] for v in SETTLING_VARIANTS] for n in (20, 300)}
    sets[500] = [test[v] for v in SETTLING_VARIANTS]
    for n, (broken, left_out) in sets.items():
        assert len(broken) == n
        assert set(broken.labels) == {0, 1}
        kappa = settling_time(broken.trajectories)
        first, second = kappa[broken.first], kappa[broken.second]
        decided = broken.subset(first != second)
        assert 0 < len(decided) < n or n == 20
        for name in ("first", "second", "labels"):
            np.testing.assert_array_equal(getattr(left_out, name), getattr(decided, name))
        np.testing.assert_array_equal(decided.labels, (first < second)[first != second])
    assert not np.isin(test["with Πᵤ"].trajectories.x, pool.x).any()


def test_the_weights_of_the_settling_data_are_diagonal():
    Q, R = diagonal_weights(KEY, 400)
    for weights, low, high in ((Q[:, :3, :3], 5, 20), (Q[:, 3:, 3:], 0.1, 1), (R, 0.1, 1)):
        diagonal = np.diagonal(weights, axis1=1, axis2=2)
        assert ((diagonal >= low) & (diagonal <= high)).all()
        np.testing.assert_allclose(diagonal.mean(0), (low + high) / 2, rtol=0.1)
    np.testing.assert_array_equal(Q, Q * np.eye(6))
    np.testing.assert_array_equal(R, R * np.eye(2))


def test_the_book_s_ties_are_what_the_code_gives():
    stored = read_spread(TIES_SPREAD)["table"]
    head, count = head_of(TIES_SPREAD)
    assert (head["rows"], head["columns"]) == (TIES_ROWS, TIES_COLUMNS)
    assert stored.shape == (count, len(TIES_ROWS), len(TIES_COLUMNS))
    table = ties_case(key=jax.random.key(0))
    np.testing.assert_allclose(table[:, 0], stored[0, :, 0], rtol=1e-12)
    np.testing.assert_allclose(table[:, [1, 3]], stored[0][:, [1, 3]], atol=1)
    np.testing.assert_allclose(table[:, [2, 4]], stored[0][:, [2, 4]], rtol=0.1)
    # A coarser clock has more ties. Without Πᵤ it does not matter how its arguments stand.
    assert table[0, 0] < table[1, 0] < table[2, 0]
    np.testing.assert_array_equal(table[3, [0, 3, 4]], table[0, [0, 3, 4]])


def test_a_coarse_clock_by_hand():
    # κ = 1, 2, 3 and never, with inputs 4, 3, 2 and 1.
    y = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1.0]])[..., None]
    T = Trajectory(
        np.zeros((4, 5, 1)), np.ones((4, 4, 1)) * np.arange(4.0, 0, -1)[:, None, None], y
    )
    first, second = T[[0, 1, 1, 2, 2]], T[[1, 0, 2, 1, 3]]
    for resolution, swapped, answers in (
        (1, False, [1, 0, 1, 0, 1]),
        (2, False, [1, 0, 0, 1, 1]),  # readings 0, 1, 1 and never
        (4, False, [0, 1, 0, 1, 1]),
        (4, True, [1, 0, 1, 0, 1]),
    ):
        ask = coarse_preference(resolution, tie_break=True, swapped=swapped)
        np.testing.assert_array_equal(ask(first, second), answers)
    drop = coarse_preference(2, tie_break=False)
    np.testing.assert_array_equal(drop(first, second), [1, 0, np.nan, np.nan, 1])
