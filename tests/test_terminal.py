"""Terminal ingredients: invariance checked by other means, and what they do for the closed loop."""

from __future__ import annotations

import control
import jax
import numpy as np
import pytest
from scipy.optimize import linprog

from prefmpc import (
    Ellipsoid,
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    oscillating_masses,
    random_states,
    terminal_ingredients,
)

DOUBLE = LinearSystem([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], dt=1.0, u_min=-1, u_max=1)
COST = QuadraticCost(np.eye(2), [[0.5]])
BOX = Polyhedron.box([-5, -2, -np.inf], [5, 2, np.inf])  # over (x, u)
MASSES = oscillating_masses()


def test_a_scalar_plant_by_hand():
    # x⁺ = 2x + u, q = r = 1: P solves P = 1 + 4P − 4P²/(1 + P), P = 2 + √5; K = 2P/(1 + P).
    system = LinearSystem([[2.0]], [[1.0]], dt=1.0, u_min=-1, u_max=2)
    end = terminal_ingredients(system, QuadraticCost([[1.0]], [[1.0]]))
    P = 2 + np.sqrt(5)
    K = 2 * P / (1 + P)
    assert end.P == pytest.approx(P)
    assert end.K == pytest.approx(K)
    # −1 ≤ −K x ≤ 2, and |2 − K| < 1 keeps it: an interval, and the symmetric one within it.
    for x, inside in ((1 / K, True), (1.001 / K, False), (-2 / K, True), (-2.002 / K, False)):
        assert end.polyhedron.contains([x]) == inside
    assert end.ellipsoid.level == pytest.approx(P / K**2)


@pytest.mark.parametrize(
    ("system", "cost", "constraints"),
    [
        (DOUBLE, COST, BOX),
        (MASSES, QuadraticCost(np.diag([40.0] * 3 + [5.0] * 3), 0.2 * np.eye(2)), None),
        (MASSES, QuadraticCost(np.eye(6), np.eye(2)), Polyhedron(np.eye(8)[1:2], [0.3])),
    ],
    ids=["double", "masses", "wall"],
)
def test_both_sets_are_invariant_and_as_large_as_they_say(system, cost, constraints):
    end = terminal_ingredients(system, cost, constraints=constraints)
    K, S, _ = control.dlqr(system.A, system.B, cost.Q, cost.R)
    np.testing.assert_allclose(end.K, K, atol=1e-8)
    np.testing.assert_allclose(end.P, S, rtol=1e-8, atol=1e-8)
    closed = system.A - system.B @ K
    H, h = end.polyhedron.H, end.polyhedron.h
    Z = [(np.eye(system.nu), system.u_max), (-np.eye(system.nu), -system.u_min)]
    rows = np.concatenate([-side @ K for side, _ in Z])
    limits = np.concatenate([limit for _, limit in Z])
    if constraints is not None:
        rows = np.concatenate(
            [rows, constraints.H[:, : system.nx] - constraints.H[:, system.nx :] @ K]
        )
        limits = np.concatenate([limits, constraints.h])
    # By linear programs, in another form than in the library: the image and Z hold the set.
    for row, limit in [*zip(H @ closed, h, strict=True), *zip(rows, limits, strict=True)]:
        worst = linprog(-row, A_ub=H, b_ub=h, bounds=(None, None), method="highs-ipm")
        assert -worst.fun <= limit + 1e-6
    # States outside of the polyhedron break a constraint some time later.
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200, system.nx))
    x *= (0.98 + 0.04 * (np.arange(200) % 2))[:, None] / (x @ H.T / h).max(axis=1)[:, None]
    broken = np.zeros(200, dtype=bool)
    state = x.T
    for _ in range(300):
        broken |= (rows @ state > limits[:, None] + 1e-9).any(axis=0)
        state = closed @ state
    np.testing.assert_array_equal(broken, np.arange(200) % 2 == 1)
    np.testing.assert_array_equal(end.polyhedron.contains(x), ~broken)
    # The ellipsoid lies in Z and touches it; PP-decrease makes it invariant.
    root = np.linalg.inv(np.linalg.cholesky(end.P)).T * np.sqrt(end.ellipsoid.level)
    reach = np.linalg.norm(rows @ root, axis=1)
    assert (reach / limits).max() == pytest.approx(1)
    decrease = end.P - closed.T @ end.P @ closed - cost.Q - K.T @ cost.R @ K
    np.testing.assert_allclose(decrease, 0, atol=1e-6 * np.abs(end.P).max())
    edge = root @ (x / np.linalg.norm(x, axis=1)[:, None]).T
    assert end.ellipsoid.contains((0.999 * edge).T).all()
    assert not end.ellipsoid.contains((1.001 * edge).T).any()
    assert end.polyhedron.contains((0.999 * edge).T).all()


