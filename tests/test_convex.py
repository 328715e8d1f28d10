"""The convex learner against another solver, against its own optimality conditions, on bad data."""

from __future__ import annotations

import warnings

import cvxpy as cp
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from prefmpc import (
    Comparisons,
    FitError,
    QuadraticPreference,
    Trajectory,
    WishartPrior,
    accuracy,
    blocks,
    bryson,
    choose_prior,
    erring,
    fit_map,
    fit_maps,
    lqr_pool,
    oscillating_masses,
    second_moments,
)
from prefmpc.learning import convex, selection
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

POOL = lqr_pool(
    oscillating_masses(), 30, 10, key=jax.random.key(2000), radius=RADIUS, saturate=False
)
PERSON = QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
CLEAN = Comparisons.random(POOL, PERSON, 50, key=jax.random.key(2001))
NOISY = Comparisons.random(POOL, erring(PERSON, 0.2), 50, key=jax.random.key(2002))  # soft labels
BRYSON = bryson(RADIUS, [1, 1])
SMALL = Comparisons(Trajectory(np.ones((2, 3, 1)), np.ones((2, 2, 1))), [0], [1], [1.0])
COUPLED = WishartPrior(
    30 * np.eye(6) + 5 * np.ones((6, 6)), np.array([[20.0, 3], [3, 10]]), strength=2.5
)


def minus_log_posterior(Q, R, data, prior):
    """By the formula, on trajectories, nothing shared with the code under test."""
    x, u = data.trajectories.x[:, :-1], data.trajectories.u
    sigma = np.einsum("tki,ij,tkj->t", x, Q, x) + np.einsum("tki,ij,tkj->t", u, R, u)
    z = sigma[data.second] - sigma[data.first]
    loss = np.sum(np.logaddexp(0, z) - data.labels * z)
    for W, W0 in ((Q, prior.Q), (R, prior.R)):
        loss += prior.strength * (np.trace(np.linalg.solve(W0, W)) - np.linalg.slogdet(W)[1])
    return loss


@pytest.mark.parametrize("data", [CLEAN, NOISY], ids=["clean", "noisy"])
@pytest.mark.parametrize("prior", [BRYSON, COUPLED], ids=["bryson", "coupled"])
def test_the_minimum_is_that_of_clarabel(data, prior):
    result = fit_map(data, prior)
    assert result.success, result.message
    S = second_moments(data.trajectories)
    dx, du = (np.asarray(M)[data.second] - np.asarray(M)[data.first] for M in S)
    Q, R = cp.Variable((6, 6), symmetric=True), cp.Variable((2, 2), symmetric=True)
    z = dx.reshape(-1, 36) @ cp.vec(Q, order="C") + du.reshape(-1, 4) @ cp.vec(R, order="C")
    cost = cp.sum(cp.logistic(z) - cp.multiply(data.labels, z))
    for W, W0 in ((Q, prior.Q), (R, prior.R)):
        cost += prior.strength * (cp.trace(np.linalg.inv(W0) @ W) - cp.log_det(W))
    problem = cp.Problem(cp.Minimize(cost))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver=cp.CLARABEL)
    assert result.objective == pytest.approx(problem.value, rel=1e-7)
    np.testing.assert_allclose(result.Q, Q.value, atol=1e-3 * np.abs(result.Q).max())
    assert result.objective == pytest.approx(
        minus_log_posterior(result.Q, result.R, data, prior), rel=1e-12
    )


def test_a_diagonal_minimum_is_that_of_scipy_from_several_starts():
    result = fit_map(NOISY, BRYSON, structure="diagonal")
    assert result.success
    for W in (result.Q, result.R):
        np.testing.assert_array_equal(W, np.diag(np.diag(W)))

    def cost(log_w):
        w = np.exp(log_w)
        return minus_log_posterior(np.diag(w[:6]), np.diag(w[6:]), NOISY, BRYSON)

    mode = np.log(np.concatenate([np.diag(BRYSON.Q), np.diag(BRYSON.R)]))
    for shift in (-1, 0, 2):
        found = minimize(cost, mode + shift, method="L-BFGS-B", options={"ftol": 1e-14})
        assert found.fun == pytest.approx(result.objective, rel=1e-7)
    full = fit_map(NOISY, BRYSON)
    assert full.objective < result.objective


def test_no_answer_leaves_the_mode_and_little_prior_leaves_the_data():
    same = Comparisons(POOL, [0], [0], [0.5])  # says nothing at all
    result = fit_map(same, COUPLED)
    np.testing.assert_allclose(result.Q, COUPLED.Q, rtol=1e-9)
    np.testing.assert_allclose(result.R, COUPLED.R, rtol=1e-9)
    weak = fit_map(CLEAN, bryson(RADIUS, [1, 1], strength=1e-3))
    strong = fit_map(CLEAN, bryson(RADIUS, [1, 1], strength=1e5))
    assert accuracy(weak.model, CLEAN) == 1 > accuracy(strong.model, CLEAN)
    np.testing.assert_allclose(strong.Q, BRYSON.Q, atol=0.01 * BRYSON.Q.max())


