"""The controllers against solvers that share nothing with them but the problem."""

from __future__ import annotations

import ctypes

import cvxpy as cp
import daqp
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
    oscillating_masses,
    random_states,
)
from prefmpc.mpc import _batched_qp, _cone, _dual_method, qp
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2000)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
N = 10


class Oracle:
    """The QP in the inputs alone, found by simulating unit responses, solved by DAQP."""

    def __init__(self, system, Q, R, horizon):
        self.lower, self.upper = (np.tile(b, horizon) for b in (system.u_min, system.u_max))
        self.shape = (horizon, system.nu)

        def states(x, inputs):  # x_0 … x_{N−1}
            seen = []
            for u in inputs:
                seen.append(x)
                x = system.A @ x + system.B @ u
            return np.concatenate(seen)

        nothing = np.zeros(self.shape)
        units = np.eye(horizon * system.nu).reshape(-1, *self.shape)
        response = np.stack([states(np.zeros(system.nx), unit) for unit in units], axis=1)
        free = np.stack([states(x, nothing) for x in np.eye(system.nx)], axis=1)
        stage = np.kron(np.eye(horizon), Q)
        self.H = 2 * (response.T @ stage @ response + np.kron(np.eye(horizon), R))
        self.F = 2 * response.T @ stage @ free
        self.constant = free.T @ stage @ free

    def __call__(self, x):
        size = self.H.shape[0]
        wide = [np.clip(b, -1e30, 1e30) for b in (self.upper, self.lower)]
        U, _, flag, _ = daqp.solve(
            self.H, self.F @ x, np.zeros((0, size)), *wide, np.zeros(size, ctypes.c_int),
            primal_tol=1e-10, dual_tol=1e-10,
        )  # fmt: skip
        assert flag == 1
        return np.asarray(U).reshape(self.shape)

    def cost(self, x, U):
        U = U.ravel()
        return U @ self.H @ U / 2 + x @ self.F.T @ U + x @ self.constant @ x


def active(system, U):
    return ((U <= system.u_min + 1e-9) | (U >= system.u_max - 1e-9)).mean()