def test_with_them_the_value_decreases_and_without_them_a_short_horizon_can_diverge():
    system = LinearSystem([[1.2, 1.0], [0.0, 1.1]], [[0.0], [1.0]], dt=1.0, u_min=-2, u_max=2)
    cost = QuadraticCost(np.diag([0.0, 1.0]) + 1e-6 * np.eye(2), [[1.0]])
    end = terminal_ingredients(system, cost)
    stable = LinearMPC(system, cost, 5, terminal=end)
    naive = LinearMPC(system, cost, 2)
    x0 = np.array([0.5, 0.0])
    x, values, steps = x0, [], 40
    for _ in range(steps):
        solution = stable.solve(x)
        assert solution.success
        values.append(solution.cost)
        stage = x @ cost.Q @ x + solution.u @ cost.R @ solution.u
        x = system.A @ x + system.B @ solution.u
        after = stable.solve(x).cost
        assert after <= values[-1] - stage + 1e-6 * (1 + values[-1])
    assert np.abs(x).max() < 1e-3
    y = x0
    for _ in range(steps):
        y = system.A @ y + system.B @ naive(y)
    assert np.abs(y).max() > 10


def test_with_the_terminal_cost_the_horizon_does_not_matter_inside_of_the_set():
    cost = QuadraticCost(np.diag([40.0] * 3 + [5.0] * 3), 0.2 * np.eye(2))
    end = terminal_ingredients(MASSES, cost)
    for x0 in 0.05 * random_states(np.ones(6), key=jax.random.key(3), shape=(5,)):
        assert end.polyhedron.contains(x0)
        for horizon in (1, 7):
            solution = LinearMPC(MASSES, cost, horizon, terminal=end).solve(x0)
            np.testing.assert_allclose(solution.u, -end.K @ x0, atol=1e-5)
            assert solution.cost == pytest.approx(x0 @ end.P @ x0, rel=1e-5)


def test_without_bounds_everything_is_terminal():
    system = LinearSystem([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], dt=1.0)
    end = terminal_ingredients(system, COST)
    assert end.ellipsoid.level == np.inf
    assert end.polyhedron.contains([1e6, -1e6])
    assert end.ellipsoid.contains([1e6, -1e6])
    assert LinearMPC(system, COST, 3, terminal=end).solve([100.0, 0.0]).success


def test_an_ellipsoid_by_hand():
    disc = Ellipsoid(np.eye(2), 4.0)
    np.testing.assert_array_equal(disc.contains([[2, 0], [0, 2.01], [1, 1]]), [True, False, True])
    assert disc.dim == 2


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Ellipsoid(-np.eye(2)), "P must be positive definite"),
        (lambda: Ellipsoid(np.ones((2, 1, 1))), "P must be one matrix"),
        (lambda: Ellipsoid(np.eye(2), 0.0), "level must be positive, got 0"),
        (lambda: Ellipsoid(np.eye(2)).contains([1.0]), "z must have shape"),
        (lambda: terminal_ingredients(COST, COST), "system must be a LinearSystem"),
        (lambda: terminal_ingredients(DOUBLE, 1), "cost must be a QuadraticCost"),
        (
            lambda: terminal_ingredients(
                DOUBLE, QuadraticCost(np.stack([np.eye(2)] * 2), [[[1.0]]] * 2)
            ),
            "cost must be a single model",
        ),
        (
            lambda: terminal_ingredients(DOUBLE, COST, constraints=np.eye(2)),
            "constraints must be a Polyhedron, got ndarray",
        ),
        (
            lambda: terminal_ingredients(DOUBLE, COST, constraints=Polyhedron(np.eye(2), [1, 1])),
            "constraints must have dimension 3, got 2",
        ),
        (
            lambda: terminal_ingredients(
                DOUBLE, COST, constraints=Polyhedron([[1.0, 0, 0]], [-0.5])
            ),
            "constraints must hold the origin inside: all h > 0, got -0.5",
        ),
        (lambda: terminal_ingredients(DOUBLE, COST, max_steps=1), "max_steps must suffice"),
        (
            lambda: terminal_ingredients(
                LinearSystem([[2.0]], [[0.0]], dt=1.0), QuadraticCost([[1.0]], [[1.0]])
            ),
            "must be stabilisable",
        ),
        (
            lambda: LinearMPC(
                MASSES,
                QuadraticCost(np.eye(6), np.eye(2)),
                3,
                terminal=terminal_ingredients(DOUBLE, COST),
            ),
            "terminal must have dimension 6, got 2",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
