"""Closed loops by the thousand, against one solve at a time."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import (
    BatchedMPC,
    LinearMPC,
    LinearSystem,
    MPCError,
    Polyhedron,
    QuadraticCost,
    closed_loops,
    fit_map,
    mpc_rollout,
    oscillating_masses,
    random_states,
    simulate,
    terminal_ingredients,
)
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2000)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
OTHER = QuadraticCost(np.eye(6), 0.1 * np.eye(2))
STATES = np.asarray(random_states(RADIUS, key=KEY, shape=(12,)))
# Speed limits of two masses; half of the states are too energetic for them.
LIMITS = Polyhedron(np.eye(8)[[3, 4, 4]] * [[1], [1], [-1]], [0.3] * 3)
N, STEPS = 8, 6


def one_by_one(controller, plant, x):
    """Return x, u and the status that ended the loop."""
    xs, us, status = [x], [], "solved"
    for _ in range(STEPS):
        answer = controller.solve(xs[-1])
        status = answer.status
        if status != "solved":
            break
        us.append(answer.u)
        xs.append(plant.step(xs[-1], answer.u))
    return np.array(xs), np.array(us).reshape(-1, plant.nu), status


@pytest.mark.parametrize("end", [False, True])
def test_loops_with_polyhedra_are_those_of_linear_mpc(end):
    terminal = terminal_ingredients(MASSES, PAPER, constraints=LIMITS) if end else None
    sets = {"constraints": LIMITS, "terminal": terminal}
    found = closed_loops(MASSES, PAPER, STATES, horizon=N, steps=STEPS, **sets)
    single = LinearMPC(MASSES, PAPER, N, **sets)
    seen = set()
    matters = 0
    for i, x0 in enumerate(STATES):
        x, u, status = one_by_one(single, MASSES, x0)
        seen.add(status)
        done = len(u)
        assert found.solved[i] == (status == "solved")
        assert (found.status[i, :done] == "solved").all()
        assert (found.status[i, done:] == status).all()
        np.testing.assert_allclose(found.trajectories.u[i, :done], u, rtol=0, atol=1e-5)
        np.testing.assert_allclose(found.trajectories.x[i, : done + 1], x, rtol=0, atol=1e-5)
        assert np.isnan(found.trajectories.u[i, done:]).all()
        matters += (np.abs(np.abs(x[:, 3:5]) - 0.3) < 1e-5).any()
    assert seen == {"solved", "infeasible"}
    assert matters >= 2


def test_a_batch_never_calls_nan_solved():
    """States beyond a limit on x_0 among others: XLA's max passes over NaN."""
    wall = Polyhedron(np.eye(8)[[1]], [0.02])
    x0 = np.zeros((25, 16, 6))
    x0[..., 1], x0[..., 4] = np.linspace(-0.3, 0.03, 25)[:, None], np.linspace(-0.2, 0.25, 16)
    x0 = x0.reshape(-1, 6)
    sigma = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    loops = closed_loops(oscillating_masses(), sigma, x0, horizon=10, steps=2, constraints=wall)
    finite = np.isfinite(loops.trajectories.u).all(axis=2)
    np.testing.assert_array_equal(loops.status == "solved", finite)
    assert (loops.status[x0[:, 1] > 0.02 + 1e-6] == "infeasible").all()


def test_answers_with_polyhedra_are_those_of_linear_mpc():
    terminal = Polyhedron.box([-0.6] * 6, [0.6] * 6)
    costs = QuadraticCost([PAPER.Q, OTHER.Q], [PAPER.R, OTHER.R])
    sets = {"constraints": LIMITS, "terminal": terminal}
    many = BatchedMPC(MASSES, costs, N, **sets).solve(STATES)
    for i in range(2):
        single = LinearMPC(MASSES, costs[i], N, **sets)
        for k, x0 in enumerate(STATES):
            answer = single.solve(x0)
            assert many.status[i, k] == answer.status
            if answer.success:
                u = many.trajectory.u[i, k]
                np.testing.assert_allclose(u, answer.trajectory.u, rtol=0, atol=2e-5)
                assert many.cost[i, k] == pytest.approx(answer.cost, rel=1e-5)
    assert set(many.status.ravel()) == {"solved", "infeasible"}
    assert "infeasible" in many.message
    with pytest.raises(MPCError, match=f"of {2 * len(STATES)} problems .* infeasible"):
        BatchedMPC(MASSES, costs, N, **sets)(STATES)


