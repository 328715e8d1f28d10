"""Learning and nonlinear plants in any unit: the scaled answer, or a failure that says so."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from prefmpc import (
    Comparisons,
    LinearMPC,
    LinearSystem,
    NonlinearMPC,
    NonlinearSystem,
    Polyhedron,
    QuadraticCost,
    QuadraticPreference,
    Trajectory,
    WishartPrior,
    bryson,
    cart_pendulum,
    choose_prior,
    erring,
    fit_map,
    kinematic_bicycle,
    lqr_pool,
    oscillating_masses,
    posterior,
)
from prefmpc.mpc import _nlp
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

POOL = lqr_pool(oscillating_masses(), 30, 10, key=jax.random.key(5100), radius=RADIUS)
PERSON = erring(QuadraticPreference(QUADRATIC_Q, QUADRATIC_R), 0.2)
ANSWERS = Comparisons.random(POOL, PERSON, 50, key=jax.random.key(5101)).sampled(
    key=jax.random.key(5102)
)
PRIORS = {
    "bryson": bryson(RADIUS, [1, 1]),
    "coupled": WishartPrior(30 * np.eye(6) + 5, np.array([[20.0, 3], [3, 10]]), 2.5),
}
ALL_SIZES = st.lists(st.floats(-9, 9), min_size=8, max_size=8)


def scaled(x, u):
    """Return the answers about trajectories in other units."""
    trajectories = Trajectory(POOL.x * x, POOL.u * u)
    return Comparisons(trajectories, ANSWERS.first, ANSWERS.second, ANSWERS.labels)


def prior_in(name, x, u, scale=1.0):
    prior = PRIORS[name]
    Q, R = (scale * W / np.outer(s, s) for W, s in ((prior.Q, x), (prior.R, u)))
    return WishartPrior(Q, R, prior.strength)


@cache
def reference(name, structure):
    result = fit_map(ANSWERS, PRIORS[name], structure=structure)
    assert result.success
    return result


@settings(max_examples=200)
@given(ALL_SIZES, st.sampled_from(["bryson", "bryson diagonal", "coupled"]), st.floats(-6, 6))
def test_the_weights_are_those_of_the_units(exponents, kind, common):
    size = 10.0 ** np.array(exponents)
    if kind == "coupled":  # each by three decades at most, and all together by six
        size = 10.0 ** (np.array(exponents) / 3 + common)
    name, _, structure = kind.partition(" ")
    x, u = size[:6], size[6:]
    expected = reference(name, structure or "full")
    result = fit_map(scaled(x, u), prior_in(name, x, u), structure=structure or "full")
    assert result.success, result.message
    for W, W0, s in ((result.Q, expected.Q, x), (result.R, expected.R, u)):
        back = W * np.outer(s, s)
        np.testing.assert_allclose(back, W0, rtol=1e-6, atol=1e-6 * np.abs(W0).max())
    assert result.decrement == pytest.approx(expected.decrement, rel=1e-3, abs=1e-12)


def test_posteriors_and_evidence_are_those_of_the_units():
    rng = np.random.default_rng(0)
    samples = posterior(reference("bryson", "full"), draws=256)
    ones = np.ones(6), np.ones(2)
    priors = [prior_in("bryson", *ones, scale) for scale in (1, 10)]
    scores = {by: choose_prior(ANSWERS, priors, by=by).scores for by in BY}
    for _ in range(3):
        size = 10.0 ** rng.uniform(-9, 9, 8)
        x, u = size[:6], size[6:]
        data, beliefs = scaled(x, u), [prior_in("bryson", x, u, scale) for scale in (1, 10)]
        drawn = posterior(fit_map(data, beliefs[0]), draws=256)
        assert drawn.success
        np.testing.assert_allclose(drawn.std_Q * np.outer(x, x), samples.std_Q, rtol=1e-6)
        np.testing.assert_allclose(drawn.std_R * np.outer(u, u), samples.std_R, rtol=1e-6)
        for by, expected in scores.items():
            found = choose_prior(data, beliefs, by=by)
            np.testing.assert_allclose(found.scores, expected, rtol=1e-6)


BY = ("evidence", "cross_validation")


@pytest.mark.parametrize("exponent", [-9, -6, -3, 0, 3, 6, 9])
def test_costs_that_hardly_or_hugely_differ(exponent):
    # One state, no input to speak of: the weight q is the minimum of a function of one number.
    size = 10.0**exponent
    first, second, labels = [0, 1, 2, 0], [1, 2, 0, 2], np.array([1.0, 0, 0, 1])
    x = size * np.array([[1.0, 2, 3], [2, 3, 5], [0.5, 6, 1]])[:, :, None]
    data = Comparisons(Trajectory(x, np.zeros((3, 2, 1))), first, second, labels)
    result = fit_map(data, bryson([1], [1]))
    assert result.success, result.message
    S = (x[:, :-1, 0] ** 2).sum(axis=1)
    gap = S[second] - S[first]

    def cost(log_q):
        z = np.exp(log_q) * gap
        return np.sum(np.logaddexp(0, z) - labels * z) + np.exp(log_q) - log_q

    found = minimize_scalar(cost, bracket=(-2 * np.log(size) - 3, 1), options={"xtol": 1e-12})
    assert np.log(result.Q[0, 0]) == pytest.approx(found.x, abs=1e-5)


# ---- controllers of nonlinear plants ----

A, B = np.array([[1, 0.1], [0.02, 1.02]]), np.array([[0.005], [0.1]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.05]])
H, LIMITS = np.array([[1.0, 0, 0], [0, 1, 0], [0, -1, 0], [0.5, 0, 1]]), [1.2, 0.5, 0.5, 0.7]


def controller(x=(1.0, 1.0), u=1.0, cost=1.0, low=-1.0, high=1.0):
    """Return the same problem with states, inputs and σ in other units."""
    x, u = np.array(x), np.array([u])
    plant = LinearSystem(
        A * x[:, None] / x, B * x[:, None] / u, dt=0.1, u_min=low * u, u_max=high * u
    )
    weights = QuadraticCost(cost * Q / np.outer(x, x), cost * R / np.outer(u, u))
    limits = Polyhedron(H / np.concatenate([x, u]), LIMITS)
    return NonlinearMPC(plant, weights, 15, constraints=limits)


BOUNDS = {"box": (-1.0, 1.0), "above": (-0.4, np.inf), "none": (-np.inf, np.inf)}
SIZES = st.lists(st.floats(-9, 9), min_size=4, max_size=4)


@settings(max_examples=40)
@given(
    SIZES,
    st.sampled_from(sorted(BOUNDS)),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0]),
)
def test_plans_are_those_of_the_units(exponents, bounds, distance):
    *x, u, cost = 10.0 ** np.array(exponents)
    low, high = BOUNDS[bounds]
    start = distance * np.array([1.0, -0.45])
    expected = controller(low=low, high=high).solve(start)
    answer = controller(x, u, cost, low, high).solve(start * x)
    assert expected.status == answer.status == "solved"
    size = np.abs(expected.trajectory.u).max()
    found = answer.trajectory.u / u
    np.testing.assert_allclose(found, expected.trajectory.u, rtol=0, atol=1e-6 * size)
    exact = LinearMPC(LinearSystem(A, B, dt=0.1, u_min=low, u_max=high), QuadraticCost(Q, R), 15,
                      constraints=Polyhedron(H, LIMITS)).solve(start)  # fmt: skip
    np.testing.assert_allclose(expected.trajectory.u, exact.trajectory.u, atol=1e-6)


def test_swing_ups_do_not_depend_on_the_size_of_the_cost():
    weights = np.diag([1.0, 10, 0.1, 0.1]), np.array([[0.01]])
    start = [0.1, 0.4, 0, -0.3]
    plans = []
    for size in (1, 1e-9, 1e-4, 1e5, 1e9):
        cost = QuadraticCost(*(size * W for W in weights))
        answer = NonlinearMPC(cart_pendulum(), cost, 10).solve(start)
        assert answer.success
        plans.append(answer.trajectory.u)
    for plan in plans[1:]:
        np.testing.assert_allclose(plan, plans[0], atol=1e-5)  # of 10 N


def test_long_horizons_of_unstable_plants_are_right_or_failed():
    statuses = []
    for a in (1.02, 1.1, 1.5, 2.0):
        plant = LinearSystem([[a, 0.5], [0, 1.1]], [[0], [1]], dt=0.1, u_min=-1, u_max=1)
        cost = QuadraticCost(np.eye(2), [[0.1]])
        expected = LinearMPC(plant, cost, 100).solve([0.03, 0.01])
        answer = NonlinearMPC(plant, cost, 100).solve([0.03, 0.01])
        statuses.append(answer.status)
        if answer.success:
            np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, atol=1e-5)
    assert statuses[0] == "solved"


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_state_is_on_a_limit_or_beyond_it_in_any_unit(unit):
    small = 4e-7
    for beyond, status in ((small, "solved"), (-small, "solved"), (1e-4, "infeasible")):
        state = np.array([1.2 + beyond * 1.2, -0.2])
        answer = controller(x=(unit, unit), u=unit).solve(state * unit)
        assert answer.status == status
        if status == "infeasible":
            assert "x(0) itself is beyond a limit by 9.8e-05 of its size" in answer.message
            assert answer.iterations == 0


def locked(bounds):
    low, high = np.array(bounds, float).T
    plant = LinearSystem(A, np.column_stack([B, [0.0, 0.05]]), dt=0.1, u_min=-1, u_max=1)
    object.__setattr__(plant, "u_min", low)
    object.__setattr__(plant, "u_max", high)
    return plant


def test_a_locked_input_stays_where_it_is():
    start, N = np.array([0.5, -0.3]), 6
    weights = QuadraticCost(Q, np.diag([0.05, 0.05]))
    plant = locked([(-1, 1), (0.3, 0.3)])
    answer = NonlinearMPC(plant, weights, N).solve(start)
    assert answer.success
    assert (answer.trajectory.u[:, 1] == 0.3).all()
    x, u = cp.Variable((N + 1, 2)), cp.Variable((N, 2))
    cost = sum(cp.quad_form(x[k], Q) + 0.05 * cp.sum_squares(u[k]) for k in range(N))
    rules = [x[0] == start, u[:, 1] == 0.3, cp.abs(u[:, 0]) <= 1]
    rules += [x[k + 1] == plant.A @ x[k] + plant.B @ u[k] for k in range(N)]
    problem = cp.Problem(cp.Minimize(cost), rules)
    problem.solve(solver=cp.CLARABEL)
    assert answer.cost == pytest.approx(problem.value, rel=1e-6)
    np.testing.assert_allclose(answer.trajectory.u, u.value, atol=1e-5)
    fixed = NonlinearMPC(locked([(0.2, 0.2), (0.3, 0.3)]), weights, N)
    np.testing.assert_array_equal(fixed.solve(start).trajectory.u, [[0.2, 0.3]] * N)


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
@pytest.mark.parametrize("number", ["stationarity", "violation"])
def test_a_plan_is_solved_only_by_small_finite_numbers(monkeypatch, number, bad):
    mpc = controller()
    assert mpc.solve([0.5, 0.1]).success
    monkeypatch.setattr(_nlp, number, lambda *_: bad)
    answer = mpc.solve([0.5, 0.1])
    assert answer.status in ("failed", "infeasible")
    assert np.isnan(answer.u).all()
    assert np.isnan(answer.trajectory.x).all()


def test_a_plan_whose_last_state_is_infinite_fails():
    plant = NonlinearSystem(_steep, nx=1, nu=1, dt=1, u_min=-1, u_max=1)
    answer = NonlinearMPC(plant, QuadraticCost([[1.0]], [[1.0]]), 1).solve([800.0])
    assert answer.status == "failed"
    assert np.isnan(answer.u).all()


def _steep(x, u):
    return jnp.exp(x) + u


# ---- copies and threads ----


def test_plants_and_controllers_can_be_copied():
    state, u = np.full(4, 0.1), np.full(2, 0.1)
    for plant in (cart_pendulum(), kinematic_bicycle()):
        for other in (pickle.loads(pickle.dumps(plant)), copy.deepcopy(plant)):
            assert other.f == plant.f
            assert hash(other.f) == hash(plant.f)  # so that nothing is compiled again
            moved = [p.step(state, u[: p.nu]) for p in (other, plant)]
            np.testing.assert_array_equal(*moved)
    mpc = NonlinearMPC(cart_pendulum(), QuadraticCost(np.eye(4), [[1.0]]), 10)
    answer = mpc.solve(state)
    for twin in (pickle.loads(pickle.dumps(mpc)), copy.deepcopy(mpc)):
        again = twin.solve(state)
        np.testing.assert_allclose(again.u, answer.u, atol=1e-9)
        assert again.success


def test_threads_may_share_a_controller():
    mpc, rng = controller(), np.random.default_rng(1)
    states = rng.uniform(-0.4, 0.4, (80, 2))
    expected = [mpc.solve(state).trajectory.u for state in states]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(mpc.solve, states))
    for answer, plan in zip(answers, expected, strict=True):
        assert answer.success
        np.testing.assert_allclose(answer.trajectory.u, plan, atol=1e-8)
