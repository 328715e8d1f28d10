"""`NonlinearMPC`: no failed solve and no bad input is silent."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import multiple_shooting as casadi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nonlinear_controllers import (
    CAR,
    CARRIAGE,
    COUPLED,
    KEY,
    LANE,
    LIMITS,
    MASSES,
    PAPER,
    PENDULUM,
    SETS,
    N,
    car,
    cold,
    pendulum,
)

from prefmpc import (
    Ellipsoid,
    ICNNCost,
    LinearSystem,
    MLPCost,
    MPCError,
    NonlinearMPC,
    NonlinearSystem,
    QuadraticCost,
    SumCost,
    steady_state,
)
from prefmpc.mpc import _newton


@settings(max_examples=20)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_what_is_solved_is_feasible(where):
    x0 = np.array([0, 0, 0, 20]) + np.array(where) * [20, 0.3, 0.02, 9]
    answer = cold(PROPERTY, x0, reference=LANE)
    T = answer.trajectory
    if not answer.success:
        assert np.isnan(answer.u).all()
        assert answer.status in ("infeasible", "failed", "max_iterations")
        return
    assert LIMITS.contains(np.concatenate([T.x[:-1], T.u], axis=1), tol=1e-6).all()
    assert (np.abs(T.y[:, 2]) <= casadi.LIMIT + 1e-6).all()
    assert ((CAR.u_min <= T.u) & (T.u <= CAR.u_max)).all()
    np.testing.assert_allclose(T.x[1:], CAR.step(T.x[:-1], T.u), rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(T.x[0], x0)


PROPERTY = car()


# ---- what is not solved is said ----


def flagged(controller, x0, status, words, **options):
    answer = cold(controller, x0, **options)
    assert answer.status == status
    assert not answer.success
    for value in (answer.u, answer.cost, answer.trajectory.x, answer.trajectory.u):
        assert np.isnan(value).all()
    controller.reset()
    if not options:
        with pytest.raises(MPCError, match=words) as caught:
            controller(x0)
        assert caught.value.solution.status == status
    assert words in answer.message
    return answer


def test_failures_are_flagged():
    fast = np.array([0, 0, 0, 31.0])
    flagged(PROPERTY, fast, "infeasible", "no input sequence", reference=LANE)
    far = NonlinearMPC(MASSES, PAPER, N, **SETS)
    flagged(far, np.array([0.4, 0.4, 0.4, 2, 2, 2]), "infeasible", "no input sequence")
    hasty = pendulum(max_iterations=1)
    flagged(hasty, [0, 3.0, 0, 0], "max_iterations", "not a minimum")


LOG = NonlinearSystem(lambda x, u: jnp.log(x) + u, nx=1, nu=1, dt=1, u_min=-2, u_max=2)
SMALL = QuadraticCost([[1.0]], [[1.0]])


def test_numbers_that_end_are_flagged():
    controller = NonlinearMPC(LOG, SMALL, 2)
    flagged(controller, [-1.0], "failed", "f, g, path or σ returns NaN or infinity")
    # The start is fine here and steps into the void are only too long.
    answer = cold(controller, [1.2], start=[[1.0], [0.0]])
    assert answer.status in ("solved", "failed", "max_iterations")
    assert answer.success == bool(np.isfinite(answer.u).all())


def test_a_broken_cost_is_flagged():
    broken = jax.tree.map(lambda leaf: leaf * np.nan, SMALL)
    controller = NonlinearMPC(LOG, broken, 2)
    flagged(controller, [3.0], "failed", "σ returns NaN")


def test_a_network_that_is_not_smooth_stops_at_a_kink_and_says_so():
    line = LinearSystem([[1.0]], [[1.0]], dt=1, u_min=-1, u_max=1)
    absolute = MLPCost(
        [[[1.0, 1.0], [-1.0, -1.0]]], [[0.0, 0.0]], [1.0, 1.0], scale=[1.0, 1.0], activation="relu"
    )  # |x + u|, whose minimum is no stationary point
    controller = NonlinearMPC(line, absolute, 1)
    answer = controller.solve([0.5])
    assert answer.status != "solved"
    smooth = SumCost([MLPCost.random([1.0, 1.0], key=KEY, widths=(4,), activation="relu")])
    for x in np.linspace(-1, 1, 5):
        answer = cold(NonlinearMPC(line, smooth, 1), [x])
        if answer.success:  # a true minimum: no better input nearby
            near = np.clip(answer.u + np.array([[-1e-3], [1e-3]]), -1, 1)
            values = [v for u in near for v in [smooth(_one(x, u))]]
            assert min(values) >= answer.cost - 1e-6


def _one(x, u):
    from prefmpc import Trajectory

    return Trajectory([[x], [x + u[0]]], [u])


@pytest.mark.parametrize("kind", [MLPCost, ICNNCost])
def test_solves_with_networks_end_in_minima(monkeypatch, kind):
    options = {"activation": "tanh" if kind is MLPCost else "softplus", "widths": (6,)}
    network = kind.random([1.0, 1.0, 10.0], key=KEY, **options)
    cost = SumCost([QuadraticCost(0.1 * np.eye(2), [[0.01]]), network])
    controller = NonlinearMPC(CARRIAGE, cost, N)
    states = np.random.default_rng(3).uniform(-2, 2, (6, 2))
    by_newton = [cold(controller, x) for x in states]
    monkeypatch.setattr(_newton, "NEWTON_STEPS", 0)
    for x, a in zip(states, by_newton, strict=True):
        b = cold(controller, x)  # by SLSQP alone
        assert a.status == b.status == "solved"
        if a.cost != pytest.approx(b.cost, rel=1e-6):
            assert np.abs(a.trajectory.u - b.trajectory.u).max() > 0.1


def test_what_newton_steps_leave_is_solved_by_slsqp(monkeypatch):
    expected = cold(PROPERTY, [0, 0, 0, 20.0], reference=LANE)
    monkeypatch.setattr(_newton, "NEWTON_STEPS", 1)
    answer = cold(car(), [0, 0, 0, 20.0], reference=LANE)
    assert answer.status == "solved"
    assert answer.iterations > expected.iterations
    assert answer.cost == pytest.approx(expected.cost, rel=1e-6)


SMOOTH = QuadraticCost(np.eye(4), np.eye(1))
STACK = QuadraticCost(np.stack([np.eye(4)] * 2), np.stack([np.eye(1)] * 2))
ELSEWHERE = steady_state(CAR, [0, 0, 0, 35.0], start=([0, 0, 0, 35.0], [0, 0]))


def mpc(cost=SMOOTH, horizon=2, **options):
    return NonlinearMPC(PENDULUM, cost, horizon, **options)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: NonlinearMPC("plant", SMOOTH, 2), "system must be a System, got str"),
        (lambda: mpc(1), "cost must be a σ model, got int"),
        (lambda: mpc(STACK), r"cost must be a single model, got a stack \(2,\)"),
        (lambda: mpc(PAPER), "cost must fit the system and the horizon"),
        (lambda: mpc(MLPCost.random(np.ones(5), key=KEY, steps=3)), "cost must fit.* trajectory.u"),
        (lambda: mpc(MLPCost.random(np.ones(4), key=KEY)), "cost must fit the system"),
        (lambda: mpc(horizon=0), "horizon must be a whole number of at least 1"),
        (lambda: mpc(solver="magic"), "solver must be .*newton.*, got .magic"),
        (lambda: mpc(tol=-1), "tol must be finite and at least 0"),
        (lambda: mpc(max_iterations=0), "max_iterations must be a whole number"),
        (lambda: mpc(constraints=COUPLED), "constraints must have dimension 5, got 8"),
        (lambda: mpc(constraints=np.eye(5)), "constraints must be a Polyhedron, got ndarray"),
        (lambda: mpc(terminal=COUPLED), "terminal must have dimension 4, got 8"),
        (lambda: mpc(terminal=Ellipsoid(np.eye(2))), "terminal must have dimension 4, got 2"),
        (lambda: mpc(terminal=np.eye(4)), "terminal must be a Polyhedron, got ndarray"),
        (lambda: mpc(path=3), "path must be a function"),
        (lambda: mpc(path=lambda x, u: x[0]), r"path must return an array of shape \(m,\)"),
        (lambda: mpc(path=lambda x, u: np.sin(x)), r"path\(x, u\) must work on JAX arrays"),
        (lambda: mpc().solve([1.0, 2]), r"x0 must have shape \(..., 4\)"),
        (lambda: mpc().solve(np.zeros((2, 4))), r"x0 must have shape \(4,\)"),
        (lambda: mpc().solve([0, np.nan, 0, 0]), "x0 must be finite"),
        (lambda: mpc().solve(np.zeros(4), u_before=[1, 2]), "u_before must have shape"),
        (lambda: mpc().solve(np.zeros(4), u_before=[np.inf]), "u_before must be finite"),
        (lambda: mpc().solve(np.zeros(4), start=[[1.0]]), r"start must have shape \(2, 1\)"),
        (lambda: mpc().solve(np.zeros(4), start=[[np.nan], [0]]), "start must be finite"),
        (lambda: mpc().solve(np.zeros(4), reference=[0.0]), "reference must be a SteadyState"),
        (
            lambda: NonlinearMPC(MASSES, PAPER, 2).solve(np.zeros(6), reference=LANE),
            "reference must have dimension 6, got 4",
        ),
        (
            lambda: car().solve([0, 0, 0, 20], reference=ELSEWHERE),
            "reference must satisfy the constraints",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
