"""The loss against formulas written out, the recipe against SciPy, and every way to fail."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize

from prefmpc import (
    Comparisons,
    CostModel,
    FitError,
    ICNNCost,
    QuadraticCost,
    Trajectory,
    accuracy,
    fit,
)
from prefmpc._pytree import register_pytree
from prefmpc.learning import training
from prefmpc.learning._lbfgsb import minimise
from prefmpc.learning.losses import PairData, cross_entropy, logits, objective, pair_data
from prefmpc.learning.training import best_restart
from studies import error_rates

KEY = jax.random.key(2000)
RNG = np.random.default_rng(0)
POOL = Trajectory(RNG.normal(size=(5, 4, 2)), RNG.normal(size=(5, 3, 1)))
FEW = Comparisons(POOL, [0, 1, 2, 3], [1, 2, 3, 4], [1, 0, 0.3, 0.5])
COST = QuadraticCost([[2.0, 0.3], [0.3, 1]], [[0.7]])


class GivenLogits:
    """A model whose features are the log-odds themselves."""

    @staticmethod
    def score(features):
        return features


def loss_of(z, labels, weights=None):
    z, labels = np.atleast_1d(z).astype(float), np.atleast_1d(labels).astype(float)
    weights = np.ones(z.size) if weights is None else weights
    return float(cross_entropy(GivenLogits, PairData(None, z, labels, weights)))


@given(st.lists(st.tuples(st.floats(-30, 30), st.floats(0, 1)), min_size=6, max_size=6))
def test_loss_is_the_negative_log_likelihood(pairs):
    z, labels = (np.array(column, dtype=np.longdouble) for column in zip(*pairs, strict=True))
    p = 1 / (1 + np.exp(-z))
    q = 1 / (1 + np.exp(z))  # 1 − p, without cancellation
    naive = -(labels * np.log(p) + (1 - labels) * np.log(q)).mean()
    assert loss_of(z, labels) == pytest.approx(float(naive), rel=1e-12, abs=1e-14)


def test_loss_at_logits_far_beyond_what_exp_can_hold():
    assert loss_of(800, 1) == loss_of(-800, 0) == 0
    assert loss_of(800, 0) == loss_of(-800, 1) == 800
    assert loss_of(800, 0.25) == 600
    slope = jax.grad(
        lambda z: cross_entropy(GivenLogits, PairData(None, z, np.array([0.0, 1]), np.ones(2)))
    )(jnp.array([800.0, 800.0]))
    np.testing.assert_array_equal(slope, [0.5, 0])


def test_the_sign_of_the_loss():
    # Smaller σ is preferred: a first that costs less than the second is the likelier answer.
    cheap, dear = Trajectory([[0.1], [0]], [[0]]), Trajectory([[3], [0]], [[0]])
    pool = jax.tree.map(lambda a, b: np.stack([a, b]), cheap, dear)
    model = QuadraticCost([[1]], [[1]])
    right, wrong = (
        float(cross_entropy(model, pair_data(model, Comparisons(pool, [0], [1], [label]))))
        for label in (1, 0)
    )
    # σ is 0.01 and 9: the log-odds are 8.99.
    assert right == pytest.approx(np.log1p(np.exp(-8.99)))
    assert wrong == pytest.approx(8.99 + np.log1p(np.exp(-8.99)))


def test_padding_does_not_count():
    plain, padded = pair_data(COST, FEW), pair_data(COST, FEW, 64)
    assert padded.features.shape[0] == padded.labels.size == padded.weights.size == 64
    expected = float(cross_entropy(COST, plain))
    assert float(cross_entropy(COST, padded)) == pytest.approx(expected, rel=1e-14)
    # A weight of 2 is the same as the pair twice.
    twice = Comparisons(POOL, [0, 1, 2, 3, 0], [1, 2, 3, 4, 1], [1, 0, 0.3, 0.5, 1])
    heavy = plain._replace(weights=np.array([2.0, 1, 1, 1]))
    assert float(cross_entropy(COST, heavy)) == pytest.approx(
        float(cross_entropy(COST, pair_data(COST, twice))), rel=1e-14
    )


@given(st.lists(st.tuples(*[st.integers(0, 4)] * 2, st.floats(0, 1)), min_size=5, max_size=5))
def test_a_pair_asked_the_other_way_round_says_the_same(rows):
    first, second, labels = (np.array(column) for column in zip(*rows, strict=True))
    one = pair_data(COST, Comparisons(POOL, first, second, labels))
    other = pair_data(COST, Comparisons(POOL, second, first, 1 - labels))
    expected = float(cross_entropy(COST, one))
    assert float(cross_entropy(COST, other)) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_objective_by_hand():
    data = pair_data(COST, FEW)
    theta = np.asarray(COST.theta)
    expected = float(cross_entropy(COST, data)) + 0.1 * theta @ theta + 0.2 * np.abs(theta).sum()
    assert float(objective(COST, data, l2=0.1, l1=0.2)) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("l1", [0.0, 0.2])
def test_gradient_of_the_objective_against_finite_differences(l1):
    data = pair_data(COST, FEW)
    theta, unravel = ravel_pytree(COST)

    @jax.jit
    def loss(theta):
        return objective(unravel(theta), data, l2=0.1, l1=l1)

    h = 1e-5
    difference = [
        float(loss(theta + d) - loss(theta - d)) / (2 * h) for d in h * np.eye(theta.size)
    ]
    np.testing.assert_allclose(jax.grad(loss)(theta), difference, rtol=1e-6)


@dataclasses.dataclass(frozen=True)
class Distance:
    """σ = w · Σ|x|: not a quadratic, and used through differences of scores."""

    w: object
    linear_in_features = False

    @staticmethod
    def features(trajectory):
        return {"size": jnp.abs(trajectory.x[..., :-1, :]).sum((-1, -2))}

    def score(self, features):
        return self.w * features["size"]

    def __call__(self, trajectory):
        return self.score(self.features(trajectory))

    def bounds(self):
        return Distance(jnp.zeros_like(self.w)), Distance(jnp.full_like(self.w, 2.0))


register_pytree(Distance)


def test_a_model_of_ones_own():
    model = Distance(jnp.asarray(0.5))
    assert isinstance(model, CostModel)
    sizes = 0.5 * np.abs(POOL.x[:, :-1]).sum((-1, -2))
    data = pair_data(model, FEW, 16)
    # Every trajectory once, however many pairs it is in; padded to few shapes.
    assert pair_data(model, FEW).features["size"].shape == (5,)
    assert data.features["size"].shape == (128,)
    z = np.asarray(logits(model, data))[:4]
    np.testing.assert_allclose(z, sizes[FEW.second] - sizes[FEW.first], rtol=1e-12)


# minimise(): one small problem, whose answer is known, compiled once.


@pytest.fixture(scope="module")
def shrink():
    """θ = {a, b} that minimises ½‖θ − target‖² + l1·‖θ‖₁ over −1 ≤ a ≤ 2, b ≥ 0.01."""

    @jax.jit
    def run(start, target, l1):
        return minimise(
            lambda t: ((t["a"] - target[0]) ** 2 + (t["b"] - target[1]) ** 2) / 2,
            start,
            ({"a": -1.0, "b": 0.01}, {"a": 2.0, "b": jnp.inf}),
            l1=l1,
            max_iterations=200,
            tol=1e-10,
        )

    return lambda start, target, l1=0.0: run(
        {"a": float(start[0]), "b": float(start[1])}, np.array(target, float), l1
    )


@pytest.mark.parametrize("start", [(0, 1), (5, -5), (-9, -9), (100, 100), (2, 0.01)])
@pytest.mark.parametrize("target", [(1, 3), (3, -4), (-5, 0.5), (0, 0)])
@pytest.mark.parametrize("l1", [0.0, 0.4])
def test_minimise_from_anywhere_finds_the_known_optimum(shrink, start, target, l1):
    # Soft thresholding, then the box; started outside of it jaxopt itself goes astray.
    target = np.array(target, float)
    shrunk = np.sign(target) * np.maximum(np.abs(target) - l1, 0)
    expected = np.clip(shrunk, [-1, 0.01], [2, np.inf])
    theta, _, error = shrink(start, target, l1)
    assert error <= 1e-10
    np.testing.assert_allclose([theta["a"], theta["b"]], expected, atol=1e-8)


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


# ---- a status depends on the number beside it ----


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_restart_without_a_finite_score_and_loss_is_never_chosen(bad):
    mixed = np.array(["converged", "not_finite"])
    assert best_restart([bad, 1.0], mixed, np.ones(2)) is None
    assert best_restart(np.ones(2), mixed, np.array([bad, 1.0])) is None
    both = np.array(["converged", "converged"])
    assert best_restart(np.array([bad, 3.0]), both, np.ones(2)) == 1
    assert best_restart([1.0, 1.0], both, [2.0, 1.0]) == 1


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


def test_an_infinite_slope_towards_a_bound_is_no_minimum():
    # √x on x ≥ 0: the projected gradient at 0 is 0, the gradient itself infinite.
    low, high = np.zeros(2), np.full(2, np.inf)
    options = {"max_iterations": 50, "tol": 1e-3}
    x, _, error = minimise(lambda x: jnp.sqrt(x).sum(), np.zeros(2), (low, high), **options)
    assert (np.asarray(x) == 0).all()
    assert np.isnan(error)
    _, _, error = minimise(lambda x: jnp.sum((x - 1) ** 2), np.zeros(2), (low, high), **options)
    assert error <= 1e-3
