"""Batched MPC where condensing loses digits: unstable plants, long horizons, any unit."""

from __future__ import annotations

import copy
import pickle
from collections import Counter

import jax
import numpy as np
import pytest
from random_mpc import KINDS, compared, random_problems

from prefmpc import (
    BatchedMPC,
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    closed_loops,
    mpc_rollout,
    oscillating_masses,
    simulate,
)
from prefmpc._pytree import bypass_init


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("shape", "plants"), [((3, 2, 20), 12), ((4, 1, 100), 8)])
def test_random_problems_have_the_inputs_of_a_sparse_solver(shape, plants, kind):
    # `make bench` does the same with 10,000 of 14 sizes.
    problems = random_problems(shape, kind, plants, 6, np.random.default_rng(sum(shape)))
    found = compared(problems)
    seen = Counter(found.verdicts)
    assert found.sound
    assert max(found.differences) < 1e-6
    assert seen["solved", "solved"] > 0.4 * len(found.verdicts)
    assert found.active > 0.15
    for ours, theirs in seen:
        # Where no input holds the plant, neither knows what to say.
        assert ours == theirs or theirs != "solved"
        assert kind != "bounds" or ours != "infeasible"


RADII = (1.1, 1.2, 1.5, 2.0)
STACK = LinearSystem.stack(
    [LinearSystem([[a, 0.5], [0, 1.1]], [[0], [1]], dt=0.1, u_min=-1, u_max=1) for a in RADII]
)
PLAIN = QuadraticCost(np.eye(2), 0.1 * np.eye(1))
SMALL = np.array([0.03, 0.01])


@pytest.fixture(scope="module")
def loops():
    return closed_loops(STACK, PLAIN, SMALL[None] * [[1], [3.0]], horizon=100, steps=100)


@pytest.mark.parametrize("i", range(len(RADII)))
def test_loops_on_unstable_plants_are_those_of_linear_mpc(loops, i):
    assert loops.solved[i].all()
    expected = simulate(STACK[i], LinearMPC(STACK[i], PLAIN, 100), SMALL * [[1], [3.0]], 100)
    np.testing.assert_allclose(loops.trajectories.u[i], expected.u, rtol=0, atol=1e-6)
    np.testing.assert_allclose(loops.trajectories.x[i], expected.x, rtol=0, atol=1e-6)


def test_an_inverted_pendulum_with_saturated_force():
    A = [[0, 1, 0, 0], [0, -0.1818, 2.6727, 0], [0, 0, 0, 1], [0, -0.4545, 31.1818, 0]]
    B = [[0], [1.8182], [0], [4.5455]]
    cart = LinearSystem.from_continuous(A, B, dt=0.05, u_min=-10, u_max=10)
    sigma = QuadraticCost(np.diag([12, 1, 70, 1.5]), [[0.1]])
    x0 = np.array([[0.3, 0, 0.1, 0.2], [0.5, 0.2, 0.35, 1.5]])
    found = closed_loops(cart, sigma, x0, horizon=80, steps=60)
    expected = simulate(cart, LinearMPC(cart, sigma, 80), x0, 60)
    assert found.solved.all()
    assert (np.abs(expected.u) > 10 - 1e-9).any()
    np.testing.assert_allclose(found.trajectories.u, expected.u, rtol=0, atol=1e-6)


def test_plans_on_unstable_plants_lead_where_they_say():
    sizes = np.array([26.0, 19, 11, 5.0])  # the first inputs of the first three are at -1
    answer = BatchedMPC(STACK, PLAIN, 100).solve((SMALL * sizes[:, None])[:, None])
    T = answer.trajectory
    assert (answer.status == "solved").all()
    assert (np.abs(T.u[:3, 0, 0]) == 1).all()
    assert np.abs(T.x[:, 0, -1]).max() < 1e-6
    for i in range(len(RADII)):
        moved = STACK[i].step(T.x[i, 0, :-1], T.u[i, 0])
        np.testing.assert_allclose(moved, T.x[i, 0, 1:], rtol=0, atol=1e-13)
        assert answer.cost[i, 0] == pytest.approx(PLAIN(T[i, 0]), rel=1e-12)


