"""`fit_network`: it learns, it stops where held-out answers suffer, and it says how it went."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import (
    Comparisons,
    FitError,
    ICNNCost,
    MLPCost,
    QuadraticCost,
    accuracy,
    fit_network,
    logistic,
    lqr_pool,
    oscillating_masses,
)
from prefmpc.learning import early_stopping
from prefmpc.learning.early_stopping import _batches
from prefmpc.learning.losses import cross_entropy, padded_size, pair_data
from studies import RADIUS

KEY = jax.random.key(3000)
MASSES = oscillating_masses()
POOL = lqr_pool(MASSES, 60, 10, key=jax.random.key(3001), radius=RADIUS, saturate=False)
FRESH = lqr_pool(MASSES, 60, 10, key=jax.random.key(3002), radius=RADIUS, saturate=False)
SCALE = np.concatenate([np.abs(POOL.x).max((0, 1)), [1, 1]])
TASTE = MLPCost.random(SCALE / 3, key=jax.random.key(3003), widths=(6,))
QUADRATIC = QuadraticCost(np.diag(1 / SCALE[:6] ** 2), np.eye(2))
STARTS = MLPCost.random(SCALE, key=jax.random.key(3004), widths=(8,), shape=(3,))


def person(sigma):
    def prefers(first, second):
        return (np.asarray(sigma(first)) < np.asarray(sigma(second))).astype(float)

    return prefers


def data_of(sigma, size=250):
    train = Comparisons.random(POOL, person(sigma), size, key=jax.random.key(3005))
    return train, Comparisons.random(FRESH, person(sigma), 400, key=jax.random.key(3006))


NOISY = Comparisons.random(POOL, logistic(TASTE, 1.0), 80, key=KEY).sampled(key=KEY)


@pytest.mark.parametrize("sigma", [TASTE, QUADRATIC], ids=["network", "quadratic"])
def test_it_learns_a_person(sigma):
    train, test = data_of(sigma)
    result = fit_network(train, STARTS, key=KEY, max_epochs=400)
    assert result.success
    assert accuracy(result.model, test) > 0.8
    assert accuracy(STARTS[0], test) < 0.75
    np.testing.assert_array_equal(result.model.c, result.models.c[result.chosen])
    assert f"restart {result.chosen} chosen" in result.message


@pytest.fixture(scope="module")
def stopped():
    return fit_network(NOISY, STARTS, key=KEY, l2=0.0, learning_rate=0.03, patience=5)


def test_it_stops_where_held_out_answers_suffer(stopped):
    assert (stopped.status == "stopped").all()
    checks = len(stopped.epochs)
    assert stopped.validation_loss.shape == stopped.training_loss.shape == (checks, 3)
    np.testing.assert_array_equal(stopped.epochs, 10 * np.arange(1, checks + 1))
    for i in range(3):
        history = stopped.validation_loss[:, i]
        ran = np.isfinite(history).sum()
        assert np.isnan(history[ran:]).all()
        assert np.nanargmin(history) == stopped.best[i]
        assert ran - 1 == stopped.best[i] + 5  # patience
        assert stopped.training_loss[ran - 1, i] < stopped.training_loss[stopped.best[i], i]
    best = stopped.validation_loss[stopped.best, np.arange(3)]
    assert stopped.chosen == np.argmin(best)
    assert f"{best.min():.4g}" in stopped.message
    assert "3 stopped" in stopped.message


def test_the_models_are_those_of_their_best_moment():
    train, test = NOISY.subset(np.arange(50)), NOISY.subset(np.arange(50, 80))
    result = fit_network(train, STARTS, key=KEY, validation=test, patience=5, learning_rate=0.03)
    for i in range(3):
        model = jax.tree.map(lambda leaf, i=i: leaf[i], result.models)
        for data, losses in ((test, result.validation_loss), (train, result.training_loss)):
            expected = cross_entropy(model, pair_data(model, data))
            assert losses[result.best[i], i] == pytest.approx(float(expected), rel=1e-8)


def test_the_same_key_gives_the_same_result(stopped):
    again = fit_network(NOISY, STARTS, key=KEY, l2=0.0, learning_rate=0.03, patience=5)
    np.testing.assert_array_equal(again.validation_loss, stopped.validation_loss)
    np.testing.assert_array_equal(again.model.W[0], stopped.model.W[0])
    other = fit_network(
        NOISY, STARTS, key=jax.random.key(1), l2=0.0, learning_rate=0.03, patience=5
    )
    assert other.validation_loss[0, 0] != stopped.validation_loss[0, 0]


def test_too_few_epochs_are_said():
    train, _ = data_of(QUADRATIC)
    result = fit_network(train, STARTS, key=KEY, max_epochs=15)
    assert (result.status == "max_epochs").all()
    np.testing.assert_array_equal(result.epochs, [10, 20])
    assert "3 max_epochs" in result.message


def test_mini_batches_learn_as_well():
    train, test = data_of(QUADRATIC)
    options = {"key": KEY, "max_epochs": 150}
    whole = fit_network(train, STARTS, **options)
    parts = fit_network(train, STARTS, batch_size=64, **options)
    assert parts.success
    assert accuracy(parts.model, test) > accuracy(whole.model, test) - 0.05
    # More steps in as many passes: less is left of the training loss at the same epoch.
    assert np.nanmin(parts.training_loss) < np.nanmin(whole.training_loss[: len(parts.epochs)])


def test_restarts_that_leave_the_numbers_are_not_chosen():
    bad = jax.tree.map(np.copy, STARTS)
    bad.c[1] = np.nan
    result = fit_network(NOISY, bad, key=KEY, max_epochs=50)
    assert result.status[1] == "not_finite"
    assert result.chosen in (0, 2)
    assert set(result.status[[0, 2]]) <= {"stopped", "max_epochs"}
    assert np.isfinite(result.model.c).all()
    assert "1 not_finite" in result.message
    with pytest.warns(RuntimeWarning, match="3 not_finite; none usable"):
        none = fit_network(
            NOISY, jax.tree.map(lambda leaf: leaf * np.nan, STARTS), key=KEY, max_epochs=50
        )
    assert not none.success
    assert none.chosen is None
    with pytest.raises(FitError, match="none usable"):
        _ = none.model


def test_convex_networks_stay_convex():
    train, test = data_of(QUADRATIC)
    kind = {"activation": "squared_relu", "widths": (6, 4), "shape": (2,), "bias": False}
    starts = ICNNCost.random(SCALE, key=KEY, **kind)
    result = fit_network(train, starts, key=KEY, max_epochs=200, learning_rate=0.03)
    assert min(leaf.min() for leaf in (*result.models.U, result.models.c)) >= 0
    assert not result.model.b[0].any()
    assert accuracy(result.model, test) > 0.75


def network(comparisons=NOISY, initial=STARTS, **options):
    return fit_network(comparisons, initial, **{"key": KEY, "max_epochs": 10, **options})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_network(POOL, STARTS, key=KEY), "comparisons must be a Comparisons, got Traj"),
        (lambda: network(initial=STARTS[0]), "initial must be stacked .*, got a single model"),
        (lambda: network(initial=3), "initial must be a stack of σ models, got int"),
        (lambda: network(initial=MLPCost.random([1.0], key=KEY, shape=(2,))), "must have 1 states"),
        (lambda: network(validation=POOL), "validation must be a Comparisons"),
        (lambda: network(validation_fraction=0), r"validation_fraction must lie in \(0, 1\)"),
        (lambda: network(validation_fraction=1.0), r"validation_fraction must lie in \(0, 1\)"),
        (lambda: network(validation_fraction=np.nan), r"validation_fraction must lie in \(0, 1\)"),
        (lambda: network(NOISY.subset([0])), "comparisons must hold enough pairs to split"),
        (lambda: network(l2=-1), "l2 must be finite and at least 0"),
        (lambda: network(learning_rate=np.inf), "learning_rate must be finite"),
        (lambda: network(max_epochs=0), "max_epochs must be a whole number"),
        (lambda: network(patience=0), "patience must be a whole number"),
        (lambda: network(batch_size=0), "batch_size must be a whole number"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(("n", "size"), [(1025, 1024), (1500, 1400), (2048, 256), (4097, 1024)])
def test_an_epoch_takes_each_pair_once_whatever_the_sizes(n, size):
    padded = padded_size(n)
    rows, steps = _batches(n, padded, size, np.random.default_rng(0))
    for epoch in np.split(rows[:steps], 10):
        np.testing.assert_array_equal(np.sort(epoch[epoch < padded]), np.arange(n))
        used = (epoch < padded).sum(axis=1)
        assert used.max() - used.min() <= 1
        assert len(used) == -(-n // size)
    again, _ = _batches(n + 1 if n < padded else n - 1, padded, size, np.random.default_rng(0))
    assert again.shape == rows.shape  # nothing to compile for another number of pairs
    assert _batches(size, padded, size, np.random.default_rng(0)) is None


def test_a_part_of_a_batch_that_is_free_counts_for_nothing():
    data = jax.device_put(pair_data(STARTS, NOISY, 1024))
    part = data.part(np.array([3, 7, 1024, 1024]))
    alone = data.part(np.array([3, 7]))
    assert float(cross_entropy(STARTS[0], part)) == pytest.approx(
        float(cross_entropy(STARTS[0], alone)), rel=1e-12
    )


def test_a_weight_that_is_not_a_number_is_seen_though_the_losses_are_finite(monkeypatch):
    advance = early_stopping._advance

    def broken(*arguments):
        (models, memory), losses = advance(*arguments)
        models = jax.tree.map(lambda leaf: leaf.at[1].set(np.nan), models)
        return (models, memory), losses

    monkeypatch.setattr(early_stopping, "_advance", broken)
    result = fit_network(NOISY, STARTS, key=KEY, max_epochs=10)
    assert np.isfinite(result.validation_loss[0]).all()
    assert result.status[1] == "not_finite"
    assert result.chosen != 1