def test_many_problems_at_once_are_the_same_as_one_by_one():
    priors = [BRYSON, COUPLED, bryson(RADIUS, [1, 1], scale=50, strength=0.1)]
    sets = [CLEAN, NOISY.subset(np.arange(20)), NOISY]
    together = [*fit_maps(CLEAN, priors), *fit_maps(sets, COUPLED), *fit_maps(sets, priors)]
    alone = [fit_map(CLEAN, p) for p in priors] + [fit_map(d, COUPLED) for d in sets]
    alone += [fit_map(d, p) for d, p in zip(sets, priors, strict=True)]
    for one, many in zip(alone, together, strict=True):
        assert many.success
        assert many.objective == pytest.approx(one.objective, rel=1e-9)
        assert many.log_likelihood == pytest.approx(one.log_likelihood, rel=1e-5)
        np.testing.assert_allclose(many.Q, one.Q, atol=1e-5 * np.abs(one.Q).max())


def test_block_diagonal_and_sparse_minima_are_stationary():
    coupled = blocks([[0, 3], [1, 4], [2, 5]], [[0], [1]])
    chain = np.abs(np.subtract.outer(np.arange(6), np.arange(6))) <= 1  # tridiagonal
    for masks in (coupled, (chain, np.ones((2, 2), bool))):
        result = fit_map(NOISY, BRYSON, structure=masks)
        assert result.success
        for W, mask in zip((result.Q, result.R), masks, strict=True):
            assert (W[~mask] == 0).all()
            assert (W[mask] != 0).all()
        for i, j in zip(*np.nonzero(np.tril(masks[0])), strict=True):
            E = np.zeros((6, 6))
            E[i, j] = E[j, i] = 1e-4 * np.sqrt(result.Q[i, i] * result.Q[j, j])
            at = [minus_log_posterior(result.Q + s * E, result.R, NOISY, BRYSON) for s in (-1, 1)]
            assert abs(at[1] - at[0]) / 2e-4 < 1e-4
            assert min(at) > result.objective
    assert fit_map(NOISY, BRYSON).objective < result.objective


def test_outputs_only_is_the_same_as_learning_from_a_plant_with_these_states():
    C = oscillating_masses().C
    assert C.shape == (3, 6)
    prior = bryson([0.3, 0.2, 0.1], [1, 1])
    result = fit_map(NOISY, prior, outputs=C)
    seen = Trajectory(POOL.x @ C.T, POOL.u)
    by_hand = fit_map(Comparisons(seen, NOISY.first, NOISY.second, NOISY.labels), prior)
    np.testing.assert_allclose(result.Q, C.T @ by_hand.Q @ C, rtol=1e-10)
    assert result.objective == by_hand.objective
    np.testing.assert_allclose(result.model(POOL), by_hand.model(seen), rtol=1e-10)
    np.testing.assert_allclose(result.std_R, by_hand.std_R, rtol=1e-10)


def test_laplace_deviations_are_those_of_the_inverse_hessian_by_finite_differences():
    result = fit_map(NOISY, COUPLED)
    pairs = [(0, i, j) for i in range(6) for j in range(i + 1)] + [(1, 0, 0), (1, 1, 0), (1, 1, 1)]

    def moved(entries):
        W = [result.Q.copy(), result.R.copy()]
        for (which, i, j), step in entries:
            W[which][i, j] += step
            W[which][j, i] = W[which][i, j]
        return minus_log_posterior(*W, NOISY, COUPLED)

    scale = [
        1e-3 * np.sqrt(W[i, i] * W[j, j]) for k, i, j in pairs for W in [(result.Q, result.R)[k]]
    ]
    H = np.zeros((24, 24))
    for a in range(24):
        for b in range(a + 1):
            signs = [(s, t) for s in (1, -1) for t in (1, -1)]
            values = [
                s * t * moved([(pairs[a], s * scale[a]), (pairs[b], t * scale[b])])
                for s, t in signs
            ]
            H[a, b] = H[b, a] = sum(values) / (4 * scale[a] * scale[b])
    std = np.sqrt(np.diag(np.linalg.inv(H)))
    for value, (which, i, j) in zip(std, pairs, strict=True):
        assert (result.std_Q, result.std_R)[which][i, j] == pytest.approx(value, rel=2e-3)