def test_the_slopes_of_a_loop_on_an_unstable_plant():
    plant = STACK[2]
    x0 = np.array([0.35, 0.1])  # the first input is at its limit

    def total(R):
        cost = bypass_init(QuadraticCost, theta_Q=PLAIN.theta_Q, theta_R=PLAIN.theta_R * R)
        run = mpc_rollout(plant, cost, x0, horizon=60, steps=4)
        return (run.x**2).sum() + (run.u**2).sum()

    slope = jax.jit(jax.value_and_grad(total))
    assert (np.abs(closed_loops(plant, PLAIN, x0, horizon=60, steps=4).trajectories.u) == 1).any()
    (ahead, _), (behind, _) = slope(1 + 1e-5), slope(1 - 1e-5)
    assert float(slope(1.0)[1]) == pytest.approx(float(ahead - behind) / 2e-5, rel=1e-6)


MASSES = oscillating_masses()
Q, R = np.diag([5.0, 1, 5, 0.5, 0.2, 0.5]), np.diag([1, 0.5])
WALL = np.array([[0, 0, 0, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1, 0, 0.1]])


@pytest.mark.parametrize("growth", [1.0, 1.3])
@pytest.mark.parametrize("walls", [False, True])
def test_units_and_the_size_of_sigma_change_nothing(walls, growth):
    rng = np.random.default_rng(7)
    units = 10 ** rng.uniform(-9, 9, (12, 8))
    sigma, sizes = 10 ** rng.uniform(-9, 9, 12), 10.0 ** np.arange(-11, 1)
    x0 = rng.uniform(-1.0, 1.0, (8, 6)) * 10 ** np.linspace(-2, 0.5, 8)[:, None]
    A = growth * MASSES.A

    def solved(s, c, size):
        sx, su = s[:6], s[6:]
        plant = LinearSystem(
            sx[:, None] * A / sx, sx[:, None] * MASSES.B / su, dt=0.2, u_min=-su * size, u_max=su
        )
        cost = QuadraticCost(c * Q / sx[:, None] / sx, c * R / su[:, None] / su)
        limits = Polyhedron(WALL / s, np.array([0.3, 0.4]) * size) if walls else None
        answer = BatchedMPC(plant, cost, 12, constraints=limits).solve(x0 * size * sx)
        return answer, answer.trajectory.u / su, answer.cost / c

    seen = Counter()
    for s, c, size in zip(units, sigma, sizes, strict=True):
        (one, u, value), (other, v, again) = solved(np.ones(8), 1.0, size), solved(s, c, size)
        np.testing.assert_array_equal(one.status, other.status)
        good = one.status == "solved"
        np.testing.assert_allclose(v[good] / size, u[good] / size, rtol=0, atol=1e-9)
        np.testing.assert_allclose(again[good], value[good], rtol=1e-9)
        seen.update(zip(one.status, (one.iterations > 0), strict=True))
    assert seen["solved", True] > 5
    assert walls == (seen["infeasible", True] + seen["infeasible", False] > 0)


def test_at_the_origin_nothing_moves():
    for limits in (None, Polyhedron(WALL, [0.3, 0.4])):
        controller = BatchedMPC(MASSES, QuadraticCost(Q, R), 12, constraints=limits)
        answer = controller.solve(np.zeros((8, 6)))
        assert (answer.status == "solved").all()
        np.testing.assert_array_equal(answer.residual, 0)
        np.testing.assert_array_equal(answer.trajectory.u, 0)


def test_a_state_on_a_limit_keeps_to_it_and_one_beyond_it_does_not():
    limits = Polyhedron(WALL, [0.3, 0.4])
    controller = BatchedMPC(MASSES, QuadraticCost(Q, R), 12, constraints=limits)
    x0 = np.zeros((8, 6))
    x0[:, 3] = 0.3 + np.array([0, 1e-9, 1e-8, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2])
    x0[:, 0] = 0.2
    expected = ["solved"] * 4 + ["infeasible"] * 4
    np.testing.assert_array_equal(controller.solve(x0).status, expected)
    single = LinearMPC(MASSES, QuadraticCost(Q, R), 12, constraints=limits)
    assert [single.solve(x).status for x in x0] == expected


def test_controllers_can_be_pickled_and_copied():
    controller = BatchedMPC(MASSES, QuadraticCost(Q, R), 12)
    x0 = np.full((8, 6), 0.1)
    expected = controller.solve(x0).trajectory.u
    for other in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
        np.testing.assert_array_equal(other.solve(x0).trajectory.u, expected)
