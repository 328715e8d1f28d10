"""Equal bounds hold an input where it is: every controller then plans as without it."""

from __future__ import annotations

import numpy as np
import pytest

from prefmpc import (
    BatchedMPC,
    ConvexMPC,
    LinearMPC,
    LinearSystem,
    NonlinearMPC,
    Polyhedron,
    QuadraticCost,
    closed_loops,
    terminal_ingredients,
)

A, B, WEIGHTS = [[1, 0.5], [0, 1.1]], [[0, 0.3], [1, 0.2]], np.eye(2)
X0, N = np.array([0.3, 0.1]), 10
COST = QuadraticCost(WEIGHTS, 0.1 * np.eye(2))


def plant(low, high):
    return LinearSystem(A, B, dt=0.1, u_min=[-1, low], u_max=[1, high])


@pytest.mark.parametrize("kind", [LinearMPC, ConvexMPC, BatchedMPC, NonlinearMPC])
def test_a_controller_with_a_locked_input(kind):
    alone = LinearSystem(A, [[0], [1]], dt=0.1, u_min=-1, u_max=1)
    wanted = LinearMPC(alone, QuadraticCost(WEIGHTS, [[0.1]]), N).solve(X0).u
    locked = kind(plant(0, 0), COST, N).solve(X0)
    box = Polyhedron.box([-np.inf, -np.inf, -1, 0], [np.inf, np.inf, 1, 0])
    held = kind(plant(-1, 1), COST, N, constraints=box).solve(X0)
    for plan in (locked, held):
        assert plan.success, plan.message
        np.testing.assert_allclose(plan.u, [*wanted, 0.0], atol=1e-6)
    away = kind(plant(0.05, 0.05), COST, N).solve(X0)
    np.testing.assert_allclose(away.trajectory.u[:, 1], 0.05, atol=1e-9)


def test_a_closed_loop_with_a_locked_input():
    loops = closed_loops(plant(0, 0), COST, X0[None], horizon=N, steps=30)
    assert loops.solved.all()
    assert np.abs(loops.trajectories.x[0, -1]).max() < 1e-5
    with pytest.raises(ValueError, match="an input that is locked by equal ones has no place in B"):
        terminal_ingredients(plant(0, 0), COST)