def test_a_less_sure_person_has_smaller_weights_and_the_same_wishes():
    result = fit_map(NOISY, COUPLED)
    half = fit_map(
        Comparisons(  # log-odds of half the size: trajectories shrunk by the square root
            Trajectory(POOL.x / 2**0.5, POOL.u / 2**0.5), NOISY.first, NOISY.second, NOISY.labels
        ),
        WishartPrior(2 * COUPLED.Q, 2 * COUPLED.R, COUPLED.strength),
    )
    np.testing.assert_allclose(half.Q, 2 * result.Q, rtol=1e-6)
    assert half.sharpness == pytest.approx(result.sharpness, rel=1e-6)
    W0 = np.trace(np.linalg.solve(COUPLED.Q, result.normalised.Q))
    W0 += np.trace(np.linalg.solve(COUPLED.R, result.normalised.R))
    assert W0 == pytest.approx(8)


def test_the_nearest_diagonal_explains_less_and_is_the_diagonal_minimum():
    result = fit_map(NOISY, COUPLED)
    nearest = result.nearest_diagonal()
    assert nearest.log_likelihood < result.log_likelihood < 0
    assert np.count_nonzero(nearest.Q) == 6
    assert np.count_nonzero(nearest.R) == 2
    x, u = POOL.x[:, :-1], POOL.u
    sigma = np.einsum("tki,ij,tkj->t", x, result.Q, x) + np.einsum("tki,ij,tkj->t", u, result.R, u)
    z = sigma[NOISY.second] - sigma[NOISY.first]
    assert result.log_likelihood == pytest.approx(-np.sum(np.logaddexp(0, z) - NOISY.labels * z))


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("strength", [0.01, 1.0, 100.0])
def test_every_prior_is_solved_in_few_steps(scale, strength):
    for data in (CLEAN, NOISY.sampled(key=jax.random.key(1))):
        result = fit_map(data, bryson(RADIUS, [1, 1], scale=scale, strength=strength))
        assert result.success, result.message
        assert result.iterations <= 60


def test_units_do_not_matter():
    # The same experiment in millimetres: x is 1000 times as large, Q a millionth.
    big = Trajectory(1000 * POOL.x, POOL.u, 1000 * POOL.y)
    data = Comparisons(big, CLEAN.first, CLEAN.second, CLEAN.labels)
    metres, millimetres = fit_map(CLEAN, BRYSON), fit_map(data, bryson(1000 * RADIUS, [1, 1]))
    np.testing.assert_allclose(
        millimetres.Q, metres.Q / 1e6, rtol=1e-6, atol=1e-6 * metres.Q.max() / 1e6
    )
    np.testing.assert_allclose(millimetres.R, metres.R, rtol=1e-6)


def test_the_result_is_deterministic_and_does_not_depend_on_padding_or_order():
    one, two = fit_map(CLEAN, BRYSON), fit_map(CLEAN, BRYSON)
    np.testing.assert_array_equal(one.Q, two.Q)
    turned = fit_map(CLEAN.subset(np.arange(50)[::-1]), BRYSON)
    np.testing.assert_allclose(turned.Q, one.Q, rtol=1e-6, atol=1e-6 * one.Q.max())
    # 100 pairs need the next larger shape: each answer twice is each answer with weight 2.
    twice = fit_map(CLEAN.subset(np.tile(np.arange(50), 2)), bryson(RADIUS, [1, 1], strength=2))
    np.testing.assert_allclose(twice.Q, one.Q, rtol=1e-6, atol=1e-6 * one.Q.max())


@settings(max_examples=40)
@given(
    st.integers(0, 10_000),
    st.integers(1, 12),
    st.sampled_from(["first", "second", "cannot say", "contradictory", "random"]),
    st.floats(-6, 6),
)
def test_whatever_the_data_the_answer_is_finite_and_definite(seed, n, kind, exponent):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(4, 3, 2)) * [1, 10.0**exponent], rng.normal(size=(4, 2, 1))
    x[0], u[0] = 0, 0  # a trajectory of zeros
    first, second = rng.integers(0, 4, n), rng.integers(0, 4, n)
    labels = {
        "first": np.ones(n),
        "second": np.zeros(n),
        "cannot say": np.full(n, 0.5),
        "contradictory": np.arange(n) % 2.0,
        "random": rng.uniform(size=n),
    }[kind]
    if kind == "contradictory":
        first[:], second[:] = 1, 2
    data = Comparisons(Trajectory(x, u), first, second, labels)
    result = fit_map(data, bryson([1, 10.0**exponent], [1]))
    assert result.success, result.message
    for W in (result.Q, result.R):
        assert np.linalg.eigvalsh(W / np.sqrt(np.outer(np.diag(W), np.diag(W)))).min() > 0


