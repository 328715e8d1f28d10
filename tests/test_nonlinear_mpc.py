"""`NonlinearMPC` against quadratic programs and against CasADi."""

from __future__ import annotations

import cvxpy as cp
import multiple_shooting as casadi
import numpy as np
import pytest
from nonlinear_controllers import (
    CARRIAGE,
    COUPLED,
    KEY,
    LANE,
    MASSES,
    PAPER,
    PENDULUM,
    SETS,
    TERMINAL,
    N,
    car,
    cold,
    pendulum,
)

from prefmpc import (
    Ellipsoid,
    LinearMPC,
    MLPCost,
    NonlinearMPC,
    Polyhedron,
    QuadraticCost,
    SignalCost,
    SumCost,
    random_states,
    simulate,
    steady_state,
    terminal_ingredients,
)
from prefmpc.mpc import _quadratic
from studies import RADIUS

NEAR = np.array([0.8, 0.8, 0.8, 0.6, 0.6, 0.6])


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


def test_closed_loops_steer_and_simulations_are_independent():
    starts = np.array([[0.0, 0.3, 0, 0], [0.2, -0.2, 0, 0]])
    controller = pendulum()
    both = simulate(PENDULUM, controller, starts, 40)
    assert np.abs(both.x[:, -1, 1]).max() < 0.05  # upright; half a second is too short for p
    one = simulate(PENDULUM, controller, starts[1], 5)
    np.testing.assert_array_equal(one.x, both.x[1, :6])
