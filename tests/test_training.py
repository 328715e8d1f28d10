"""The recipe against SciPy, and every way to fail."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_comparisons import COST, FEW, POOL, Distance
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize

from prefmpc import Comparisons, FitError, ICNNCost, QuadraticCost, accuracy, fit
from prefmpc.learning import training
from prefmpc.learning.losses import cross_entropy, objective, pair_data
from studies import error_rates

KEY = jax.random.key(2000)


# The recipe itself. All fits below share a shape: two compilations, without l1 and with it.


@pytest.fixture(scope="module")
def learned(data):
    _, _, train, _ = data
    return fit(train[400], key=KEY)


def test_fit_learns_and_stays_within_the_bounds(learned, data):
    _, _, _, test = data
    assert learned.success
    assert set(learned.status) == {"converged"}
    assert (learned.error <= 1e-3).all()
    low, _ = learned.models.bounds()
    assert (np.asarray(learned.models.theta) >= np.asarray(low.theta)).all()
    guesses = QuadraticCost.random(6, 2, key=jax.random.key(1), shape=(20,))
    guessed = 1 - error_rates(guesses, test).mean()
    assert guessed < 0.85
    assert accuracy(learned.model, test) > 0.92
    assert f"restart {learned.chosen} chosen by validation" in learned.message


def test_fit_is_deterministic(learned, data):
    again = fit(data[2][400], key=KEY)
    np.testing.assert_array_equal(again.models.theta, learned.models.theta)
    assert again.chosen == learned.chosen
    other = fit(data[2][400], key=jax.random.key(1))
    assert np.abs(other.models.theta - learned.models.theta).max() > 0.1


def test_what_fit_reports_is_what_its_models_do(data):
    train = data[2]
    result = fit(train[60], key=KEY, selection="training_loss", l2=1e-3)
    plain = pair_data(result.models, train[60])
    for i in (0, 7, 19):
        model = result.models[i]
        assert result.training_loss[i] == pytest.approx(float(objective(model, plain, l2=1e-3)))
        assert result.training_accuracy[i] == pytest.approx(accuracy(model, train[60]))
    assert result.chosen == result.training_loss.argmin()
    np.testing.assert_array_equal(result.selection_score, result.training_loss)
    np.testing.assert_array_equal(result.model.theta, result.models.theta[result.chosen])


def test_validation_scores_pairs_that_training_never_saw(learned, data, monkeypatch):
    train = data[2][400]
    seen = []
    inner = training._train

    def spy(starts, pairs, *rest):
        seen.append(pairs.weights)
        return inner(starts, pairs, *rest)

    monkeypatch.setattr(training, "_train", spy)
    fit(train, key=KEY)
    held_out = np.flatnonzero(seen[0][:400] == 0)
    assert held_out.size == 80  # 20 % of 400
    assert not seen[0][400:].any()
    scores = [
        float(cross_entropy(learned.models[i], pair_data(learned.models, train.subset(held_out))))
        for i in range(20)
    ]
    np.testing.assert_allclose(learned.selection_score, scores, rtol=1e-10)
    assert learned.chosen == np.argmin(scores)
    # Their labels may be anything: the models do not change, only the scores.
    labels = train.labels.copy()
    labels[held_out] = 1 - labels[held_out]
    lied = fit(Comparisons(train.trajectories, train.first, train.second, labels), key=KEY)
    np.testing.assert_array_equal(lied.models.theta, learned.models.theta)
    assert (lied.selection_score != learned.selection_score).all()


def test_the_paper_s_selection_takes_the_best_on_the_test_pairs(data):
    _, _, train, test = data
    result = fit(train[20], key=KEY, selection="leaky_test_accuracy", test=test)
    errors = error_rates(result.models, test)
    np.testing.assert_allclose(result.selection_score, errors, atol=1e-12)
    best = np.flatnonzero(errors <= errors.min() + 1e-12)
    assert result.chosen == best[result.training_loss[best].argmin()]


def scipy_optimum(comparisons, start, l2, l1):
    """Solve the same problem with SciPy, the signs of θ split where there is an l1."""
    start, unravel = ravel_pytree(start)
    low = np.asarray(ravel_pytree(unravel(start).bounds()[0])[0])
    pairs = pair_data(unravel(start), comparisons)
    smooth = jax.jit(jax.value_and_grad(lambda v: objective(unravel(v), pairs, l2=l2)))
    n, start = start.size, np.asarray(start)

    def split(z):
        value, slope = smooth(z[:n] - z[n:])
        slope = np.asarray(slope)
        return float(value) + l1 * z.sum(), np.concatenate([slope + l1, l1 - slope])

    free = np.isinf(low)
    bounds = [(0 if f else b, None) for f, b in zip(free, low, strict=True)]
    bounds += [(0, None if f else 0) for f in free]
    result = minimize(
        split,
        np.concatenate([np.maximum(start, 0), np.maximum(-start, 0)]),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 20_000, "maxfun": 40_000, "ftol": 1e-15, "gtol": 1e-9},
    )
    return result.fun


@pytest.mark.parametrize(("l2", "l1"), [(1e-2, 0.0), (1e-6, 1e-2)], ids=["ridge", "l1"])
def test_the_optimum_is_that_of_scipy(data, l2, l1):
    train = data[2][400]
    result = fit(
        train, key=KEY, selection="training_loss", l2=l2, l1=l1, tol=1e-5, max_iterations=3000
    )
    # The problem has several local optima: SciPy finds nothing better near the one that was
    # chosen, and not from another start either.
    start = QuadraticCost.random(6, 2, key=jax.random.key(3))
    best = result.training_loss[result.chosen]
    assert scipy_optimum(train, result.model, l2, l1) == pytest.approx(best, rel=1e-5)
    assert best <= scipy_optimum(train, start, l2, l1) * (1 + 1e-5)
    if l1:
        theta = np.asarray(result.model.theta)
        assert (np.abs(theta) < 1e-8).sum() >= 8  # of the 16 entries that may be 0


def test_a_fit_that_stops_too_early_says_so(data):
    with pytest.warns(RuntimeWarning, match="20 restarts: 20 max_iterations; none usable"):
        result = fit(data[2][400], key=KEY, max_iterations=1, tol=0.0)
    assert set(result.status) == {"max_iterations"}
    assert not result.success
    assert result.chosen is None
    with pytest.raises(FitError, match="max_iterations; none usable"):
        _ = result.model
    assert np.isfinite(result.models.theta).all()  # there to look at


# A solver that does what jaxopt may do; what it does is written in the start's last weight.
GOOD, OUTSIDE, NOT_A_NUMBER, UNFINISHED, ROUNDING = 1.0, 2.0, 3.0, 4.0, 5.0


def misbehaving(function, start, bounds, *, l1, max_iterations, tol):
    kind = start.theta_R[..., -1]
    first = jnp.where(kind == OUTSIDE, 0.5, jnp.where(kind == ROUNDING, 1 - 1e-10, 4.0))
    first = jnp.where(kind == NOT_A_NUMBER, jnp.nan, first)
    model = jax.tree.map(lambda leaf: leaf, start)
    object.__setattr__(model, "theta_Q", model.theta_Q.at[0].set(first))
    return model, 17, jnp.where(kind == UNFINISHED, 1.0, 0.0)


@pytest.fixture
def fresh_training(monkeypatch):
    """Compile fit's inner part anew, so that it uses what a test puts in the solver's place."""
    plain = training._train.__wrapped__
    monkeypatch.setattr(
        training, "_train", jax.jit(lambda *args: plain(*args), static_argnums=(3, 4))
    )
    return lambda solver: monkeypatch.setattr(training, "minimise", solver)


def test_bad_answers_of_the_solver_are_never_chosen(fresh_training):
    fresh_training(misbehaving)
    kinds = [OUTSIDE, NOT_A_NUMBER, GOOD, UNFINISHED, ROUNDING]
    # The bad ones get an R that fits the data as well as any.
    starts = QuadraticCost([np.eye(2)] * 5, [[[kind**2]] for kind in kinds])
    result = fit(FEW, starts, key=KEY, selection="training_loss", adam_steps=1, learning_rate=0.0)
    expected = ["out_of_bounds", "not_finite", "converged", "max_iterations", "converged"]
    assert list(result.status) == expected
    assert result.chosen in (2, 4)
    np.testing.assert_allclose(result.bound_violation[[0, 2, 4]], [0.5, 0, 1e-10], atol=1e-15)
    assert float(result.models.theta_Q[4, 0]) == 1.0  # rounding is clipped away
    assert "1 max_iterations, 1 out_of_bounds, 1 not_finite" in result.message

    with pytest.warns(RuntimeWarning, match="2 out_of_bounds; none usable"):
        refused = fit(
            FEW,
            starts[np.array([0, 0])],
            key=KEY,
            selection="training_loss",
            adam_steps=1,
            learning_rate=0.0,
        )
    with pytest.raises(FitError, match="out_of_bounds"):
        _ = refused.model


def test_starts_outside_the_bounds_are_clipped(fresh_training):
    def stay(function, start, bounds, *, l1, max_iterations, tol):
        return start, 0, 0.0

    fresh_training(stay)
    astray = jax.tree.map(lambda leaf: -5 * jnp.ones((3, *leaf.shape)), COST)
    result = fit(FEW, astray, key=KEY, selection="training_loss", adam_steps=1, learning_rate=0.0)
    np.testing.assert_allclose(result.models.theta_Q[0], [1, -5, 0.01])
    np.testing.assert_allclose(result.models.theta_R[0], [0.01])
    single = fit(FEW, COST, key=KEY, selection="training_loss", adam_steps=1, learning_rate=0.0)
    np.testing.assert_allclose(single.model.theta_Q[0], COST.theta_Q[0])


def test_adam_trains_a_model_of_ones_own(fresh_training):
    def stay(function, start, bounds, *, l1, max_iterations, tol):
        return start, 0, 0.0

    fresh_training(stay)
    truth = Distance(jnp.asarray(1.0))
    drawn = Comparisons.random(
        POOL, lambda first, second: 1.0 * (truth(first) <= truth(second)), 50, key=KEY
    )
    starts = Distance(jnp.array([0.1, 5.0]))
    result = fit(drawn, starts, key=KEY, selection="training_loss", adam_steps=300)
    # Data that can be separated push w up, as far as its bound of 2, where the other starts.
    assert result.models.w[0] > 1.5
    assert result.models.w[1] == 2
    assert (result.models.w <= 2).all()
    assert (result.training_accuracy == 1).all()
    assert accuracy(result.model, drawn) == 1


def test_no_warning_on_the_way_to_a_good_fit(data):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(data[2][20], key=KEY)


@pytest.mark.parametrize(("n", "fraction"), [(1, 0.2), (4, 0.9)])
def test_too_few_pairs_to_keep_some_out(n, fraction):
    few = FEW.subset(np.arange(n))
    with pytest.warns(RuntimeWarning, match=rf"{n} comparison\(s\) are too few .* training loss"):
        result = fit(few, key=KEY, validation_fraction=fraction)
    asked = fit(few, key=KEY, selection="training_loss")
    assert result.selection == "training_loss"
    assert result.chosen == asked.chosen
    np.testing.assert_array_equal(result.models.theta, asked.models.theta)


def test_a_whole_number_is_a_key():
    one, same, other = (fit(FEW, key=key, restarts=2).models.theta for key in (3, np.int64(3), 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    scale = np.ones(3)
    for model in (QuadraticCost.random(2, 1, key=3), ICNNCost.random(scale, key=3)):
        assert np.isfinite(jax.tree.leaves(model)[0]).all()


LARGE = Comparisons(jax.tree.map(lambda leaf: 1e200 * leaf, POOL), [0], [1], [1])
LOSS = {"selection": "training_loss"}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit(POOL, key=KEY), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: fit(FEW, key=KEY, selection="best"), "selection must be one of .*got 'best'"),
        (lambda: fit(FEW, key=KEY, selection="leaky_test_accuracy"), "test must be given with"),
        (lambda: fit(FEW, key=KEY, test=FEW), "test must be given with .* and only then"),
        (
            lambda: fit(FEW, key=KEY, selection="leaky_test_accuracy", test=POOL),
            "test must be a Comparisons, got Trajectory",
        ),
        (lambda: fit(FEW, key=KEY, validation_fraction=0), r"must lie in \(0, 1\), got 0"),
        (lambda: fit(FEW, key=KEY, validation_fraction=1.0), r"must lie in \(0, 1\), got 1"),
        (lambda: fit(FEW, key=KEY, validation_fraction=np.nan), r"must lie in \(0, 1\), got nan"),
        (lambda: fit(FEW, key=-1), "key must be a single JAX random key.*got -1"),
        (lambda: fit(FEW, key=jax.random.split(KEY)), r"key must be a single.*\(2,\)"),
        (lambda: fit(FEW, key=KEY, restarts=0), "restarts must be a whole number of at least 1"),
        (lambda: fit(FEW, key=KEY, l2=-1), "l2 must be finite and at least 0, got -1"),
        (lambda: fit(FEW, key=KEY, l1=np.nan), "l1 must be finite"),
        (lambda: fit(FEW, key=KEY, tol=-1), "tol must be finite"),
        (lambda: fit(FEW, key=KEY, tol="small"), "tol must be a number"),
        (lambda: fit(FEW, key=KEY, learning_rate=np.inf), "learning_rate must be finite"),
        (lambda: fit(FEW, key=KEY, max_iterations=0), "max_iterations must be a whole number"),
        (lambda: fit(FEW, key=KEY, adam_steps=1.5), "adam_steps must be a whole number"),
        (lambda: fit(FEW, np.eye(2), key=KEY), "initial must be a stack of σ models, got ndarray"),
        (lambda: fit(FEW, Distance(jnp.asarray(1.0)), key=KEY), "initial must be stacked along"),
        (
            lambda: fit(FEW, QuadraticCost(np.eye(3), np.eye(1)), key=KEY),
            r"trajectory.x must have shape \(..., any, 3\)",
        ),
        (lambda: fit(LARGE, key=KEY, **LOSS), "trajectories must have finite features"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
@pytest.mark.parametrize(("place", "status"), [(4, "max_iterations"), (5, "out_of_bounds")])
def test_a_restart_converges_only_by_a_small_finite_number(monkeypatch, data, bad, place, status):
    train = training._train

    def broken(*arguments):
        out = list(train(*arguments))
        out[place] = np.full_like(out[place], bad)
        return tuple(out)

    monkeypatch.setattr(training, "_train", broken)
    with pytest.warns(RuntimeWarning, match="none usable"):
        result = fit(data[2][20], key=KEY, restarts=20)
    assert (result.status == status).all()
    assert result.chosen is None