def test_many_models_and_many_plants():
    heavy, light = oscillating_masses([1.3, 0.6, 1.2]), oscillating_masses([0.8, 0.5, 0.9])
    plants = LinearSystem.stack([MASSES, heavy, light])
    assert len(plants) == 3
    np.testing.assert_array_equal(plants[1].A, heavy.A)
    # One controller on three plants, and three models with the plant as they believe it is.
    shared = closed_loops(MASSES, PAPER, STATES[:2], horizon=N, steps=STEPS, plants=plants)
    knowing = closed_loops(plants, PAPER, STATES[:2], horizon=N, steps=STEPS)
    crossed = closed_loops(plants, PAPER, STATES[:2], horizon=N, steps=STEPS, plants=MASSES)
    assert shared.trajectories.x.shape == (3, 2, STEPS + 1, 6)
    for i in range(3):
        for found, model, plant in (
            (shared, MASSES, plants[i]),
            (knowing, plants[i], plants[i]),
            (crossed, plants[i], MASSES),
        ):
            expected = simulate(plant, LinearMPC(model, PAPER, N), STATES[:2], STEPS)
            np.testing.assert_allclose(found.trajectories.x[i], expected.x, rtol=0, atol=1e-5)
            np.testing.assert_allclose(found.trajectories.y[i], expected.y, rtol=0, atol=1e-5)


def loops(system=MASSES, costs=PAPER, x0=RADIUS[None], horizon=2, steps=2, **options):
    return closed_loops(system, costs, x0, horizon=horizon, steps=steps, **options)


PAIR = LinearSystem.stack([MASSES, MASSES])
SCALAR = LinearSystem([[1]], [[1]], dt=1)
THREE = QuadraticCost.random(6, 2, key=KEY, shape=(3,))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: loops(system=PAIR, costs=THREE), "cost must be as many as the systems, 2"),
        (lambda: loops(plants=SCALAR), "plants must have 6 states and 2 inputs.* got 1 and 1"),
        (lambda: loops(plants=MASSES.A), "plants must be a LinearSystem, got ndarray"),
        (lambda: loops(costs=THREE, plants=PAIR), r"plants must be a single one or a stack of 3"),
        (lambda: loops(constraints=np.eye(8)), "constraints must be a Polyhedron"),
        (lambda: loops(constraints=Polyhedron(np.eye(6), np.ones(6))), "constraints must have"),
        (lambda: loops(terminal=LIMITS), "terminal must have dimension 6, got 8"),
        (lambda: loops(mesh=8), "mesh must be a jax.sharding.Mesh, got int"),
        (lambda: fit_map(None, None, mesh="all"), "comparisons must be"),
        (lambda: mpc_rollout(MASSES, PAPER, RADIUS, horizon=0, steps=1), "horizon must be"),
        (lambda: mpc_rollout(MASSES, PAPER, RADIUS[:3], horizon=1, steps=1), "x0 must have shape"),
        (lambda: mpc_rollout(MASSES, 3, RADIUS, horizon=1, steps=1), "cost must be a Quadratic"),
        (lambda: LinearSystem.stack([]), "systems must be a sequence of at least one"),
        (lambda: LinearSystem.stack([MASSES, SCALAR]), "systems must agree in all shapes"),
        (lambda: LinearSystem.stack([PAIR]), r"systems\[0\] must be a single model, got a stack"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
