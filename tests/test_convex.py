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
    bryson,
    erring,
    fit_map,
    lqr_pool,
    oscillating_masses,
    second_moments,
)
from prefmpc.studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

POOL = lqr_pool(oscillating_masses(), 30, 10, key=jax.random.key(2000), radius=RADIUS)
PERSON = QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
CLEAN = Comparisons.random(POOL, PERSON, 50, key=jax.random.key(2001))
NOISY = Comparisons.random(POOL, erring(PERSON, 0.2), 50, key=jax.random.key(2002))  # soft labels
BRYSON = bryson(RADIUS, [1, 1])
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


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_map(POOL, BRYSON), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: fit_map(CLEAN, np.eye(6)), "prior must be a WishartPrior, got ndarray"),
        (lambda: fit_map(CLEAN, bryson([1], [1])), "prior must weigh 6 states and 2 inputs, got Q"),
        (lambda: fit_map(CLEAN, BRYSON, tol=-1), "tol must be finite and at least 0"),
        (lambda: fit_map(CLEAN, BRYSON, max_iterations=0), "max_iterations must be a whole number"),
        (lambda: fit_map(CLEAN, BRYSON, structure="banded"), 'must be "full" or "diagonal", got'),
        (lambda: fit_map(CLEAN, COUPLED, structure="diagonal"), "prior must be diagonal"),
        (lambda: WishartPrior(-np.eye(2), np.eye(1)), "Q must be positive definite"),
        (lambda: WishartPrior(np.eye(2), np.zeros((1, 1))), "R must be positive definite"),
        (lambda: WishartPrior(np.ones((2, 3)), np.eye(1)), "Q must be a square matrix"),
        (lambda: WishartPrior(np.ones((2, 1, 1)), np.eye(1)), "Q must be one matrix"),
        (lambda: WishartPrior(np.eye(1), np.eye(1), strength=0), "strength must be positive"),
        (lambda: bryson([1, 0], [1]), "x_max must hold positive deviations"),
        (lambda: bryson([1], []), "u_max must hold positive deviations"),
        (lambda: bryson([np.nan], [1]), "x_max must be finite"),
        (lambda: bryson([1], [1], scale=0), "scale must be positive, got 0"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