def test_linear_mpc_on_a_thousand_states():
    oracle, controller = Oracle(MASSES, QUADRATIC_Q, QUADRATIC_R, N), LinearMPC(MASSES, PAPER, N)
    states = random_states(8 * RADIUS, key=KEY, shape=(1000,))
    saturated = 0
    for x in states:
        ours, reference = controller.solve(x), oracle(x)
        assert ours.status == "solved"
        np.testing.assert_allclose(ours.trajectory.u, reference, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(ours.u, ours.trajectory.u[0])
        assert ours.cost == pytest.approx(oracle.cost(x, reference), rel=1e-5)
        saturated += active(MASSES, reference) > 0.1
    assert saturated > 500  # the bounds matter on most of these states


WEIGHTS = {
    "paper": (QUADRATIC_Q, QUADRATIC_R),
    "cheap inputs": (QUADRATIC_Q, 1e-6 * np.eye(2)),
    "one cheap input": (QUADRATIC_Q, np.diag([1.0, 1e-6])),
    "positions only": (np.diag([1.0, 1, 1, 0, 0, 0]), 0.01 * np.eye(2)),
    "dear inputs": (np.eye(6), 1e4 * np.eye(2)),
    "coupled": (np.ones((6, 6)) + np.eye(6), np.array([[1, 0.9], [0.9, 1]])),
}


@pytest.fixture(scope="module")
def batched_answers():
    Q, R = (np.stack(list(m)) for m in zip(*WEIGHTS.values(), strict=True))
    states = random_states(8 * RADIUS, key=KEY, shape=(200,))
    return states, BatchedMPC(MASSES, QuadraticCost(Q, R), N).solve(states)


@pytest.mark.parametrize("name", WEIGHTS)
def test_batched_mpc_on_many_states(batched_answers, name):
    states, answer = batched_answers
    i = list(WEIGHTS).index(name)
    assert (answer.status[i] == "solved").all()
    oracle = Oracle(MASSES, *WEIGHTS[name], N)
    reference = np.stack([oracle(x) for x in states])
    np.testing.assert_allclose(answer.trajectory.u[i], reference, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(answer.u[i], answer.trajectory.u[i, :, 0])
    costs = [oracle.cost(x, U) for x, U in zip(states, reference, strict=True)]
    np.testing.assert_allclose(answer.cost[i], costs, rtol=1e-8)
    if name in ("paper", "cheap inputs"):
        assert active(MASSES, reference) > 0.05


def test_the_estimate_of_the_error_holds(batched_answers):
    states, answer = batched_answers
    oracle = Oracle(MASSES, *WEIGHTS["paper"], N)
    assert answer.residual.max() <= 1e-8
    for x, U, bound in zip(states, answer.trajectory.u[0], answer.residual[0], strict=True):
        assert np.abs(U - oracle(x)).max() <= 10 * bound + 1e-8


def test_the_predicted_trajectory_obeys_the_plant(batched_answers):
    states, answer = batched_answers
    one = LinearMPC(MASSES, PAPER, N).solve(states[0]).trajectory
    many = answer.trajectory
    for T, atol in ((one, 1e-6), (many, 1e-12)):
        moved = T.x[..., :-1, :] @ MASSES.A.T + T.u @ MASSES.B.T
        np.testing.assert_allclose(T.x[..., 1:, :], moved, rtol=0, atol=atol)
        np.testing.assert_allclose(T.y, T.x[..., :-1, :3], rtol=0, atol=1e-12)
        assert (np.abs(T.u) <= 1).all()
    np.testing.assert_array_equal(many.x[:, :, 0], np.broadcast_to(states, (6, 200, 6)))


def integrator(u_min, u_max):
    return LinearSystem([[1, 1], [0, 1]], [[0.5], [1]], dt=1, u_min=u_min, u_max=u_max)


@pytest.mark.parametrize("bounds", [(None, None), (-0.3, None), (None, 0.3), (-np.inf, 0.3)])
def test_open_and_one_sided_bounds(bounds):
    system, Q, R = integrator(*bounds), np.eye(2), np.eye(1)
    cost, oracle = QuadraticCost(Q, R), Oracle(system, Q, R, 5)
    single, many = LinearMPC(system, cost, 5), BatchedMPC(system, cost, 5)
    states = np.array([[2.0, 0], [-2, 0], [1, 1], [0, 0]])
    reference = np.stack([oracle(x) for x in states])
    np.testing.assert_allclose(many.solve(states).trajectory.u, reference, atol=1e-6)
    for x, U in zip(states, reference, strict=True):
        np.testing.assert_allclose(single.solve(x).trajectory.u, U, atol=1e-5)
    # σ does not weigh x_N, so nothing speaks for a last input other than 0.
    np.testing.assert_allclose(reference[:, -1], 0, atol=1e-9)
    np.testing.assert_allclose(many.solve(states).trajectory.u[:, -1], 0, atol=1e-9)


def test_without_bounds_the_horizon_2_input_is_known():
    # σ = x_0² + u_0² + (x_0 + u_0)² + u_1² is smallest at u_0 = −x_0/2, u_1 = 0.
    system, cost = LinearSystem([[1]], [[1]], dt=1), QuadraticCost([[1]], [[1]])
    for controller in (LinearMPC(system, cost, 2), BatchedMPC(system, cost, 2)):
        answer = controller.solve([3.0])
        np.testing.assert_allclose(answer.trajectory.u, [[-1.5], [0]], atol=1e-6)
        assert float(answer.cost) == pytest.approx(9 + 2.25 + 2.25, rel=1e-6)
        np.testing.assert_allclose(controller([3.0]), [-1.5], atol=1e-6)


def test_with_horizon_1_no_input_is_worth_its_price():
    for controller in (LinearMPC(MASSES, PAPER, 1), BatchedMPC(MASSES, PAPER, 1)):
        answer = controller.solve(RADIUS)
        np.testing.assert_allclose(answer.u, 0, atol=1e-7)
        assert float(answer.cost) == pytest.approx(RADIUS @ QUADRATIC_Q @ RADIUS, rel=1e-6)


def test_shapes_of_batches(batched_answers):
    stack = QuadraticCost.random(6, 2, key=KEY, shape=(3,))
    many, third = BatchedMPC(MASSES, stack, N), LinearMPC(MASSES, stack[2], N)
    x = random_states(RADIUS, key=KEY, shape=(3, 1))
    # One state for all costs, a batch of one for all costs, a batch of one for each cost.
    for states, lead in ((x[2, 0], (3,)), (x[2], (3, 1)), (x, (3, 1))):
        answer = many.solve(states)
        assert answer.success
        assert answer.trajectory.x.shape == (*lead, N + 1, 6)
        assert answer.status.shape == answer.residual.shape == answer.iterations.shape == lead
        assert answer.cost.shape == lead
        np.testing.assert_allclose(answer.u[2].ravel(), third(x[2, 0]), atol=1e-6)
    np.testing.assert_array_equal(answer.trajectory.x[:, :, 0], x)
    assert batched_answers[1].cost.shape == batched_answers[1].status.shape == (6, 200)


# A wall for the first mass, a limit on what force and position add up to, and a place to end in.
COUPLED = Polyhedron(
    [[1, 0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, -1, 0, 0.5]],
    [0.5, 0.8, 0.6],
)
TERMINAL = Polyhedron.box([-0.5] * 6, [0.5] * 6)


@pytest.fixture(scope="module")
def clarabel():
    """The same problem for cvxpy, which returns "optimal" or "infeasible", and the inputs."""
    x, u, x0 = cp.Variable((N + 1, 6)), cp.Variable((N, 2)), cp.Parameter(6)
    L, M = np.linalg.cholesky(QUADRATIC_Q), np.linalg.cholesky(QUADRATIC_R)
    constraints = [x[0] == x0, x[1:] == x[:-1] @ MASSES.A.T + u @ MASSES.B.T, cp.abs(u) <= 1]
    constraints += [COUPLED.H @ cp.hstack([x[k], u[k]]) <= COUPLED.h for k in range(N)]
    constraints += [TERMINAL.H @ x[N] <= TERMINAL.h]
    problem = cp.Problem(
        cp.Minimize(cp.sum_squares(x[:-1] @ L) + cp.sum_squares(u @ M)), constraints
    )

    def solve(state):
        x0.value = state
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-10)
        return problem.status, u.value

    return solve


def test_coupled_constraints_and_what_cannot_be_done(clarabel):
    controller = LinearMPC(MASSES, PAPER, N, constraints=COUPLED, terminal=TERMINAL)
    plain = LinearMPC(MASSES, PAPER, N)
    states = random_states(np.array([0.8, 0.8, 0.8, 0.6, 0.6, 0.6]), key=KEY, shape=(60,))
    seen = {"optimal": 0, "infeasible": 0}
    matters = 0
    for state in states:
        status, inputs = clarabel(state)
        seen[status] += 1
        ours = controller.solve(state)
        if status == "optimal":
            assert ours.status == "solved"
            np.testing.assert_allclose(ours.trajectory.u, inputs, atol=2e-5)
            points = np.concatenate([ours.trajectory.x[:-1], ours.trajectory.u], axis=1)
            assert COUPLED.contains(points, tol=1e-5).all()
            assert TERMINAL.contains(ours.trajectory.x[-1], tol=1e-5)
            matters += np.abs(inputs - plain.solve(state).trajectory.u).max() > 1e-2
        else:
            assert ours.status == "infeasible"
            assert not ours.success
            for value in (ours.u, ours.cost, ours.trajectory.x, ours.trajectory.u):
                assert np.isnan(value).all()
            with pytest.raises(MPCError, match="infeasible: no input sequence") as caught:
                controller(state)
            assert caught.value.solution.status == "infeasible"
    assert min(seen.values()) >= 5
    assert matters >= 5


@pytest.mark.parametrize("end", [None, Polyhedron.box([-0.4] * 6, [0.3] * 6)])
def test_what_osqp_leaves_unfinished_is_solved_by_clarabel(monkeypatch, end):
    wall = Polyhedron(np.eye(8)[:1], [0.25])
    complete = LinearMPC(MASSES, PAPER, N, constraints=wall, terminal=end)
    monkeypatch.setitem(qp._SETTINGS, "max_iter", 2)
    hasty = LinearMPC(MASSES, PAPER, N, constraints=wall, terminal=end)
    statuses = set()
    for state in random_states(1.2 * RADIUS, key=KEY, shape=(12,)):
        expected, answer = complete.solve(state), hasty.solve(state)
        statuses.add(answer.status)
        assert answer.status == expected.status
        if answer.success:
            assert "by Clarabel after OSQP stopped at 2 iterations" in answer.message
            np.testing.assert_allclose(answer.trajectory.u, expected.trajectory.u, atol=1e-5)
            assert answer.cost == pytest.approx(expected.cost, rel=1e-6)
    assert statuses == {"solved", "infeasible"}


def test_too_few_iterations_are_never_silent(monkeypatch):
    monkeypatch.setitem(qp._SETTINGS, "max_iter", 2)
    monkeypatch.setitem(_cone._TOLERANCES, "max_iter", 1)
    controller = LinearMPC(MASSES, PAPER, N)
    answer = controller.solve(8 * RADIUS)
    assert (answer.status, answer.success) == ("failed", False)
    assert np.isnan(answer.u).all()
    assert np.isnan(answer.cost)
    with pytest.raises(MPCError, match=r"failed: Clarabel says 'MaxIterations'.* 2 iterations"):
        controller(8 * RADIUS)


def test_unsolved_states_of_a_batch_are_nan_and_the_others_are_not(monkeypatch):
    monkeypatch.setattr(_batched_qp, "STEPS", 0)
    monkeypatch.setattr(_dual_method, "LIMIT", (0, 3))
    # A horizon that no other test uses, so that nothing compiled before is used again.
    controller = BatchedMPC(MASSES, PAPER, 7)
    states = np.stack([0.01 * RADIUS, 20 * RADIUS])  # the start is optimal without bounds
    answer = controller.solve(states)
    np.testing.assert_array_equal(answer.status, ["solved", "max_iterations"])
    assert not answer.success
    np.testing.assert_array_equal(np.isnan(answer.u).any(axis=-1), [False, True])
    assert np.isnan(answer.cost[1])
    assert np.isfinite(answer.cost[0])
    with pytest.raises(MPCError, match="of 2 problems 1 max_iterations"):
        controller(states)


WRONG = QuadraticCost(np.eye(2), np.eye(2))
STACK = QuadraticCost.random(6, 2, key=KEY, shape=(3,))
BROKEN = jax.tree.map(lambda leaf: leaf * np.nan, PAPER)


@pytest.mark.parametrize("controller", [LinearMPC, BatchedMPC])
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda c: c(MASSES, PAPER, 0), "horizon must be a whole number of at least 1, got 0"),
        (lambda c: c(MASSES, PAPER, 2.5), "horizon must be a whole number"),
        (lambda c: c(MASSES, PAPER, True), "horizon must be a whole number"),
        (lambda c: c(MASSES, WRONG, 2), "cost must weigh 6 states and 2 inputs.*got 2 and 2"),
        (lambda c: c(MASSES, BROKEN, 2), "cost must have finite weights"),
        (lambda c: c(MASSES, QUADRATIC_Q, 2), "cost must be a QuadraticCost, got ndarray"),
        (lambda c: c(MASSES.A, PAPER, 2), "system must be a LinearSystem, got ndarray"),
        (lambda c: c(MASSES, PAPER, 2).solve(np.ones(5)), r"x0 must have shape \(..., 6\)"),
        (lambda c: c(MASSES, PAPER, 2).solve(1.0), "x0 must have shape"),
        (lambda c: c(MASSES, PAPER, 2)(np.full(6, np.nan)), "x0 must be finite"),
        (lambda c: c(MASSES, PAPER, 2)(np.full(6, np.inf)), "x0 must be finite"),
        (lambda c: c(MASSES, PAPER, 2).solve(np.ones((2, 2, 6))), "x0 must have shape"),
    ],
)
def test_bad_input_of_both_is_named(controller, call, words):
    with pytest.raises(ValueError, match=words):
        call(controller)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: LinearMPC(MASSES, STACK, 2), r"cost must be a single model.*\(3,\)"),
        (lambda: LinearMPC(MASSES, PAPER, 2).solve(np.ones((2, 6))), r"x0 must have shape \(6,\)"),
        (
            lambda: LinearMPC(MASSES, PAPER, 2, constraints=TERMINAL),
            "constraints must have.* 8",
        ),
        (lambda: LinearMPC(MASSES, PAPER, 2, terminal=COUPLED), "terminal must have dimension 6"),
        (lambda: LinearMPC(MASSES, PAPER, 2, terminal=np.eye(6)), "terminal must be a Polyhedron"),
        (lambda: BatchedMPC(MASSES, PAPER, 2, tol=-1), "tol must be finite and at least 0"),
        (lambda: BatchedMPC(MASSES, STACK, 2).solve(np.ones((2, 4, 6))), "x0 must have 3 rows"),
        (
            lambda: BatchedMPC(MASSES, jax.tree.map(lambda leaf: leaf[None], STACK), 2),
            "cost must be a single one or a stack along one axis",
        ),
    ],
)
def test_bad_input_of_one_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
