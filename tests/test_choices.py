"""The likelihood of answers of every kind, and its minimum, against formulas and other solvers."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import numpy as np
import pytest
from few_answers import SIZES, costs, in_cvxpy, minus_log_likelihood, some_answers
from few_comparisons import FEW, POOL, Distance
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from prefmpc import (
    Answers,
    Comparisons,
    MLPCost,
    QuadraticCost,
    Recordings,
    Trajectory,
    WishartPrior,
    fit,
    fit_map,
    fit_network,
    posterior,
)
from prefmpc._pytree import register_pytree
from prefmpc.learning._problem import build_answers, identity
from prefmpc.learning.answer_losses import Task, WithThresholds, choice_data
from prefmpc.learning.choices import NO_THRESHOLDS, Thresholds
from prefmpc.learning.convex import check
from prefmpc.learning.losses import cross_entropy, pair_data

MIXED = some_answers(0, per_kind=3)
PRIOR = WishartPrior([[1.0, 0.3], [0.3, 0.8]], [[2.0]], strength=1.5)
Q, R = np.array([[0.6, 0.2], [0.2, 0.9]]), np.array([[0.4]])
MODEL = QuadraticCost(Q, R)


def by_formula(answers, Q, R, t):
    return minus_log_likelihood(answers, costs(answers.trajectories, Q, R), t, logsumexp)


def drawn(seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=size) for name, size in SIZES.items()}


def plain_log_sum_exp(parts):
    """Of complex numbers too."""
    most = max(np.real(part) for part in parts)
    return most + np.log(sum(np.exp(part - most) for part in parts))


def in_order(thresholds, t):
    values = np.zeros(thresholds.total)
    names = thresholds.named(np.arange(thresholds.total))
    for name, places in names.items():
        values[places] = t[name]
    return values


def test_every_loss_is_what_its_formula_says():
    t, thresholds = drawn(), Thresholds.of(MIXED)
    expected = by_formula(MIXED, Q, R, t)
    data = choice_data(MODEL, MIXED, thresholds)
    model = WithThresholds(MODEL, in_order(thresholds, t))
    assert float(data.weights @ data.losses(model)) == pytest.approx(expected, rel=1e-12)
    _, entries = check([MIXED], [PRIOR], "full", None)
    problem = build_answers(MIXED, PRIOR, entries, None)
    W = np.zeros((3, 3))
    W[:2, :2], W[2:, 2:] = Q, R
    W *= problem.unit * problem.unit[:, None]
    w = np.concatenate([W[entries.rows, entries.columns], model.thresholds])
    assert float(problem.data.loss(problem.data.logits(w))) == pytest.approx(expected, rel=1e-12)


def test_three_items_by_hand():
    """π = 1, 1/2, 1/4 for costs 0, log 2 and 2 log 2."""
    x = np.sqrt(np.log(2) * np.array([0, 1, 2]))
    pool = Trajectory(np.stack([x, x], 1)[..., None], np.zeros((3, 1, 1)))
    model = QuadraticCost([[1.0]], [[1.0]])

    def probability(answers, t=()):
        data = choice_data(model, answers, Thresholds.of(answers))
        losses = data.losses(WithThresholds(model, np.array(t)))
        return np.exp(-float(data.weights @ losses))

    ranked = Answers.from_rankings(pool, [[1, 0, 2]])
    assert probability(ranked) == pytest.approx((0.5 / 1.75) * (1 / 1.25))
    assert probability(Answers.from_rankings(pool, [[1]], shown=[[0, 1, 2]])) == pytest.approx(
        2 / 7
    )
    assert probability(Answers.from_choices(pool, [[2, 0, 1]], [2])) == pytest.approx(1 / 7)
    nu = np.log(3.0)  # Davidson's ν = 3: π_0 : ν·√(π_0 π_2) : π_2 = 1 : 3/2 : 1/4
    for label, wanted in (("first", 1), ("tie", 1.5), ("second", 0.25)):
        said = Answers.from_labels(pool, [0], [2], [label], coding="words")
        assert probability(said, [nu]) == pytest.approx(wanted / 2.75)
    yes = Answers.from_ratings(pool, [True], stars=2, index=[2])
    assert probability(yes, [np.log(8)]) == pytest.approx(2 / 3)  # odds 8·π_2 = 2
    three = Answers.from_ratings(pool, [2], stars=3, index=[1])  # odds 2·½, then 6·½
    assert probability(three, [np.log(2), np.log(6)]) == pytest.approx(1 / (1 + 1 + 3))
    five = Answers.from_labels(pool, [0], [2], [-1], coding="signs", grades=5)
    # s·z = log 4·(1, ½, 0, −½, −1), c = (0, log 2, log 3, log 2, 0)
    weights = np.array([4, 2 * 2, 3, 2 / 2, 1 / 4])
    assert probability(five, np.log([2, 3])) == pytest.approx(1 / weights.sum())


@pytest.mark.parametrize(
    "same",
    [
        Answers.from_comparisons(FEW),
        Answers.from_rankings(POOL, [[0, 1], [2, 1], [2, 3], [4, 3]]),
        Answers.from_choices(POOL, [[0, 1], [1, 2], [2, 3], [3, 4]], [0, 2, 2, 4]),
    ],
    ids=["grades", "ranking", "choice"],
)
def test_plain_pairs_are_todays_pairs(same):
    sure = [1, 0, 1, 0] if same.grades[0] == 0 else FEW.labels
    pairs = Comparisons(POOL, FEW.first, FEW.second, sure)
    for model in (MODEL, Distance(np.asarray(0.5))):
        data, known = choice_data(model, same, NO_THRESHOLDS), pair_data(model, pairs)
        one = jax.value_and_grad(lambda m, d=data: cross_entropy(WithThresholds(m, np.zeros(0)), d))
        two = jax.value_and_grad(lambda m, d=known: cross_entropy(m, d))
        for a, b in zip(jax.tree.leaves(one(model)), jax.tree.leaves(two(model)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    one, two = fit_map(same, PRIOR), fit_map(pairs, PRIOR)
    assert one.thresholds == {}
    assert one.objective == pytest.approx(two.objective, rel=1e-12)
    np.testing.assert_allclose(one.Q, two.Q, rtol=1e-9, atol=1e-12)


def test_derivatives_against_finite_differences():
    _, entries = check([MIXED], [PRIOR], "full", None)
    problem = build_answers(MIXED, PRIOR, entries, None)
    data, rng = problem.data, np.random.default_rng(3)
    assert sorted(c.gap.shape[1] for c in data.wide) == [2, 4, 8]
    w = np.concatenate([problem.mode[entries.rows, entries.columns], rng.normal(size=9)])

    @jax.jit
    def loss(w):
        return data.loss(data.logits(w))

    gradient, hessian = jax.jit(lambda w: data.derivatives(data.logits(w), identity))(w)
    np.testing.assert_allclose(data.gradient(data.logits(w)), gradient, rtol=1e-12, atol=1e-13)
    h = 1e-5 * np.eye(w.size)
    slope = [float(loss(w + d) - loss(w - d)) / 2e-5 for d in h]
    np.testing.assert_allclose(gradient, slope, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(gradient, jax.grad(loss)(w), rtol=1e-11, atol=1e-12)
    steep = jax.jit(jax.grad(loss))
    bend = [(steep(w + d) - steep(w - d)) / 2e-5 for d in h]
    np.testing.assert_allclose(hessian, np.stack(bend), rtol=1e-6, atol=1e-7)
    assert np.linalg.eigvalsh(hessian).min() > -1e-9  # convex in weights and thresholds together


@pytest.mark.parametrize("seed", range(9))
def test_a_diagonal_minimum_is_that_of_scipy(seed):
    answers = some_answers(seed, per_kind=2)
    prior = WishartPrior(np.diag([1.0, 0.8]), [[2.0]], strength=1.5)
    result = fit_map(answers, prior, structure="diagonal")
    assert result.success, result.message
    spread, T = result.problem.spread, answers.trajectories
    squares = np.stack(
        [[*(run.x[:-1] ** 2).sum(0), *(run.u**2).sum(0)] for run in map(T.__getitem__, range(8))]
    )

    def cost(v):
        w, ends = np.exp(v[:3]), np.cumsum([3, *SIZES.values()])
        t = {name: v[a:b] for name, a, b in zip(SIZES, ends, ends[1:], strict=False)}
        value = minus_log_likelihood(answers, squares @ w, t, plain_log_sum_exp)
        prior_value = 1.5 * np.sum(w / [1, 0.8, 2] - np.log(w))
        return value + prior_value + np.sum(v[3:] ** 2) / (2 * spread**2)

    def slope(v):  # exact: no difference is taken
        return np.array([cost(v + 1e-30j * e).imag / 1e-30 for e in np.eye(12)])

    start = np.concatenate([np.log([1, 0.8, 2]), np.zeros(9)])
    options = {"ftol": 1e-14, "gtol": 1e-8, "maxfun": 10**5}
    found = minimize(lambda v: cost(v).real, start, jac=slope, method="L-BFGS-B", options=options)
    assert found.fun == pytest.approx(result.objective, rel=1e-7)


def test_a_full_minimum_is_that_of_clarabel():
    answers = some_answers(20, per_kind=3)
    result = fit_map(answers, PRIOR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        value, Q, R, t = in_cvxpy(answers, PRIOR, result.problem.spread)
    assert result.objective == pytest.approx(value, rel=1e-7)
    np.testing.assert_allclose(result.Q, Q, atol=1e-4)
    np.testing.assert_allclose(result.R, R, atol=1e-4)
    for name, values in result.thresholds.items():
        np.testing.assert_allclose(values, t[name], atol=1e-2)
    std = result.std_Q
    assert std.shape == (2, 2)
    assert (std > 0).all()
    with pytest.raises(ValueError, match="result must be learned from Comparisons"):
        posterior(result)


def test_an_answer_that_nobody_gave_leaves_a_finite_threshold():
    data = Answers.from_labels(POOL, [0, 1, 2], [1, 2, 3], [1, -1, 1], coding="signs")
    result = fit_map(data, PRIOR)
    assert result.success
    assert -1000 < result.thresholds["tie"][0] < -3


# ---- other σ, and other lengths ----


@dataclasses.dataclass(frozen=True)
class ItemCost:
    """A cost of its own for every item: Bradley and Terry's, Plackett and Luce's parameters."""

    theta: object
    linear_in_features = True

    @staticmethod
    def features(trajectory):
        return trajectory.x[..., 0, :]

    def score(self, features):
        return features @ self.theta

    def __call__(self, trajectory):
        return self.score(self.features(trajectory))

    def bounds(self):
        far = np.full(self.theta.shape, np.inf)
        return ItemCost(-far), ItemCost(far)


register_pytree(ItemCost)
ITEMS = Trajectory(np.stack([np.eye(6), np.eye(6)], 1), np.zeros((6, 1, 1)))


def item_data(kind, seed=5):
    rng = np.random.default_rng(seed)
    strength = np.linspace(-1, 1, 6)
    rows = [rng.permutation(6)[: 2 if kind == "pairs" else 4] for _ in range(120)]
    heard = [row[np.argsort(-(strength[row] + rng.gumbel(size=row.size)))] for row in rows]
    if kind == "top":
        return Answers.from_choices(ITEMS, rows, [h[0] for h in heard])
    return Answers.from_rankings(ITEMS, heard)


@pytest.mark.parametrize("kind", ["pairs", "rankings", "top"])
def test_items_are_as_strong_as_scipy_finds_them(kind):
    data = item_data(kind)
    count = np.minimum(data.answers, data.sizes - 1).sum()

    def cost(theta):
        return (
            minus_log_likelihood(data, theta, {}, plain_log_sum_exp) / count + 1e-6 * theta @ theta
        )

    def slope(theta):
        return np.array([cost(theta + 1e-30j * e).imag / 1e-30 for e in np.eye(6)])

    found = minimize(
        lambda v: cost(v).real, np.zeros(6), jac=slope, method="BFGS", options={"gtol": 1e-9}
    )
    result = fit(
        data, ItemCost(np.zeros((1, 6))), key=0, selection="training_loss", l2=1e-6, tol=1e-9
    )
    assert result.success
    np.testing.assert_allclose(result.model.theta, found.x, atol=1e-6)


def test_recordings_of_one_length_are_a_batch_and_others_as_if_padded():
    labels = {"coding": "signs"}
    even = Answers.from_labels(POOL, [0, 1, 2], [1, 2, 3], [1, 0, -1], **labels)
    listed = Recordings([POOL[i] for i in range(5)])
    mean = Recordings([POOL], per_step=True)
    one = fit_map(even, PRIOR)
    two = fit_map(Answers(listed, even.shown, even.grades, even.answers), PRIOR)
    np.testing.assert_allclose(two.Q, one.Q, rtol=1e-12)
    per_step = fit_map(Answers(mean, even.shown, even.grades, even.answers), PRIOR)
    scaled = Trajectory(POOL.x / np.sqrt(3), POOL.u / np.sqrt(3))
    by_hand = fit_map(Answers(scaled, even.shown, even.grades, even.answers), PRIOR)
    np.testing.assert_allclose(per_step.Q, by_hand.Q, rtol=1e-10)
    T = MIXED.trajectories
    assert len(set(T.horizons.tolist())) > 2
    most = max(T.horizons)
    pads = [most - n for n in T.horizons]
    x, u = (
        np.stack([np.pad(array, ((0, n), (0, 0))) for array, n in zip(arrays, pads, strict=True)])
        for arrays in ([T[i].x[:-1] for i in range(8)], [T[i].u for i in range(8)])
    )
    padded = Trajectory(np.pad(x, ((0, 0), (0, 1), (0, 0))), u)
    one, two = (
        fit_map(MIXED, PRIOR),
        fit_map(Answers(padded, *list(vars(MIXED).values())[1:]), PRIOR),
    )
    np.testing.assert_allclose(two.Q, one.Q, rtol=1e-10)


@pytest.mark.parametrize("per_step", [False, True])
def test_networks_learn_from_recordings_of_any_length(per_step):
    recordings = Recordings([MIXED.trajectories[i] for i in range(8)], per_step=per_step)
    answers = Answers(recordings, MIXED.shown, MIXED.grades, MIXED.answers)
    starts = MLPCost.random([1, 1, 1], key=0, widths=(3,), shape=(2,))
    task = Task.of(starts, answers)
    data = task.data(answers)
    sigma = np.array([float(starts[0](recordings[i])) for i in range(8)])
    sigma = sigma / recordings.horizons if per_step else sigma
    np.testing.assert_allclose(data.costs(starts[0]), sigma, rtol=1e-12)
    before = float(cross_entropy(jax.tree.map(lambda leaf: leaf[0], task.starts), data))
    fitted = fit_network(answers, starts, key=1, validation=answers, max_epochs=200)
    assert fitted.thresholds["5 stars"].shape == (2, 4)
    assert fitted.training_loss[-1].min() < before


def test_mini_batches_of_choices_are_parts_of_the_loss():
    answers = item_data("rankings")
    model = WithThresholds(ItemCost(np.linspace(0, 1, 6)), np.zeros(0))
    data = choice_data(model.model, answers, NO_THRESHOLDS)
    chosen = np.array([5, 2, 70000, 11])
    part = jax.jit(lambda d: d.part(chosen))(data)
    assert part.weights.tolist() == [1, 1, 0, 1]
    whole = np.asarray(data.losses(model))
    np.testing.assert_allclose(np.asarray(part.losses(model))[[0, 1, 3]], whole[chosen[[0, 1, 3]]])
    small = data._replace(order=np.resize(data.order, 500), factor=np.ones(500))
    few = jax.jit(lambda d: d.part(chosen))(small)  # only what is shown is scored
    np.testing.assert_allclose(np.asarray(few.losses(model))[[0, 1, 3]], whole[chosen[[0, 1, 3]]])
    data.hold_out(np.array([0]))
    assert (data.weights == 0).sum() - (data.weights.size - 360) == 3  # all stages of one ranking


def test_learned_from_ties_the_probabilities_are_those_of_davidson():
    """Ties keep the odds of the others: P(first) / P(second) = exp(z)."""
    z = np.linspace(-3, 3, 7)
    nu = 0.4
    u = np.stack([z / 2, nu + 0 * z, -z / 2])
    P = np.exp(u - logsumexp(u, axis=0))
    np.testing.assert_allclose(P[0] / (P[0] + P[2]), expit(z))


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_no_scale_of_the_prior_is_too_small_or_too_large(scale):
    prior = WishartPrior(scale * np.eye(2), [[scale]])
    result = fit_map(MIXED, prior)
    assert result.success, result.message
    spread = result.problem.spread
    t = {**dict.fromkeys(SIZES), **result.thresholds}
    expected = by_formula(MIXED, result.Q, result.R, t) + sum(
        float(values @ values) for values in result.thresholds.values()
    ) / (2 * spread**2)
    for W in (result.Q, result.R):
        expected += np.trace(W) / scale - np.linalg.slogdet(W)[1]
    assert result.objective == pytest.approx(expected, rel=1e-9)
