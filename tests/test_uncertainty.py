"""The posterior against quadrature, against Wishart moments and against its own definition."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from sampled_answers import sampled_answers
from scipy.integrate import quad
from scipy.special import gammaln
from scipy.stats import gamma, wishart

from prefmpc import (
    Comparisons,
    FitError,
    QuadraticPreference,
    Trajectory,
    WishartPrior,
    blocks,
    bryson,
    choose_prior,
    fit_map,
    oscillating_masses,
    posterior,
)
from prefmpc.learning._chart import Chart, laplaces
from prefmpc.learning.uncertainty import Posterior, effective_draws
from studies import RADIUS

PRIOR = bryson(RADIUS, [1, 1], scale=1e-3)
POOL, ANSWERS = sampled_answers(WishartPrior(2 * PRIOR.Q, PRIOR.R), 40, seed=2100)
NOTHING = Comparisons(POOL, [0], [0], [0.5])  # says nothing at all
COUPLED = WishartPrior(
    3 * np.eye(6) + 0.5 * np.ones((6, 6)), np.array([[2.0, 0.3], [0.3, 1]]), strength=2.5
)
RESULT = fit_map(ANSWERS, PRIOR)


def one_weight(strength: float):
    """Twelve answers about one state, whose input is always 0: posteriors of q by quadrature."""
    rng = np.random.default_rng(7)
    x = np.concatenate([rng.normal(size=(8, 1, 1)), np.zeros((8, 1, 1))], axis=1)
    data = Comparisons(
        Trajectory(x, np.zeros((8, 1, 1))),
        rng.integers(0, 8, 12),
        rng.integers(0, 8, 12),
        rng.integers(0, 2, 12).astype(float),
    )
    S = x[:, 0, 0] ** 2
    gap = S[data.second] - S[data.first]

    def density(q):  # likelihood × gamma(strength + 1, rate strength / 1.5)
        z = q * gap
        logs = np.sum(data.labels * z - np.logaddexp(0, z))
        prior = gamma.logpdf(q, strength + 1, scale=1.5 / strength)
        return np.exp(logs + prior)

    return data, WishartPrior([[1.5]], [[1.0]], strength), density


@pytest.mark.parametrize("strength", [0.5, 3.0])
def test_one_weight_agrees_with_quadrature(strength):
    data, prior, density = one_weight(strength)
    total = quad(density, 0, np.inf)[0]
    mean = quad(lambda q: q * density(q), 0, np.inf)[0] / total
    second = quad(lambda q: q**2 * density(q), 0, np.inf)[0] / total
    draws = posterior(fit_map(data, prior))
    assert draws.success, draws.message
    std = np.sqrt(second - mean**2)
    assert draws.Q.mean() == pytest.approx(mean, abs=0.15 * std)
    assert draws.std_Q[0, 0] == pytest.approx(std, rel=0.15)
    below = quad(density, 0, mean)[0] / total
    assert np.mean(draws.Q < mean) == pytest.approx(below, abs=0.06)
    evidence = choose_prior(data, [prior]).scores[0]
    assert evidence == pytest.approx(np.log(total), abs=0.2)  # Laplace's error


@pytest.mark.parametrize("prior", [PRIOR, COUPLED], ids=["bryson", "coupled"])
def test_without_answers_the_samples_are_the_wishart_prior(prior):
    draws = posterior(fit_map(NOTHING, prior))
    assert draws.success, draws.message
    for samples, mode in ((draws.Q, prior.Q), (draws.R, prior.R)):
        d = len(mode)
        law = wishart(2 * prior.strength + d + 1, mode / (2 * prior.strength))
        tolerance = 5 * np.sqrt(law.var() / draws.effective)
        assert (np.abs(samples.mean(axis=0) - law.mean()) < tolerance).all()
        np.testing.assert_allclose(samples.std(axis=0), np.sqrt(law.var()), rtol=0.15)


def test_the_prior_of_the_chart_has_its_normaliser():
    # −log density of η at a point: that of a Wishart law, times |∂W/∂η| by finite differences.
    result = fit_map(NOTHING, COUPLED)
    chart = Chart.of(result.problem)
    eta = np.asarray(chart.coordinates(result.minimum.w)) + 0.1
    w = np.asarray(chart.weights(eta))
    steps = 1e-6 * np.eye(24)
    J = np.stack([(chart.weights(eta + s) - chart.weights(eta - s)) / 2e-6 for s in steps])
    W, W0 = np.asarray(chart.entries.matrix(w)), result.problem.mode
    expected = np.linalg.slogdet(J)[1]
    for block in (slice(0, 6), slice(6, 8)):
        d = block.stop - block.start
        law = wishart(2 * 2.5 + d + 1, W0[block, block] / (2 * 2.5))
        expected += law.logpdf(W[block, block])
    assert -chart.minus_log_prior(eta, 2.5) == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(chart.coordinates(w), eta, atol=1e-10)


def test_laplace_in_the_chart_is_at_the_mode():
    fit = laplaces([RESULT.problem], [RESULT.minimum.w])[0]
    chart, p = Chart.of(RESULT.problem), RESULT.problem

    def value(eta):
        z = np.asarray(chart.weights(eta)) @ p.gap[:, :40]
        loss = np.sum(np.logaddexp(0, z) - ANSWERS.labels * z)
        return loss + float(chart.minus_log_prior(eta, p.strength))

    H = fit.root @ fit.root.T
    for k in range(24):
        e = np.zeros(24)
        e[k] = 1e-3
        up, middle, down = value(fit.eta + e), value(fit.eta), value(fit.eta - e)
        assert abs(up - down) / 2e-3 < 1e-3
        assert (up + down - 2 * middle) / 1e-6 == pytest.approx(H[k, k], rel=1e-3)
    sign, log_det = np.linalg.slogdet(H)
    assert sign == 1
    evidence = -value(fit.eta) + 12 * np.log(2 * np.pi) - log_det / 2
    assert fit.log_evidence == pytest.approx(evidence, abs=1e-6)


def test_samples_are_definite_repeatable_and_independent_of_the_key():
    draws, again = posterior(RESULT), posterior(RESULT)
    assert draws.success
    assert draws.Q.shape == (1024, 6, 6)
    assert draws.R.shape == (1024, 2, 2)
    assert min(np.linalg.eigvalsh(draws.Q).min(), np.linalg.eigvalsh(draws.R).min()) > 0
    np.testing.assert_array_equal(draws.Q, again.Q)
    other = posterior(RESULT, key=jax.random.key(5))
    error = np.sqrt(1 / draws.effective + 1 / other.effective) * draws.std_Q
    assert (np.abs(draws.Q.mean(0) - other.Q.mean(0)) < 5 * error).all()
    assert (draws.Q != other.Q).any()


def test_probabilities_are_those_of_the_samples():
    draws = posterior(RESULT)
    first, second = POOL[:6], POOL[6:12]
    Q, R = draws.Q, draws.R
    costs = [
        np.einsum("tki,mij,tkj->mt", side.x[:, :-1], Q, side.x[:, :-1])
        + np.einsum("tki,mij,tkj->mt", side.u, R, side.u)
        for side in (first, second)
    ]
    P = 1 / (1 + np.exp(costs[0] - costs[1]))
    mean, lower, upper = draws.probability(first, second, level=0.8)
    np.testing.assert_allclose(mean, P.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(lower, np.quantile(P, 0.1, axis=0), rtol=1e-9)
    np.testing.assert_allclose(upper, np.quantile(P, 0.9, axis=0), rtol=1e-9)
    one = draws.probability(POOL[0], POOL[6], level=0.8)
    assert one.mean.shape == ()
    assert one.lower == pytest.approx(lower[0])


def test_blocks_of_outputs_have_posteriors_too():
    C = oscillating_masses().C
    prior = bryson([0.3, 0.3, 0.3], [1, 1], scale=1e-3)
    structure = blocks([[0, 1], [2]], [[0], [1]])
    draws = posterior(fit_map(ANSWERS, prior, structure=structure, outputs=C))
    assert draws.success, draws.message
    assert np.linalg.matrix_rank(draws.Q[0]) == 3
    assert np.abs(draws.Q[:, 3:]).max() == 0 < draws.Q[:, 0, 1].std()
    assert np.abs(draws.Q[:, 2, :2]).max() == 0
    mean = draws.probability(POOL[:3], POOL[3:6]).mean
    models = draws.models
    P = [1 / (1 + np.exp(models[i](POOL[:3]) - models[i](POOL[3:6]))) for i in range(0, 1024, 8)]
    np.testing.assert_allclose(mean, np.mean(P, axis=0), atol=0.1)


def test_a_tridiagonal_structure_keeps_its_zeros_and_a_filled_one_is_refused():
    chain = np.abs(np.subtract.outer(np.arange(6), np.arange(6))) <= 1
    full = np.ones((2, 2), bool)
    result = fit_map(ANSWERS, PRIOR, structure=(chain, full))
    draws = posterior(result)
    assert np.abs(draws.Q[:, ~chain]).max() == 0
    ring = chain.copy()
    ring[0, 5] = ring[5, 0] = True
    with pytest.raises(ValueError, match="structure must be block-diagonal"):
        posterior(fit_map(ANSWERS, PRIOR, structure=(ring, full)))
    with pytest.raises(ValueError, match="structure must be block-diagonal"):
        choose_prior(ANSWERS, [PRIOR], structure=(ring, full))
    assert choose_prior(
        ANSWERS, [PRIOR], structure=(ring, full), by="cross_validation"
    ).result.success


def test_chains_that_disagree_say_so():
    # A hundred sure answers and a prior that says little: a thin cone of weights.
    sure = Comparisons.random(
        POOL, QuadraticPreference(PRIOR.Q, PRIOR.R), 100, key=jax.random.key(1)
    )
    result = fit_map(sure, bryson(RADIUS, [1, 1], strength=0.3))
    with pytest.warns(RuntimeWarning, match="the chains disagree: 1024 draws worth"):
        draws = posterior(result)
    assert not draws.success


def test_effective_draws_of_independent_and_of_stuck_chains():
    rng = np.random.default_rng(0)
    assert effective_draws(rng.normal(size=(64, 32, 3))) > 1000
    stuck = np.repeat(rng.normal(size=(1, 32, 3)), 64, axis=0)
    assert effective_draws(stuck + 1e-3 * rng.normal(size=stuck.shape)) < 100


def test_gamma_normaliser_for_one_weight():
    # The formula of the docstring: shape strength + 1.
    data, prior, _ = one_weight(2.0)
    chart = Chart.of(fit_map(data, prior).problem)
    value = float(chart.minus_log_prior(np.zeros(2), 2.0))
    # η = 0: L = 1 for both, W = W₀; density of the gammas times dW/dη = 2 each.
    one = gammaln(3.0) - 3 * np.log(2.0) + 2.0 - np.log(2.0)
    assert value == pytest.approx(2 * one)


UNFINISHED = dataclasses.replace(RESULT, status="max_iterations")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: posterior(ANSWERS), "result must be a MapResult, got Comparisons"),
        (lambda: posterior(RESULT, draws=0), "draws must be a whole number"),
        (
            lambda: posterior(RESULT).probability(POOL[:2], POOL[:2], level=1),
            "level must lie in .0, 1., got 1",
        ),
        (
            lambda: posterior(RESULT).probability(POOL[:2], POOL[:3]),
            "first and second must have equal shapes",
        ),
        (
            lambda: posterior(RESULT).probability(POOL[:2], ANSWERS),
            "second must be a Trajectory, got Comparisons",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_an_unfinished_result_has_no_posterior():
    with pytest.raises(FitError, match="max_iterations"):
        posterior(UNFINISHED)
    with pytest.raises(FitError, match="max_iterations"):
        _ = UNFINISHED.std_Q


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
def test_only_a_finite_number_of_draws_is_enough(bad):
    numbers = {"acceptance": 1.0, "seconds": 0.0, "result": None}
    Q, R, w = np.ones((320, 1, 1)), np.ones((320, 1, 1)), np.ones((320, 2))
    assert Posterior(Q, R, effective=40.0, w=w, **numbers).success
    assert not Posterior(Q, R, effective=bad, w=w, **numbers).success
    assert not Posterior(Q, R, effective=40.0, w=w * np.inf, **numbers).success