def test_an_unfinished_solve_says_so_and_hands_out_no_model():
    with pytest.warns(RuntimeWarning, match="max_iterations after 2 Newton steps"):
        result = fit_map(CLEAN, BRYSON, max_iterations=2)
    assert not result.success
    with pytest.raises(FitError, match="max_iterations"):
        _ = result.model


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
@pytest.mark.parametrize("place", ["decrement", "objective"])
def test_only_a_small_finite_decrement_is_a_minimum(monkeypatch, place, bad):
    true = convex.solve

    def broken(*arguments):
        value = -1.0 if (place, bad) == ("objective", 1.0) else bad
        return [minimum._replace(**{place: value}) for minimum in true(*arguments)]

    monkeypatch.setattr(convex, "solve", broken)
    if (place, bad) == ("objective", 1.0):
        assert fit_map(CLEAN, BRYSON).success  # any finite objective will do
        return
    with pytest.warns(RuntimeWarning, match="max_iterations|not_finite"):
        assert not fit_map(CLEAN, BRYSON).success
    monkeypatch.setattr(selection, "solve", broken)
    with pytest.raises(FitError, match="1 of 1 problems were not solved"):
        choose_prior(CLEAN, [BRYSON])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_map(POOL, BRYSON), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: fit_map(CLEAN, np.eye(6)), "prior must be a WishartPrior, got ndarray"),
        (lambda: fit_map(CLEAN, bryson([1], [1])), "prior must weigh 6 states and 2 inputs, got Q"),
        (lambda: fit_map(CLEAN, BRYSON, tol=-1), "tol must be finite and at least 0"),
        (lambda: fit_map(CLEAN, BRYSON, max_iterations=0), "max_iterations must be a whole number"),
        (lambda: fit_map(CLEAN, BRYSON, structure="banded"), 'must be "full", "diagonal" or two'),
        (lambda: fit_map(CLEAN, COUPLED, structure="diagonal"), "prior must fit structure .diag"),
        (lambda: fit_map(CLEAN, BRYSON, structure=(np.eye(6) > 0, 1)), "mask .2, 2. for R"),
        (
            lambda: fit_map(CLEAN, BRYSON, structure=(np.eye(6), np.eye(2))),
            "bool mask .6, 6. for Q",
        ),
        (lambda: fit_map(CLEAN, BRYSON, outputs=np.eye(3)), "outputs must have 6 columns"),
        (
            lambda: fit_map(CLEAN, BRYSON, outputs=np.eye(6)[:3]),
            "must weigh 3 outputs and 2 inputs",
        ),
        (lambda: fit_maps([CLEAN, POOL], BRYSON), "comparisons must be a Comparisons, got Traj"),
        (lambda: fit_maps(CLEAN, [BRYSON, 1]), "priors must be a WishartPrior, got int"),
        (lambda: fit_maps([CLEAN] * 2, [BRYSON] * 3), "must be equally many, .* got 2 and 3"),
        (lambda: fit_maps(CLEAN, []), "priors must be a sequence of at least one WishartPrior"),
        (
            lambda: fit_maps([CLEAN, SMALL], BRYSON),
            "must all have 6 states and 2 inputs, got 1 and",
        ),
        (lambda: blocks([[0, 1], [1]], [[0]]), "states must name each index 0 to 2 in one group"),
        (lambda: blocks([[0]], []), "inputs must name each index"),
        (lambda: WishartPrior(-np.eye(2), np.eye(1)), "Q must be positive definite"),
        (lambda: WishartPrior(np.eye(2), np.zeros((1, 1))), "R must be positive definite"),
        (lambda: WishartPrior(np.ones((2, 3)), np.eye(1)), "Q must be a square matrix"),
        (lambda: WishartPrior(np.ones((2, 1, 1)), np.eye(1)), "Q must be one matrix"),
        (lambda: WishartPrior(np.eye(1), np.eye(1), strength=0), "strength must be positive"),
        (lambda: bryson([1, 0], [1]), "x_max must hold positive numbers"),
        (lambda: bryson([1], []), "u_max must hold positive numbers"),
        (lambda: bryson([np.nan], [1]), "x_max must be finite"),
        (lambda: bryson([1], [1], scale=0), "scale must be positive, got 0"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("outputs", [None, np.eye(2)])
def test_set_points_count_in_outputs_and_in_new_pairs(outputs):
    rng = np.random.default_rng(5)
    x, u, x_r, u_r = (rng.normal(size=s) for s in ((20, 6, 2), (20, 5, 1), (20, 2), (20, 1)))
    there = Trajectory(x, u, x_r=x_r, u_r=u_r)
    pairs, labels = (np.arange(10), np.arange(10, 20)), rng.integers(0, 2, 10).astype(float)
    asked, plain = (
        fit_map(Comparisons(T, *pairs, labels), bryson([1, 1], [1]), outputs=outputs)
        for T in (there, there.deviation())
    )
    np.testing.assert_array_equal(asked.Q, plain.Q)
    means = asked.probability(there[:10], there[10:]).mean
    z = asked.model(there[10:]) - asked.model(there[:10])
    assert ((means > 0.5) == (z > 0)).all()
