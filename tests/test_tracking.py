"""Set points: steady states against linear algebra and root finding, and the loops that follow."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

from prefmpc import (
    ConvexMPC,
    LinearMPC,
    LinearSystem,
    MPCError,
    NonlinearMPC,
    NonlinearSystem,
    Polyhedron,
    QuadraticCost,
    ReferenceTracker,
    SignalCost,
    cart_pendulum,
    kinematic_bicycle,
    oscillating_masses,
    simulate,
    steady_state,
    terminal_ingredients,
)
from studies import QUADRATIC_Q, QUADRATIC_R

MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
CAR, PENDULUM = kinematic_bicycle(), cart_pendulum()
CARRIAGE = LinearSystem(
    [[1, 0.2], [0, 1]], [[0.02], [0.2]], [[1, 0]], dt=0.2, u_min=-1.0, u_max=1.0
)
LIGHT = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]])


def held(system, found):
    return np.abs(system.step(found.x, found.u) - found.x).max()


def test_steady_states_by_linear_algebra():
    # Two forces hold two of the three positions; the third follows.
    rng = np.random.default_rng(0)
    for _ in range(10):
        ends = rng.uniform(-0.2, 0.2, 2)
        y_r = np.array([ends[0], ends.mean(), ends[1]])
        rows = np.block([[MASSES.A - np.eye(6), MASSES.B], [MASSES.C, np.zeros((3, 2))]])
        z, *_ = np.linalg.lstsq(rows, np.concatenate([np.zeros(6), y_r]), rcond=None)
        found = steady_state(MASSES, y_r)
        np.testing.assert_allclose(np.concatenate([found.x, found.u]), z, atol=1e-6)
        np.testing.assert_allclose(found.y, y_r, atol=1e-6)
        assert held(MASSES, found) < 1e-8
    found = steady_state(MASSES, [0, 0.1, 0.2])  # one of them zero, but for rounding
    np.testing.assert_allclose(found.y, [0, 0.1, 0.2], atol=1e-15)


def test_of_several_steady_states_the_smallest():
    # Two inputs do the same: each takes half.
    twins = LinearSystem([[0.5]], [[1.0, 1.0]], dt=1)
    found = steady_state(twins, [2.0])
    np.testing.assert_allclose(found.u, [0.5, 0.5], atol=1e-6)


def test_nonlinear_steady_states_by_root_finding():
    # A tank with a valve, ẋ = u − √x, and a reaction in it: two states, no closed form wanted.
    def flow(x, u):
        return jnp.stack([u[0] - jnp.sqrt(x[0] + 0.1), x[0] * jnp.exp(-x[1]) - x[1] * u[1]])

    tank = NonlinearSystem.from_continuous(flow, nx=2, nu=2, dt=0.1)
    for y_r in ([1.0, 0.5], [2.0, 0.3], [0.5, 0.9]):
        found = steady_state(tank, y_r, start=([1.0, 0.5], [1.0, 1.0]))
        expected = root(lambda u, y=y_r: np.asarray(flow(jnp.array(y), u)), [1.0, 1.0])
        assert expected.success
        np.testing.assert_allclose(found.u, expected.x, rtol=2e-6)
        np.testing.assert_allclose(found.x, y_r, atol=1e-6)
        assert held(tank, found) < 1e-8


def test_the_plants_of_the_book_rest():
    lane = steady_state(CAR, [3.5, 0, 0, 20], start=([0, 0, 0, 15], [0, 0]))
    np.testing.assert_allclose(lane.x, [3.5, 0, 0, 20], atol=1e-6)
    np.testing.assert_allclose(lane.u, 0, atol=1e-8)
    up = steady_state(PENDULUM, [0.7, 0.0], start=([0, 0.5, 0, 0], [0]))
    np.testing.assert_allclose(up.x, [0.7, 0, 0, 0], atol=1e-6)
    down = steady_state(PENDULUM, [0.0, np.pi], start=([0, 3, 0, 0], [0]))
    np.testing.assert_allclose(down.x, [0, np.pi, 0, 0], atol=1e-6)


def test_what_cannot_be_held_is_said_and_the_nearest_is_found():
    # A force of 1 N holds the masses at most so far out.
    with pytest.raises(ValueError, match=r"y_r must be reachable.*outside of the constraints"):
        steady_state(MASSES, [2.0, 2.0, 2.0])
    near = steady_state(MASSES, [2.0, 2.0, 2.0], nearest=True)
    np.testing.assert_allclose(near.u, 1, atol=1e-5)
    assert held(MASSES, near) < 1e-8
    with pytest.raises(ValueError, match=r"is no output that the plant can hold; nearest is"):
        steady_state(MASSES, [0.1, -0.1, 0.1])
    wall = Polyhedron(np.eye(8)[:1], [0.1])
    with pytest.raises(ValueError, match="outside of the constraints"):
        steady_state(MASSES, [0.2, 0.2, 0.2], constraints=wall)
    near = steady_state(MASSES, [0.2, 0.2, 0.2], constraints=wall, nearest=True)
    assert near.x[0] == pytest.approx(0.1, abs=1e-6)
    # The nearest one by brute force: positions are linear in the two forces.
    ends = np.linspace(-0.1, 0.4, 251)
    grid = np.stack(np.meshgrid(np.minimum(ends, 0.1), ends), axis=-1).reshape(-1, 2)
    positions = np.stack([grid[:, 0], grid.mean(axis=1), grid[:, 1]], axis=1)
    best = positions[np.argmin(((positions - 0.2) ** 2).sum(axis=1))]
    np.testing.assert_allclose(near.y, best, atol=2e-3)


def test_the_linear_controller_of_deviations_is_that_of_a_moved_plant():
    # With no active limit: u − u_r is what the controller says for x − x_r.
    free = LinearSystem(CARRIAGE.A, CARRIAGE.B, CARRIAGE.C, dt=0.2)
    reference = steady_state(free, [2.0])
    controller, x = LinearMPC(free, LIGHT, 10), np.array([0.5, -0.3])
    moved = controller.solve(x - reference.x)
    answer = controller.solve(x, reference=reference)
    np.testing.assert_allclose(answer.trajectory.x, moved.trajectory.x + reference.x, atol=1e-6)
    np.testing.assert_allclose(answer.u, moved.u + reference.u, atol=1e-6)
    assert answer.cost == pytest.approx(LIGHT(answer.trajectory), rel=1e-6)
    # With limits that hold for the plant, not for the deviations.
    tight = LinearMPC(CARRIAGE, LIGHT, 10, constraints=Polyhedron([[0, 1.0, 0]], [0.4]))
    answer = tight.solve([0, 0], reference=reference)
    assert answer.trajectory.u.max() == pytest.approx(1, abs=1e-6)
    assert answer.trajectory.x[:-1, 1].max() == pytest.approx(0.4, abs=1e-6)
    back = tight.solve([0.0, 0.0])  # the set point is no part of the controller
    np.testing.assert_allclose(back.u, 0, atol=1e-7)


@pytest.fixture(scope="module")
def trackers():
    cost = SignalCost(QuadraticCost(np.diag([1.0, 1, 0.01, 1]), np.diag([1, 0.1])), "y")
    return {
        "linear": (ReferenceTracker(LinearMPC(CARRIAGE, LIGHT, 15), [1.0]), [[1.0], [-0.5]]),
        "nonlinear": (
            ReferenceTracker(NonlinearMPC(CAR, cost, 10), [3.5, 0, 0, 20]),
            [[3.5, 0, 0, 20], [0, 0, 0, 18.0]],
        ),
    }


@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_the_tracker_reaches_its_set_points(trackers, kind):
    tracker, goals = trackers[kind]
    system = tracker.controller.system
    x = np.zeros(system.nx)
    x[-1] = 20.0 if kind == "nonlinear" else 0.0
    for goal in goals:
        followed = tracker.track(goal)
        assert tracker.reference is followed
        T = simulate(system, tracker, x, 50)
        x = T.x[-1]
        np.testing.assert_allclose(system.output(x), goal, atol=0.02)
        plan = tracker.solve(x).trajectory
        np.testing.assert_array_equal(plan.x_r, followed.x)
        np.testing.assert_array_equal(plan.y_r, followed.y)
        np.testing.assert_allclose(plan.deviation().x, plan.x - followed.x)


def test_the_tracker_starts_again_on_reset(trackers):
    tracker, goals = trackers["nonlinear"]
    tracker.track(goals[0])
    x = np.array([0, 0, 0, 20.0])
    tracker.reset()
    first = tracker.solve(x)
    for k in range(3):
        tracker(np.array([0.5 * k, 0, 0, 20.0]))
    tracker.reset()
    again = tracker.solve(x)
    np.testing.assert_array_equal(again.trajectory.u, first.trajectory.u)
    assert again.iterations == first.iterations
    tracker.reset()
    tracker.applied(np.array([0.1, 0.2]))
    np.testing.assert_array_equal(tracker.controller._applied, [0.1, 0.2])


def test_a_tracker_that_cannot_go_on_says_so():
    wall = Polyhedron([[1.0, 0, 0]], [0.5])
    controller = LinearMPC(CARRIAGE, LIGHT, 10, constraints=wall)
    tracker = ReferenceTracker(controller, [0.4], constraints=wall)
    with pytest.raises(ValueError, match=r"y_r must be reachable.*outside of the constraints"):
        tracker.track([1.0])
    assert tracker.reference.y == pytest.approx(0.4, abs=1e-6)  # the old one is kept
    soft = ReferenceTracker(controller, [1.0], constraints=wall, nearest=True)
    assert soft.reference.y == pytest.approx(0.5, abs=1e-6)
    with pytest.raises(MPCError, match="infeasible"):
        tracker([0.6, 0.0])
    careless = ReferenceTracker(controller, [1.0])  # its own constraints were not named
    with pytest.raises(ValueError, match="reference must satisfy the constraints"):
        careless.solve([0.0, 0.0])


def test_a_set_point_must_not_break_the_path():
    def slow(x, u):
        return x[3:] - 20.0

    cost = SignalCost(QuadraticCost(np.eye(4), np.eye(2)), "y")
    controller = NonlinearMPC(CAR, cost, 3, path=slow)
    fast = steady_state(CAR, [0, 0, 0, 25], start=([0, 0, 0, 20], [0, 0]))
    with pytest.raises(ValueError, match=r"reference must satisfy path\(x, u\) ≤ 0, got \["):
        controller.solve([0, 0, 0, 18], reference=fast)


ROOTLESS = NonlinearSystem(lambda x, u: x + 1 + u**2, nx=1, nu=1, dt=1)
MOVING = steady_state(CARRIAGE, [0.5])
object.__setattr__(MOVING, "x", np.array([0.5, 0.1]))
AT_REST = steady_state(CARRIAGE, [0.0])
LINEAR = LinearMPC(CARRIAGE, LIGHT, 3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: steady_state("plant", [0.0]), "system must be a System, got str"),
        (lambda: steady_state(CARRIAGE, [0.0, 1]), r"y_r must have shape \(..., 1\)"),
        (lambda: steady_state(CARRIAGE, 0.0), "y_r must have 1 dimension"),
        (lambda: steady_state(CARRIAGE, [np.nan]), "y_r must be finite"),
        (
            lambda: steady_state(CARRIAGE, [0.0], constraints=Polyhedron([[1.0, 0]], [1])),
            "constraints must have dimension 3, got 2",
        ),
        (lambda: steady_state(CARRIAGE, [0.0], constraints=1), "constraints must be a Polyhedron"),
        (lambda: steady_state(CAR, np.zeros(4), start=([0.0], [0, 0])), r"start\[0\] must have"),
        (lambda: steady_state(CAR, np.zeros(4), start=(np.zeros(4), [0])), r"start\[1\] must have"),
        (
            lambda: steady_state(CAR, np.zeros(4), start=(np.full(4, np.nan), [0, 0])),
            r"start\[0\] must be finite",
        ),
        (lambda: steady_state(ROOTLESS, [0.0]), "y_r must have a steady state, but none was found"),
        (
            lambda: steady_state(CARRIAGE, [0.0], constraints=Polyhedron([[0, 1.0, 0]], [-1])),
            "y_r must have a steady state, but none",
        ),
        (
            lambda: ReferenceTracker("mpc", [0.0]),
            "controller must be a LinearMPC or a NonlinearMPC",
        ),
        (
            lambda: ReferenceTracker(ConvexMPC(CARRIAGE, LIGHT, 2), [0.0]),
            "controller must be .*, got ConvexMPC",
        ),
        (lambda: ReferenceTracker(LINEAR, [0.0, 1]), "y_r must have shape"),
        (lambda: ReferenceTracker(LINEAR, [0.0]).track([np.inf]), "y_r must be finite"),
        (lambda: ReferenceTracker(LINEAR, [0.0]).solve([1.0]), "x0 must have shape"),
        (lambda: LINEAR.solve([0, 0], reference=1), "reference must be a SteadyState, got int"),
        (lambda: LINEAR.solve([0, 0], reference=MOVING), "reference must be a steady state, but"),
        (
            lambda: LinearMPC(
                CARRIAGE, LIGHT, 3, terminal=terminal_ingredients(CARRIAGE, LIGHT)
            ).solve([0, 0], reference=AT_REST),
            "reference must be None with TerminalIngredients",
        ),
        (
            lambda: LinearMPC(MASSES, PAPER, 3).solve(np.zeros(6), reference=AT_REST),
            "reference must have dimension 6, got 2",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


# x⁺ = x + 0.1 (u + d): a constant disturbance among the states.
DISTURBED = LinearSystem([[1, 0.1], [0, 1]], [[0.1], [0]], [[1, 0]], dt=0.1, u_min=-1, u_max=1)


def test_a_disturbance_is_taken_from_the_start():
    found = steady_state(DISTURBED, [2.0], start=([0.0, 0.3], [0.0]))
    np.testing.assert_allclose(found.x, [2.0, 0.3], rtol=1e-13)
    np.testing.assert_allclose(found.u, [-0.3], rtol=1e-13)
    np.testing.assert_allclose(steady_state(DISTURBED, [2.0]).x, [2, 0], atol=1e-15)
    with pytest.raises(ValueError, match="steady state, but none was found within the constr"):
        steady_state(DISTURBED, [2.0], start=([0, 1.5], [0]))
    with pytest.raises(ValueError, match="none was found"):  # nothing stops what drifts by itself
        steady_state(LinearSystem([[1, 1], [0, 1]], [[0], [0]], dt=1), [0, 0], start=([0, 1], [0]))


def test_the_tracker_sees_the_disturbance_in_the_state():
    tracker = ReferenceTracker(
        LinearMPC(DISTURBED, QuadraticCost(np.diag([1.0, 0]), [[0.1]]), 20), [1.0]
    )
    for d in (0.3, -0.5):
        T = simulate(DISTURBED, tracker, np.array([0.0, d]), 150)
        assert T.x[-1, 0] == pytest.approx(1, abs=1e-9)
        assert T.u[-1, 0] == pytest.approx(-d, abs=1e-8)
        np.testing.assert_allclose(tracker.reference.u, [-d], atol=1e-12)
    with pytest.raises(MPCError, match="infeasible: y_r must have a steady state"):
        tracker([0.0, 1.5])
    assert tracker.solve([0.0, 0.3]).success


@pytest.mark.parametrize("unit", [1e-9, 1e-5, 1e-4, 1e-3, 1e6])
def test_set_points_in_any_unit_of_the_output(unit):
    plant = LinearSystem([[1, 0.2], [0, 1]], [[0.02], [0.2]], [[unit, 0]], dt=0.2)
    for y in (20.0, 0.1, 1e-9):
        found = steady_state(plant, [y * unit])
        np.testing.assert_allclose(found.x, [y, 0], rtol=1e-13, atol=1e-13 * y)
        np.testing.assert_allclose(found.u, 0, atol=1e-13 * y)
    held = LinearSystem([[0.5]], [[1.0]], [[unit]], dt=1, u_min=-1, u_max=1)
    with pytest.raises(ValueError, match="outside of the constraints: holding it takes x = "):
        steady_state(held, [3 * unit])
    assert steady_state(held, [3 * unit], nearest=True).y[0] == pytest.approx(2 * unit, rel=1e-12)
