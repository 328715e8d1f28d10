"""The yes or no of `check_stability`, its proof by other means, and what it promises."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.optimize import minimize

from prefmpc import (
    BatchedMPC,
    ConvexMPC,
    ICNNCost,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    SecondOrderCone,
    SumCost,
    Trajectory,
    check_stability,
    oscillating_masses,
)

SYSTEM = LinearSystem([[1.2, 1.0], [0.0, 1.1]], [[0.0], [1.0]], dt=1.0, u_min=-2, u_max=2)
QUADRATIC = QuadraticCost(np.eye(2), [[1.0]])


def network(seed, **options):
    options = {"floor": 0.05, "widths": (6, 5), **options}
    return ICNNCost.random([1, 1, 1], key=jax.random.key(2700 + seed), **options)


def stage(cost, z):
    return float(cost(Trajectory(np.stack([z[:2], z[:2]]), z[None, 2:])))


def test_a_shifted_parabola_by_hand():
    # ℓ = relu(2x − 2)·1 + relu(2 − 2x) + floor·(x² + u²) = 2|x − 1| + x² + u² on x⁺ = 2x + u, so
    # that u_s = −x_s: min 2|x − 1| + 2x² at x_s = ½; λ(x − 2x − u) must cancel the slope −1 in x.
    cost = ICNNCost(
        [[[2.0, 0.0], [-2.0, 0.0]]],
        [[-2.0, 2.0]],
        [],
        [1.0, 1.0],
        scale=[1.0, 1.0],
        activation="relu",
        floor=1.0,
    )
    check = check_stability(LinearSystem([[2.0]], [[1.0]], dt=1.0), cost)
    assert check.stable
    assert check.x == pytest.approx(0.5, abs=1e-6)
    assert check.u == pytest.approx(-0.5, abs=1e-6)
    assert check.multiplier == pytest.approx(-1.0, abs=1e-5)
    assert check.stage_cost == pytest.approx(1.5, abs=1e-7)
    np.testing.assert_array_equal(check.modulus, np.eye(2))
    # ℓ̃ = ℓ − 1.5 + x + u; at (1, 0): 1 − 1.5 + 1.
    assert check.rotated([[1.0]], [[0.0]]) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("activation", ["relu", "softplus"])
def test_the_rotated_cost_grows_as_the_modulus_says(activation):
    cost = SumCost([network(0, activation=activation), QUADRATIC], [1.0, 0.1])
    wall = Polyhedron([[-1.0, 0.0, 0.5]], [-0.2])  # keeps the origin out
    check = check_stability(SYSTEM, cost, constraints=wall)
    assert check.stable
    assert wall.contains([*check.x, *check.u], tol=1e-6)
    np.testing.assert_allclose(SYSTEM.A @ check.x + SYSTEM.B @ check.u, check.x, atol=1e-7)
    z = np.random.default_rng(0).uniform(-2, 2, (2000, 3))
    z = z[wall.contains(z)]
    away = z - np.concatenate([check.x, check.u])
    bound = np.einsum("ki,ij,kj->k", away, check.modulus, away)
    assert (check.rotated(z[:, :2], z[:, 2:]) >= bound - 1e-6).all()
    # The best steady state by another solver, along the line of steady states.
    line = np.array([1.0, -0.2, 0.02])  # x₁ = 1.2 x₁ + x₂, x₂ = 1.1 x₂ + u
    found = minimize(
        lambda t: stage(cost, t[0] * line), [1.0], bounds=[(0.2 / 0.99, 5)], method="Nelder-Mead"
    )
    assert check.stage_cost == pytest.approx(found.fun, abs=1e-6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_yes_means_descent_and_convergence(seed):
    cost = network(seed, activation="relu" if seed == 2 else "softplus")
    check = check_stability(SYSTEM, cost)
    assert check.stable
    assert np.abs(check.x).max() > 0.01  # the set point of a network is its own choice
    controller = ConvexMPC(SYSTEM, cost, 6, terminal=check)
    x = np.array([0.5, 0.2])
    solution = controller.solve(x)
    for _ in range(60):
        first = check.rotated(x[None], solution.u[None])[0]
        assert first >= -1e-6
        before = check.value(solution)
        x = SYSTEM.A @ x + SYSTEM.B @ solution.u
        solution = controller.solve(x)
        assert solution.success
        assert check.value(solution) <= before - first + 1e-6
    np.testing.assert_allclose(x, check.x, atol=1e-4)
    np.testing.assert_allclose(solution.trajectory.x[-1], check.x, atol=1e-6)


def test_without_the_terminal_equality_the_same_cost_can_fail():
    cost = SumCost([QuadraticCost(np.diag([1e-3, 1.0]), [[1.0]])])
    check = check_stability(SYSTEM, cost)
    assert check.stable
    np.testing.assert_allclose([*check.x, *check.u], 0, atol=1e-6)
    naive = BatchedMPC(SYSTEM, cost.models[0], 2)
    cured = ConvexMPC(SYSTEM, cost, 6, terminal=check)
    x = y = np.array([0.5, 0.0])
    for _ in range(30):
        x = SYSTEM.A @ x + SYSTEM.B @ cured(x)
        y = SYSTEM.A @ y + SYSTEM.B @ naive(y)
    assert np.abs(y).max() > 10 > 0.01 > np.abs(x).max()


@pytest.mark.parametrize(
    ("cost", "sets", "reason"),
    [
        (network(4, floor=0.0), {}, "not strictly convex in the states"),
        (QuadraticCost(np.diag([1.0, 0.0]), [[1.0]]), {}, "not strictly convex in the states"),
        (network(4, steps=3), {}, "σ looks at whole trajectories"),
        (SumCost([QUADRATIC, network(4, steps=3)]), {}, "σ looks at whole trajectories"),
        (QUADRATIC, {"constraints": Polyhedron([[-1.0, 0, 0]], [-300.0])}, "no steady state"),
    ],
)
def test_no_is_said_with_a_reason_and_no_controller_is_built_on_it(cost, sets, reason):
    check = check_stability(SYSTEM, cost, **sets)
    assert not check.stable
    assert reason in check.reason
    with pytest.raises(ValueError, match="terminal must be a check that says yes, got: "):
        ConvexMPC(SYSTEM, QUADRATIC, 3, terminal=check)


def test_cones_move_the_steady_state_too():
    cone = SecondOrderCone(np.eye(2), 0.5, g=[-1.0, 0.0])  # y within ½ of (1, 0)
    check = check_stability(SYSTEM, QUADRATIC, output_cones=[cone])
    assert check.stable
    assert cone.contains(check.x, tol=1e-6)
    assert np.hypot(check.x[0] - 1, check.x[1]) == pytest.approx(0.5, abs=1e-6)


YES = check_stability(SYSTEM, QUADRATIC)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: check_stability(QUADRATIC, QUADRATIC), "system must be a LinearSystem"),
        (lambda: check_stability(SYSTEM, len), "cost must be a convex σ .* got builtin"),
        (lambda: check_stability(oscillating_masses(), QUADRATIC), "cost must weigh 6 states"),
        (lambda: check_stability(SYSTEM, network(5, shape=(2,))), "cost must be a single model"),
        (lambda: check_stability(SYSTEM, QUADRATIC, tol=-1), "tol must be finite and at least 0"),
        (
            lambda: check_stability(SYSTEM, QUADRATIC, constraints=Polyhedron(np.eye(2), [1, 1])),
            "constraints must have dimension 3, got 2",
        ),
        (
            lambda: check_stability(SYSTEM, QUADRATIC, output_cones=[1]),
            r"output_cones\[0\] must be a SecondOrderCone",
        ),
        (
            lambda: ConvexMPC(
                oscillating_masses(), QuadraticCost(np.eye(6), np.eye(2)), 3, terminal=YES
            ),
            "terminal must have dimension 6, got 2",
        ),
        (lambda: YES.rotated([1.0, 2.0], [[1.0]]), "x must have 2 dimension"),
        (lambda: YES.rotated([[1.0, 2.0]], [[1.0, 2.0]]), "u must have shape"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
