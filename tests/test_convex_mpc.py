"""The convex controller against other solvers, with every kind of constraint, on bad input."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from prefmpc import (
    ConvexMPC,
    Ellipsoid,
    ICNNCost,
    LinearMPC,
    LinearSystem,
    MPCError,
    Polyhedron,
    QuadraticCost,
    SecondOrderCone,
    SumCost,
    Trajectory,
    oscillating_masses,
    random_states,
    soft_constraints,
    terminal_ingredients,
)
from prefmpc.mpc import _cone

SYSTEM = LinearSystem([[1.0, 0.2], [-0.1, 0.9]], [[0.0], [0.3]], dt=0.1, u_min=-1, u_max=1)
COST = QuadraticCost([[3.0, 0.5], [0.5, 1.0]], [[0.4]])
SCALE = np.array([1.0, 1.0, 1.0])
N = 5
STATES = random_states([0.8, 0.8], key=jax.random.key(2600), shape=(12,))


def rolled_out(x0, u):
    x = [np.asarray(x0)]
    for k in range(N):
        x.append(SYSTEM.A @ x[-1] + SYSTEM.B @ u[k])
    return np.stack(x)


def test_it_agrees_with_the_qp_solver_under_all_polyhedral_constraints():
    rng = np.random.default_rng(0)
    counts = {"solved": 0, "infeasible": 0}
    masses = oscillating_masses()
    cost = QuadraticCost(np.diag([40.0] * 3 + [5.0] * 3), 0.2 * np.eye(2))
    for _ in range(20):  # 500 problems
        Z = Polyhedron(rng.normal(size=(3, 8)), rng.uniform(0.4, 1.5, 3))
        end = Polyhedron(rng.normal(size=(2, 6)), rng.uniform(0.02, 1, 2))
        options = {"constraints": Z, "terminal": end}
        qp, cone = (kind(masses, cost, N, **options) for kind in (LinearMPC, ConvexMPC))
        for x0 in rng.uniform(-0.5, 0.5, (25, 6)):
            a, b = qp.solve(x0), cone.solve(x0)
            assert a.status == b.status
            counts[b.status] += 1
            if b.success:
                np.testing.assert_allclose(b.u, a.u, atol=1e-5)
                assert b.cost == pytest.approx(a.cost, rel=1e-5, abs=1e-6)
                assert b.residual < 1e-6
            else:
                assert np.isnan(b.u).all()
                assert "no input sequence keeps" in b.message
    assert min(counts.values()) > 50


def test_terminal_ingredients_agree_too():
    end = terminal_ingredients(SYSTEM, COST)
    qp, cone = (kind(SYSTEM, COST, N, terminal=end) for kind in (LinearMPC, ConvexMPC))
    for x0 in STATES[:6]:
        np.testing.assert_allclose(cone.solve(x0).u, qp.solve(x0).u, atol=1e-5)


@pytest.mark.parametrize("steps", [None, N])
def test_a_relu_network_is_a_linear_program(steps):
    model = ICNNCost.random(
        SCALE, key=jax.random.key(2601), widths=(4, 3), steps=steps, activation="relu"
    )
    controller = ConvexMPC(SYSTEM, model, N)
    # By hand, as a linear program over u and every z ≥ V v + U z', z ≥ 0; HiGHS.
    blocks = N if steps is None else 1
    for x0 in STATES[:4]:
        Phi = np.stack([np.linalg.matrix_power(SYSTEM.A, k) @ x0 for k in range(N)])
        Gamma = np.zeros((N, 2, N))
        for k in range(N):
            for j in range(k):
                Gamma[k, :, j] = (np.linalg.matrix_power(SYSTEM.A, k - 1 - j) @ SYSTEM.B)[:, 0]
        stage_maps = [np.vstack([Gamma[k], np.eye(N)[k]]) for k in range(N)]  # v_k = M u + m
        offsets = [np.append(Phi[k], 0.0) for k in range(N)]
        maps = stage_maps if steps is None else [np.vstack(stage_maps)]
        shifts = offsets if steps is None else [np.concatenate(offsets)]
        size = N + 7 * blocks
        A, b, c = [], [], np.zeros(size)
        for i, (M, m) in enumerate(zip(maps, shifts, strict=True)):
            first = N + 7 * i
            c[first + 4 : first + 7] = model.c
            for unit in range(4):
                row = np.zeros(size)
                row[:N], row[first + unit] = model.V[0][unit] @ M, -1
                A.append(row)
                b.append(-model.V[0][unit] @ m - model.b[0][unit])
            for unit in range(3):
                row = np.zeros(size)
                row[:N], row[first : first + 4] = model.V[1][unit] @ M, model.U[0][unit]
                row[first + 4 + unit] = -1
                A.append(row)
                b.append(-model.V[1][unit] @ m - model.b[1][unit])
        bounds = [(-1, 1)] * N + [(0, None)] * (7 * blocks)
        lp = linprog(c, A_ub=np.array(A), b_ub=b, bounds=bounds, method="highs")
        solution = controller.solve(x0)
        assert solution.cost == pytest.approx(lp.fun, rel=1e-6, abs=1e-6)
        plan = Trajectory(solution.trajectory.x, solution.trajectory.u)
        assert model(plan) == pytest.approx(solution.cost, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("activation", ["softplus", "squared_relu"])
def test_a_smooth_network_with_a_quadratic_agrees_with_slsqp(activation):
    kind = {"widths": (4, 3), "floor": 0.1, "activation": activation}
    network = ICNNCost.random(SCALE, key=jax.random.key(2602), **kind)
    model = SumCost([COST, network], [0.5, 2.0])
    controller = ConvexMPC(SYSTEM, model, N)
    for x0 in STATES[:3]:

        def cost(u, x0=x0):
            return float(model(Trajectory(rolled_out(x0, u[:, None]), u[:, None])))

        found = minimize(
            cost, np.zeros(N), method="SLSQP", bounds=[(-1, 1)] * N, options={"ftol": 1e-14}
        )
        assert controller.solve(x0).cost == pytest.approx(found.fun, rel=1e-6)


def test_cones_and_ellipsoids_hold_and_bind():
    x0 = np.array([0.9, 0.6])
    disc = SecondOrderCone(np.eye(2), 1.0)
    end = Ellipsoid(np.eye(2), 0.55)
    free = ConvexMPC(SYSTEM, COST, N).solve(x0)
    held = ConvexMPC(SYSTEM, COST, N, output_cones=[disc], terminal=end)
    assert held.solve([0.99, 0.6]).status == "infeasible"
    x0 = np.array([0.75, 0.6])
    solution = held.solve(x0)
    x, u = solution.trajectory.x, solution.trajectory.u
    assert solution.success
    assert disc.contains(x[:-1], tol=1e-6).all()
    assert end.contains(x[-1], tol=1e-5)
    assert not end.contains(free.trajectory.x[-1])

    def cost(u):
        return float(COST(Trajectory(rolled_out(x0, u[:, None]), u[:, None])))

    limits = [
        {"type": "ineq", "fun": lambda u: 0.55 - np.sum(rolled_out(x0, u[:, None])[-1] ** 2)},
        {
            "type": "ineq",
            "fun": lambda u: 1 - np.sum(rolled_out(x0, u[:, None])[:-1] ** 2, axis=1),
        },
    ]
    found = minimize(
        cost,
        u[:, 0] * 0.9,
        method="SLSQP",
        bounds=[(-1, 1)] * N,
        constraints=limits,
        options={"ftol": 1e-13, "maxiter": 500},
    )
    assert solution.cost == pytest.approx(found.fun, rel=1e-5)
    np.testing.assert_allclose(rolled_out(x0, u), x, atol=1e-6)


def test_soft_constraints_are_exact_where_hard_ones_can_be_met():
    wall = Polyhedron([[1.0, 0, 0]], [0.5])
    lazy = QuadraticCost(0.1 * np.eye(2), [[1.0]])
    hard = ConvexMPC(SYSTEM, lazy, N, constraints=wall)
    soft, cheap = (
        ConvexMPC(SYSTEM, SumCost([lazy, soft_constraints(wall, price)]), N)
        for price in (100.0, 0.1)
    )
    x0 = np.array([0.4, 0.4])
    assert ConvexMPC(SYSTEM, lazy, N).solve(x0).trajectory.x[:-1, 0].max() > 0.55
    np.testing.assert_allclose(soft(x0), hard(x0), atol=1e-5)
    assert soft.solve(x0).cost == pytest.approx(hard.solve(x0).cost, rel=1e-6)
    assert cheap.solve(x0).trajectory.x[:-1, 0].max() > 0.51
    x0 = np.array([0.6, 0.0])
    assert hard.solve(x0).status == "infeasible"
    assert soft.solve(x0).success


def test_the_call_form_and_a_failed_solve():
    controller = ConvexMPC(SYSTEM, COST, N, terminal=Polyhedron.box([-1e-3] * 2, [1e-3] * 2))
    assert np.shape(controller([0.01, 0.0])) == (1,)
    with pytest.raises(MPCError, match="infeasible"):
        controller([50.0, 0.0])
    solution = controller.solve([50.0, 0.0])
    assert np.isnan(solution.u).all()
    assert np.isnan(solution.cost)
    assert controller.solve([0.01, 0.0]).success  # and the next one is fine again


def test_an_unlucky_solve_is_tried_again(monkeypatch):
    controller, tries = ConvexMPC(SYSTEM, COST, N), []
    expected = controller.solve(STATES[0])
    run = _cone.ConeProgram._run

    def unlucky(solver, b):
        tries.append(run(solver, b))
        return dataclasses.replace(tries[-1], status="failed") if len(tries) % 3 else tries[-1]

    monkeypatch.setattr(_cone.ConeProgram, "_run", staticmethod(unlucky))
    again = controller.solve(STATES[0])
    assert (len(tries), again.status) == (3, "solved")
    np.testing.assert_allclose(again.trajectory.u, expected.trajectory.u, atol=1e-6)
    monkeypatch.setattr(_cone, "_SECOND_TRIES", ())
    assert controller.solve(STATES[0]).status == "failed"


def test_a_second_order_cone_by_hand():
    cone = SecondOrderCone([[1.0, 0.0]], 1.0, g=[0.5], c=[0.0, 2.0])  # |z₁ + ½| ≤ 2 z₂ + 1
    np.testing.assert_array_equal(
        cone.contains([[0.5, 0.0], [0.51, 0.0], [2.5, 1.0], [0.0, -0.3]]),
        [True, False, True, False],
    )
    assert cone.dim == 2


NETWORK = ICNNCost.random(SCALE, key=jax.random.key(2603), widths=(2,), steps=N)
BROKEN = jax.tree.map(lambda leaf: -np.abs(leaf), NETWORK)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ConvexMPC(COST, COST, N), "system must be a LinearSystem"),
        (lambda: ConvexMPC(SYSTEM, len, N), "cost must be a convex σ .* got builtin"),
        (lambda: ConvexMPC(SYSTEM, SumCost([COST, BROKEN]), N), "its c has negative entries"),
        (lambda: ConvexMPC(SYSTEM, NETWORK, N + 1), "horizon must be 5, for which cost was made"),
        (lambda: ConvexMPC(SYSTEM, QuadraticCost([[1.0]], [[1.0]]), N), "cost must weigh 2 states"),
        (lambda: ConvexMPC(oscillating_masses(), NETWORK, N), "cost must see 8 signals, got 3"),
        (
            lambda: ConvexMPC(SYSTEM, QuadraticCost([np.eye(2)] * 2, [np.eye(1)] * 2), N),
            "cost must be a single model",
        ),
        (lambda: ConvexMPC(SYSTEM, COST, 0), "horizon must be a whole number"),
        (
            lambda: ConvexMPC(SYSTEM, COST, N, constraints=Polyhedron(np.eye(2), [1, 1])),
            "constraints must have dimension 3, got 2",
        ),
        (
            lambda: ConvexMPC(SYSTEM, COST, N, terminal=Ellipsoid(np.eye(3))),
            "terminal must have dimension 2, got 3",
        ),
        (lambda: ConvexMPC(SYSTEM, COST, N, terminal=1), "terminal must be a Polyhedron, got int"),
        (
            lambda: ConvexMPC(SYSTEM, COST, N, output_cones=[Ellipsoid(np.eye(2))]),
            r"output_cones\[0\] must be a SecondOrderCone",
        ),
        (lambda: ConvexMPC(SYSTEM, COST, N).solve([1.0]), "x0 must have shape"),
        (lambda: ConvexMPC(SYSTEM, COST, N).solve([np.nan, 0]), "x0 must be finite"),
        (lambda: SecondOrderCone([1.0], 1.0), "F must have 2 dimension"),
        (lambda: SecondOrderCone(np.eye(2), 1.0, g=[1.0]), r"g must have shape \(2,\)"),
        (lambda: SecondOrderCone(np.eye(2), np.inf), "d must be finite"),
        (lambda: SecondOrderCone(np.eye(2), 1.0).contains([1.0]), "z must have shape"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
