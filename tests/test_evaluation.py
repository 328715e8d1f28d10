"""Accuracy by hand; closed loops in one compiled call against one solve at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prefmpc import (
    Comparisons,
    LinearMPC,
    LinearSystem,
    MPCError,
    Polyhedron,
    QuadraticCost,
    Trajectory,
    accuracy,
    closed_loops,
    oscillating_masses,
    random_states,
    simulate,
)
from prefmpc.studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2000)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
POOL = Trajectory(np.zeros((4, 2, 1)), np.zeros((4, 1, 1)))
ASKED = Comparisons(POOL, [0, 0, 1, 2, 3], [1, 2, 0, 1, 0], [1, 0, 0.5, 0.8, 1])


def test_accuracy_by_hand():
    # σ = 1, 2, 3, 2: "first" in pairs 0, 1; "second" in pairs 2 (2 > 1), 3 (3 > 2), 4 (2 > 1).
    # Right with 1, 0, 1 − 0.5, 1 − 0.8, 1 − 1.
    assert accuracy(lambda T: np.array([1.0, 2, 3, 2]), ASKED) == pytest.approx(1.7 / 5)
    # Equal costs count as "first": 1 + 0 + 0.5 + 0.8 + 1.
    assert accuracy(lambda T: jnp.zeros(4), ASKED) == pytest.approx(3.3 / 5)


def test_simulate_by_hand():
    # x⁺ = x + u with u = −x/2: 4, 2, 1; y = 3 x.
    system = LinearSystem([[1]], [[1]], [[3]], dt=1)
    T = simulate(system, lambda x: -x / 2, [4.0], 2)
    np.testing.assert_array_equal(T.x, [[4], [2], [1]])
    np.testing.assert_array_equal(T.u, [[-2], [-1]])
    np.testing.assert_array_equal(T.y, [[12], [6]])
    many = simulate(system, lambda x: -x / 2, [[4.0], [8.0]], 2)
    np.testing.assert_array_equal(many.x[..., 0], [[4, 2, 1], [8, 4, 2]])


@pytest.fixture(scope="module")
def stacked():
    """Two costs, three states for both, twelve steps; and the same by one solve at a time."""
    costs = QuadraticCost([QUADRATIC_Q, np.eye(6)], [QUADRATIC_R, 0.1 * np.eye(2)])
    x0 = random_states(8 * RADIUS, key=KEY, shape=(3,))
    single = [simulate(MASSES, LinearMPC(MASSES, costs[i], 10), x0, 12) for i in range(2)]
    return costs, x0, single


def assert_equal_loops(loops, single, atol=1e-5):
    np.testing.assert_allclose(loops.x, single.x, rtol=0, atol=atol)
    np.testing.assert_allclose(loops.u, single.u, rtol=0, atol=atol)
    np.testing.assert_allclose(loops.y, single.y, rtol=0, atol=atol)


def test_closed_loops_are_those_of_linear_mpc(stacked):
    costs, x0, single = stacked
    shared = closed_loops(MASSES, costs, x0, horizon=10, steps=12)
    assert shared.trajectories.x.shape == (2, 3, 13, 6)
    assert shared.solved.shape == shared.iterations.shape == (2, 3)
    assert shared.solved.all()
    assert (np.abs(shared.trajectories.u) == 1).any()  # the bounds matter
    for i in range(2):
        assert_equal_loops(shared.trajectories[i], single[i])
    # States of its own for each cost: the second gets them in another order.
    own = closed_loops(MASSES, costs, np.stack([x0, x0[::-1]]), horizon=10, steps=12)
    assert_equal_loops(own.trajectories[0], single[0])
    assert_equal_loops(own.trajectories[1][::-1], single[1])


def test_a_single_cost_has_no_leading_axis(stacked):
    _, x0, single = stacked
    loops = closed_loops(MASSES, PAPER, x0, horizon=10, steps=12)
    assert loops.solved.shape == (3,)
    assert_equal_loops(loops.trajectories, single[0])


def test_a_plant_that_no_input_can_hold_diverges_as_it_should():
    # x⁺ = 2 x + u with |u| ≤ 1: from 3 the input stays at −1, and x_k = 1 + 2·2ᵏ.
    system = LinearSystem([[2]], [[1]], dt=1, u_min=-1, u_max=1)
    loops = closed_loops(system, QuadraticCost([[1]], [[1]]), [[3.0]], horizon=5, steps=20)
    assert loops.solved.all()
    np.testing.assert_array_equal(loops.trajectories.u, -np.ones((1, 20, 1)))
    expected = 1 + 2 * 2.0 ** np.arange(21)
    np.testing.assert_allclose(loops.trajectories.x[0, :, 0], expected, rtol=1e-12)


def test_an_infeasible_problem_on_the_way_stops_the_simulation():
    wall = Polyhedron.box(
        [-np.inf] * 3 + [-0.01] * 3 + [-1] * 2, [np.inf] * 3 + [0.01] * 3 + [1] * 2
    )
    controller = LinearMPC(MASSES, PAPER, 5, constraints=wall)
    with pytest.raises(MPCError, match="infeasible"):
        simulate(MASSES, controller, [0.3, 0, 0, 0, 0, 0], 3)


def loops(system=MASSES, costs=PAPER, x0=RADIUS[None], horizon=2, steps=2, **options):
    return closed_loops(system, costs, x0, horizon=horizon, steps=steps, **options)


def still(x):
    return np.zeros(2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: accuracy(lambda T: np.zeros(3), ASKED), r"one cost a trajectory \(4,\), got"),
        (lambda: accuracy(lambda T: np.full(4, np.nan), ASKED), "model must return finite costs"),
        (lambda: accuracy(PAPER, POOL), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: accuracy(1.0, ASKED), "model must be a function"),
        (lambda: accuracy(PAPER, ASKED), r"trajectory.x must have shape \(..., any, 6\)"),
        (lambda: simulate("plant", still, RADIUS, 2), "system must be a LinearSystem, got str"),
        (lambda: simulate(MASSES, still, RADIUS[:5], 2), r"x0 must have shape \(..., 6\)"),
        (lambda: simulate(MASSES, still, RADIUS * np.nan, 2), "x0 must be finite"),
        (lambda: simulate(MASSES, still, RADIUS, 0), "steps must be a whole number"),
        (lambda: simulate(MASSES, 1.0, RADIUS, 2), "controller must be a function"),
        (lambda: simulate(MASSES, lambda x: x, RADIUS, 2), r"finite input of shape \(2,\)"),
        (lambda: simulate(MASSES, lambda x: [np.nan, 0], RADIUS, 2), "finite input.*at step 0"),
        (lambda: simulate(MASSES, lambda x: None, RADIUS, 2), "controller must return a finite"),
        (lambda: loops(system=MASSES.A), "system must be a LinearSystem, got ndarray"),
        (lambda: loops(costs=QUADRATIC_Q), "costs? must be a QuadraticCost, got ndarray"),
        (lambda: loops(costs=QuadraticCost(np.eye(2), np.eye(2))), "must weigh 6 states"),
        (lambda: loops(x0=[[1, 2]]), r"x0 must have shape \(..., 6\)"),
        (lambda: loops(x0=np.full((2, 6), np.inf)), "x0 must be finite"),
        (lambda: loops(x0=np.ones((2, 2, 6))), "x0 must have shape"),
        (lambda: loops(horizon=0), "horizon must be a whole number of at least 1"),
        (lambda: loops(steps=-1), "steps must be a whole number of at least 1"),
        (lambda: loops(tol=np.nan), "tol must be finite"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
