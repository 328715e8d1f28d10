"""`NonlinearMPC` against quadratic programs and against CasADi; no failed solve is silent."""

from __future__ import annotations

import cvxpy as cp
import jax
import jax.numpy as jnp
import multiple_shooting as casadi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prefmpc import (
    Ellipsoid,
    ICNNCost,
    LinearMPC,
    LinearSystem,
    MLPCost,
    MPCError,
    NonlinearMPC,
    NonlinearSystem,
    Polyhedron,
    QuadraticCost,
    SignalCost,
    SumCost,
    cart_pendulum,
    kinematic_bicycle,
    oscillating_masses,
    random_states,
    simulate,
    steady_state,
    terminal_ingredients,
)
from prefmpc.mpc import _newton, _quadratic
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2700)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
N = 10
COUPLED = Polyhedron(
    [[1, 0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, -1, 0, 0.5]],
    [0.5, 0.8, 0.6],
)
TERMINAL = Polyhedron.box([-0.5] * 6, [0.5] * 6)
SETS = {"constraints": COUPLED, "terminal": TERMINAL}
NEAR = np.array([0.8, 0.8, 0.8, 0.6, 0.6, 0.6])


def cold(controller, x0, **options):
    controller.reset()
    return controller.solve(x0, **options)


def test_a_quadratic_program_is_solved_like_one():
    count = 200
    linear, controller = LinearMPC(MASSES, PAPER, N), NonlinearMPC(MASSES, PAPER, N)
    saturated = 0
    for x in random_states(8 * RADIUS, key=KEY, shape=(count,)):
        expected, answer = linear.solve(x), cold(controller, x)
        assert (answer.status, answer.message) == ("solved", "a local minimum")
        np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(answer.u, answer.trajectory.u[0])
        assert answer.cost == pytest.approx(expected.cost, rel=1e-6)
        moved = answer.trajectory.x[:-1] @ MASSES.A.T + answer.trajectory.u @ MASSES.B.T
        np.testing.assert_allclose(answer.trajectory.x[1:], moved, atol=1e-12)
        np.testing.assert_allclose(answer.trajectory.y, answer.trajectory.x[:-1, :3])
        assert answer.residual < 1e-6
        saturated += (np.abs(answer.trajectory.u) > 1 - 1e-6).mean() > 0.1
    assert saturated > count / 2


def test_coupled_constraints_and_what_cannot_be_done():
    linear = LinearMPC(MASSES, PAPER, N, **SETS)
    controller = NonlinearMPC(MASSES, PAPER, N, **SETS)
    seen = {"solved": 0, "infeasible": 0}
    for x in random_states(NEAR, key=KEY, shape=(24,)):
        expected, answer = linear.solve(x), cold(controller, x)
        assert answer.status == expected.status
        seen[answer.status] += 1
        if answer.success:
            np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, atol=1e-5)
            points = np.concatenate([answer.trajectory.x[:-1], answer.trajectory.u], axis=1)
            assert COUPLED.contains(points, tol=1e-6).all()
            assert TERMINAL.contains(answer.trajectory.x[-1], tol=1e-6)
        else:
            assert "no input sequence keeps x(0)" in answer.message
            for value in (answer.u, answer.cost, answer.trajectory.x, answer.trajectory.u):
                assert np.isnan(value).all()
    assert min(seen.values()) >= 6


def test_a_set_point_is_followed_like_by_the_quadratic_program():
    loose = Polyhedron(COUPLED.H, COUPLED.h + 0.5)
    reference = steady_state(MASSES, [0.2, 0.1, 0.0], nearest=True)
    linear = LinearMPC(MASSES, PAPER, N, constraints=loose)
    controller = NonlinearMPC(MASSES, PAPER, N, constraints=loose)
    solved = 0
    for x in random_states(NEAR, key=KEY, shape=(10,)):
        expected = linear.solve(x, reference=reference)
        answer = cold(controller, x, reference=reference)
        assert answer.status == expected.status
        if answer.success:
            solved += 1
            np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, atol=1e-5)
            assert answer.cost == pytest.approx(expected.cost, rel=1e-5, abs=1e-8)
            np.testing.assert_array_equal(answer.trajectory.x_r, reference.x)
            # What is reported is σ of what is shown.
            assert answer.cost == pytest.approx(PAPER(answer.trajectory), rel=1e-9)
    assert solved >= 5


def test_terminal_ingredients_and_an_ellipsoid():
    light = QuadraticCost(np.eye(2), [[0.1]])
    made = terminal_ingredients(CARRIAGE, light)
    linear = LinearMPC(CARRIAGE, light, N, terminal=made)
    controller = NonlinearMPC(CARRIAGE, light, N, terminal=made)
    for x in random_states([0.8, 0.8], key=KEY, shape=(5,)):
        expected, answer = linear.solve(x), cold(controller, x)
        assert answer.status == expected.status == "solved"
        np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, atol=1e-5)
        assert answer.cost == pytest.approx(expected.cost, rel=1e-6)
    ball = NonlinearMPC(CARRIAGE, light, N, terminal=Ellipsoid(np.eye(2), 0.01))
    answer = ball.solve([0.8, 0.5])
    assert answer.status == "solved"
    assert (answer.trajectory.x[-1] ** 2).sum() == pytest.approx(0.01, abs=1e-6)  # it matters


