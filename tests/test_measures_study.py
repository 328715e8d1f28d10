"""The study of the measures: the stored file is what the code gives, and its parts."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from stored_studies import BOOK, WHOLE, head_of

from prefmpc import QuadraticPreference, Trajectory, lqr_pool, oscillating_masses, phi
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS, measures_case, read_spread
from studies import measures as measuring

MEASURES_SPREAD = BOOK / "insight" / "measures_spread.json"
KEY = jax.random.key(2000)


@pytest.fixture(scope="module")
def measured():
    # The two smaller sizes: n = 400 takes as long as both, and they do not depend on it.
    return measures_case(key=jax.random.key(0), sizes=measuring.SIZES[: 3 if WHOLE else 2])


def test_the_book_s_measures_are_what_the_code_gives(measured):
    stored = {name: values[0] for name, values in read_spread(MEASURES_SPREAD).items()}
    assert measured.keys() == stored.keys()
    np.testing.assert_allclose(measured["baselines"], stored["baselines"], atol=0.5)
    np.testing.assert_allclose(measured["leak"], stored["leak"][: len(measured["leak"])], atol=1)
    kept = [i for i, name in enumerate(measuring.MODELS) if WHOLE or "400" not in name]
    table, expected = measured["models"], stored["models"][kept]
    # The recipe stops early, so that rounding moves where: some pairs of 2000, and of 500.
    np.testing.assert_allclose(table[:, 0], expected[:, 0], atol=1.5)
    np.testing.assert_allclose(table[:, 1], expected[:, 1], atol=2.5)
    np.testing.assert_allclose(table[:, 2], expected[:, 2], rtol=0.1, atol=2)


def test_the_stored_measures_are_complete():
    head, count = head_of(MEASURES_SPREAD, least=30)
    assert head["models"] == measuring.MODELS
    assert head["columns"] == measuring.MODEL_COLUMNS
    stored = read_spread(MEASURES_SPREAD)
    shapes = {
        "baselines": (len(measuring.BASELINES), len(measuring.BASELINE_COLUMNS)),
        "leak": (len(measuring.SIZES), len(measuring.LEAK_COLUMNS)),
        "models": (len(measuring.MODELS), len(measuring.MODEL_COLUMNS)),
    }
    assert {name: values.shape for name, values in stored.items()} == {
        name: (count, *shape) for name, shape in shapes.items()
    }
    assert all(np.isfinite(values).all() for values in stored.values())


def test_nobody_is_better_at_being_the_person_than_the_person(measured):
    table = measured["models"]
    # Π agrees with itself, loses nothing but what 10 steps of 30 cost, and beats at random.
    np.testing.assert_array_equal(table[0, :2], 100)
    assert (table[:, 2] >= 0).all()
    assert table[0, 2] == table[:, 2].min() < 1
    assert table[0, 3] > 90
    # The rule that looks at x(0) alone knows nothing where all start alike.
    np.testing.assert_allclose(measured["baselines"][1, [1, 3]], 50, atol=10)


def test_states_are_repeated_in_a_row():
    x = measuring.starts_repeated(KEY, 3, 2)
    assert x.shape == (6, 6)
    np.testing.assert_array_equal(x[::2], x[1::2])
    assert len(np.unique(x, axis=0)) == 3
    y = np.arange(18.0).reshape(3, 6)
    T = Trajectory(np.stack([y, y], axis=1), np.zeros((3, 1, 2)))
    np.testing.assert_array_equal(measuring.first_position(T), [5, 149, 509])  # 0 + 1 + 4, …


def test_an_unsure_person_errs_as_often_as_asked():
    pool = lqr_pool(oscillating_masses(), 20, 10, key=KEY, radius=RADIUS, saturate=False)
    cost = phi(pool, QUADRATIC_Q, QUADRATIC_R)
    i, j = np.triu_indices(20, 1)
    for error in (0.02, 0.1):
        scale = measuring.unsure_scale(pool, error)
        wrong = 1 / (1 + np.exp(np.abs(cost[i] - cost[j]) / scale))
        assert wrong.mean() == pytest.approx(error, rel=1e-6)


def test_pairs_of_the_same_start():
    person = QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
    rng = np.random.default_rng(0)
    data = measuring.same_start_data(oscillating_masses(), 5, person, 30, rng, starts=4, copies=3)
    assert (len(data), len(data.trajectories)) == (30, 12)
    np.testing.assert_array_equal(data.first // 3, data.second // 3)
    assert (data.first != data.second).all()