# ---- the two nonlinear plants ----

CAR, PENDULUM = kinematic_bicycle(), cart_pendulum()
LANE = steady_state(CAR, casadi.LANE, start=([3.5, 0, 0, 20], [0, 0]))
E = np.eye(6)
LIMITS = Polyhedron(
    np.concatenate([E[2:4], -E[2:4]]), [*casadi.CAR_HIGH, *(-b for b in casadi.CAR_LOW)]
)


def lateral(x, u):
    a = x[3] ** 2 * jnp.tan(x[2]) / casadi.LENGTH
    return jnp.stack([a - casadi.LIMIT, -a - casadi.LIMIT])


def car(**options):
    cost = SignalCost(QuadraticCost(casadi.CAR_Q, casadi.CAR_R), "y")
    return NonlinearMPC(CAR, cost, N, constraints=LIMITS, path=lateral, **options)


def pendulum(horizon=N, **options):
    cost = QuadraticCost(casadi.PENDULUM_Q, casadi.PENDULUM_R)
    return NonlinearMPC(PENDULUM, cost, horizon, **options)


PROBLEMS = {
    "car": (car, N, casadi.lane_change, casadi.lane_changes, {"reference": LANE}, 1.0),
    "pendulum": (
        lambda: pendulum(20),
        20,
        casadi.swing_up,
        casadi.swing_ups,
        {},
        0.8,
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_optimum_is_that_of_casadi(name):
    make, horizon, peer, draw, given_, share = PROBLEMS[name]
    controller, theirs = make(), peer(horizon)
    same = 0
    for x in draw(50, np.random.default_rng(2)):
        status, cost, plan = theirs(x)
        assert status == "Solve_Succeeded"
        answer = cold(controller, x, **given_)
        assert answer.status == "solved"
        if answer.cost == pytest.approx(cost, rel=1e-5):
            same += 1
            continue
        # Another minimum, not a poor solve: from their plan we stay at their cost.
        assert np.abs(answer.trajectory.u - plan).max() > 0.1
        assert answer.residual < 1e-6
        again = controller.solve(x, start=plan, **given_)
        assert again.cost == pytest.approx(cost, rel=1e-5)
    assert same >= share * 50


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


def test_warm_solves_take_fewer_iterations_and_forget_on_reset():
    warm, fresh = pendulum(), pendulum()
    x, counts = np.array([0, np.pi, 0, 0]), []
    first = warm.solve(x)
    for _ in range(15):
        answer = warm.solve(x)
        counts.append((answer.iterations, cold(fresh, x).iterations))
        x = PENDULUM.step(x, answer.u)
    warm_count, cold_count = np.median(counts[1:], axis=0)
    assert warm_count < cold_count
    again = cold(warm, [0, np.pi, 0, 0])
    np.testing.assert_array_equal(again.trajectory.u, first.trajectory.u)
    assert again.iterations == first.iterations


CARRIAGE = LinearSystem([[1, 0.1], [0, 1]], [[0], [0.1]], dt=0.1, u_min=-10, u_max=10)


def test_an_input_before_and_a_start_of_ones_own():
    cost = SignalCost(QuadraticCost(np.diag([1.0, 1, 1e4]), [[0.01]]), ["x", "du"])
    controller = NonlinearMPC(CARRIAGE, cost, N)
    x = np.array([0.5, 0.1])
    slow = controller.solve(x, u_before=[4.0])
    assert slow.u == pytest.approx(4.0, abs=0.2)  # increments are dear
    controller.reset()
    controller.applied(np.array([4.0]))
    np.testing.assert_allclose(controller.solve(x).u, slow.u, atol=1e-6)
    assert cold(controller, x).u != pytest.approx(slow.u, abs=0.5)
    held = cold(controller, x, u_before=[4.0], start=slow.trajectory.u)
    assert held.iterations <= 2
    assert held.cost == pytest.approx(slow.cost)
    # A call takes note of what it returned.
    controller.reset()
    u = controller(x)
    expected = cold(NonlinearMPC(CARRIAGE, cost, N), x, u_before=u)
    np.testing.assert_allclose(controller.solve(x).u, expected.u, atol=1e-6)
    # Without an input before, the first increment is 0.
    first = cold(controller, x)
    assert first.cost == pytest.approx(cost(first.trajectory), rel=1e-9)


def test_an_input_before_changes_nothing_without_increments():
    controller, x = NonlinearMPC(CARRIAGE, QuadraticCost(np.eye(2), [[0.1]]), N), [0.5, 0.1]
    expected = cold(controller, x).trajectory.u
    controller.reset()
    controller.applied(np.array([4.0]))
    np.testing.assert_array_equal(controller.solve(x).trajectory.u, expected)


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


# ---- the programs inside ----


@pytest.mark.parametrize("name", ["car", "pendulum", "carriage", "carriage at first"])
def test_derivatives_are_those_of_finite_differences(name):
    if name not in PROBLEMS:  # as of the networks above: all that a problem may have
        network = MLPCost.random([1.0, 1.0, 10.0], key=KEY, widths=(6,))
        cost = SumCost([SignalCost(QuadraticCost(np.eye(3), [[1.0]]), ["x", "du"]), network])
        controller = NonlinearMPC(CARRIAGE, cost, 4, terminal=Ellipsoid(np.eye(2), 1.0))
        before = [3.0] if name == "carriage" else None
        packed = controller._packed(np.array([0.5, 0.2]), None, before)
    else:
        controller = PROBLEMS[name][0]()
        x0 = np.array([0.3, 0.1, 0.01, 18.0]) if name == "car" else np.array([0.1, 2.0, 1, -1])
        packed = controller._packed(x0, PROBLEMS[name][4].get("reference"), None)
    program = controller._program(*packed)
    rng = np.random.default_rng(5)
    z = rng.uniform(-0.3, 0.3, program.lower.size)
    multipliers = rng.uniform(0, 1, program.rows)
    slope, jacobian, *_ = program.slopes(z)
    H = program.curvature(z, multipliers)
    np.testing.assert_allclose(H, H.T, rtol=1e-9, atol=1e-9 * np.abs(H).max())
    for _ in range(4):
        d = rng.normal(size=z.size)
        (above, c_above), (below, c_below) = (program.values(z + e * d) for e in (1e-5, -1e-5))
        scale = 1 + np.abs(slope).max()
        assert slope @ d == pytest.approx((above - below) / 2e-5, abs=1e-6 * scale)
        np.testing.assert_allclose(jacobian @ d, (c_above - c_below) / 2e-5, atol=1e-6)
        (g_above, J_above, *_), (g_below, J_below, *_) = (
            program.slopes(z + e * d) for e in (1e-5, -1e-5)
        )
        change = g_above - g_below + multipliers @ (J_above - J_below)
        np.testing.assert_allclose(H @ d, change / 2e-5, atol=1e-6 * (1 + np.abs(H @ d).max()))


def test_quadratic_programs_against_clarabel():
    rng = np.random.default_rng(4)
    infeasible = 0
    for _ in range(60):
        n, m = rng.integers(1, 10), rng.integers(1, 25)
        root = rng.normal(size=(n, n))
        H = root @ root.T + 10.0 ** rng.uniform(-4, 0) * np.eye(n)
        q = rng.normal(size=n) * 10 ** rng.uniform(-2, 3)
        A, b = rng.normal(size=(m, n)), rng.normal(size=m) + 0.7
        found = _quadratic.quadratic_program(H, q, A, b)
        d = cp.Variable(n)
        problem = cp.Problem(cp.Minimize(q @ d + cp.quad_form(d, cp.psd_wrap(H)) / 2), [A @ d <= b])
        problem.solve(solver=cp.CLARABEL)
        if problem.status == "infeasible":
            infeasible += 1
            assert found is None
            continue
        assert found is not None
        d, multipliers = found
        size = 1 + np.abs(q).max()
        assert np.abs(H @ d + q + A.T @ multipliers).max() < 1e-8 * size
        assert (A @ d - b).max() < 1e-8
        assert multipliers.min() >= 0
        assert np.abs(multipliers * (A @ d - b)).max() < 1e-7 * size
    assert infeasible > 5


def test_what_newton_steps_leave_is_solved_by_slsqp(monkeypatch):
    expected = cold(PROPERTY, [0, 0, 0, 20.0], reference=LANE)
    monkeypatch.setattr(_newton, "NEWTON_STEPS", 1)
    answer = cold(car(), [0, 0, 0, 20.0], reference=LANE)
    assert answer.status == "solved"
    assert answer.iterations > expected.iterations
    assert answer.cost == pytest.approx(expected.cost, rel=1e-6)


def test_closed_loops_steer_and_simulations_are_independent():
    starts = np.array([[0.0, 0.3, 0, 0], [0.2, -0.2, 0, 0]])
    controller = pendulum()
    both = simulate(PENDULUM, controller, starts, 40)
    assert np.abs(both.x[:, -1, 1]).max() < 0.05  # upright; half a second is too short for p
    one = simulate(PENDULUM, controller, starts[1], 5)
    np.testing.assert_array_equal(one.x, both.x[1, :6])


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
