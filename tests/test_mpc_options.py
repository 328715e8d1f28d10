"""What a controller may be asked for beside the paper's problem, against cvxpy."""

from __future__ import annotations

from itertools import pairwise

import cvxpy as cp
import numpy as np
import pytest

from prefmpc import (
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    Trajectory,
    oscillating_masses,
)

N = 8
CART = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_min=-1, u_max=1)
COST = QuadraticCost([[4.0, 1], [1, 2]], [[0.5]])
ROOM = Polyhedron.box([-1, -0.5, -1], [1, 0.5, 1])


class Oracle:
    """The whole problem as one would write it down, solved anew for each state."""

    def __init__(self, soft=None, curved=0.0, increment=None, blocks=None, constraints=None):
        nx, nu = 2, 1
        self.x, self.u = cp.Variable((N + 1, nx)), cp.Variable((N, nu))
        self.x0, self.d = cp.Parameter(nx), cp.Parameter((N, nx))
        self.r, self.ur = cp.Parameter((N + 1, nx)), cp.Parameter((N, nu))
        self.before = cp.Parameter(nu)
        L, M = np.linalg.cholesky(COST.Q), np.linalg.cholesky(COST.R)
        cost = cp.sum_squares((self.x[:N] - self.r[:N]) @ L)
        cost += cp.sum_squares((self.u - self.ur) @ M)
        moved = self.x[:N] @ CART.A.T + self.u @ CART.B.T + self.d
        rules = [self.x[0] == self.x0, self.x[1:] == moved, cp.abs(self.u) <= 1]
        if constraints is not None:
            beyond = cp.hstack([self.x[:N], self.u]) @ constraints.H.T - constraints.h[None]
            if soft is None:
                rules.append(beyond <= 0)
            else:
                hard = ~np.isfinite(soft)
                self.s = cp.Variable((N, len(soft)), nonneg=True)
                rules += [beyond <= self.s, self.s[:, hard] == 0]
                cost += cp.sum(self.s[:, ~hard] @ soft[~hard])
                cost += curved * cp.sum_squares(self.s)
        if increment is not None:
            rules += [cp.abs(self.u[0] - self.before) <= increment]
            rules += [cp.abs(cp.diff(self.u, axis=0)) <= increment]
        at = np.cumsum([0, *(blocks or [])])
        for first, last in pairwise(at):
            rules += [self.u[k] == self.u[first] for k in range(first + 1, last)]
        self.problem = cp.Problem(cp.Minimize(cost), rules)

    def __call__(self, x0, d=0.0, r=0.0, ur=0.0, before=0.0):
        for parameter, value in zip(
            (self.x0, self.d, self.r, self.ur, self.before), (x0, d, r, ur, before), strict=True
        ):
            parameter.value = np.broadcast_to(value, parameter.shape)
        tight = dict.fromkeys(["tol_gap_abs", "tol_gap_rel", "tol_feas"], 1e-11)
        self.problem.solve(cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND, **tight)
        return self.u.value if self.problem.status == "optimal" else None


def states(count, size=(1.2, 0.6)):
    return np.random.default_rng(3).uniform(-1, 1, (count, 2)) * size


def test_soft_rows_and_a_disturbance_against_cvxpy():
    soft = np.array([30.0, 5, np.inf, 30, 0.3, np.inf])
    controller = LinearMPC(CART, COST, N, constraints=ROOM, soft=soft, soft_quadratic=2.0)
    oracle = Oracle(soft, 2.0, constraints=ROOM)
    rng, broken = np.random.default_rng(4), 0
    for x0 in states(200):
        d = rng.normal(size=(N, 2)) * 0.02
        found = controller.solve(x0, disturbance=d)
        assert found.status == "solved", found.message
        np.testing.assert_allclose(found.trajectory.u, oracle(x0, d), rtol=0, atol=1e-6)
        slack = np.where(np.isfinite(soft), oracle.s.value, 0)
        np.testing.assert_allclose(found.broken, slack, rtol=0, atol=1e-6)
        broken += found.broken.max() > 1e-3
    assert 50 < broken < 190


def test_increments_and_a_preview_against_cvxpy():
    controller = LinearMPC(CART, COST, N, constraints=ROOM, max_increment=0.3)
    oracle, rng, limited = Oracle(increment=0.3, constraints=ROOM), np.random.default_rng(5), 0
    verdicts = set()
    for x0 in states(200, (0.8, 0.4)):
        r, ur = rng.normal(size=(N + 1, 2)) * 0.3, rng.normal(size=(N, 1)) * 0.2
        before = rng.uniform(-1, 1, 1)
        reference = Trajectory(r, ur, y=r[:-1])
        found = controller.solve(x0, reference=reference, u_before=before)
        wanted = oracle(x0, 0.0, r, ur, before)
        verdicts.add(found.status)
        assert found.status == ("solved" if wanted is not None else "infeasible")
        if wanted is not None:
            np.testing.assert_allclose(found.trajectory.u, wanted, rtol=0, atol=1e-6)
            step = np.abs(np.diff(found.trajectory.u, axis=0, prepend=before[None]))
            assert step.max() <= 0.3 + 1e-7
            limited += step.max() > 0.3 - 1e-7
    assert limited > 100
    assert "solved" in verdicts


@pytest.mark.parametrize("blocks", [[1, 1, 2, 4], [8]])
def test_blocks_against_cvxpy(blocks):
    controller, oracle = LinearMPC(CART, COST, N, blocks=blocks), Oracle(blocks=blocks)
    at = np.repeat(np.arange(len(blocks)), blocks)
    for x0 in states(100, (2, 1)):
        U = controller.solve(x0).trajectory.u
        np.testing.assert_allclose(U, oracle(x0), rtol=0, atol=1e-6)
        assert np.abs(U - U[np.searchsorted(at, at)]).max() < 1e-9


def test_the_hard_plan_is_the_soft_one_where_there_is_one():
    hard = LinearMPC(CART, COST, N, constraints=ROOM)
    soft = LinearMPC(CART, COST, N, constraints=ROOM, soft=1e3)
    solved = 0
    for x0 in states(100, (1, 0.5)):
        one, other = hard.solve(x0), soft.solve(x0)
        assert other.status == "solved"
        if one.status == "solved":
            solved += 1
            np.testing.assert_allclose(other.trajectory.u, one.trajectory.u, rtol=0, atol=1e-6)
            assert other.broken.max() == 0
            assert other.cost == pytest.approx(one.cost, rel=1e-6)
    assert 50 < solved < 100


def test_a_state_just_beyond_a_limit_is_no_end():
    masses, cost = oscillating_masses(), QuadraticCost(np.eye(6), np.eye(2))
    room = Polyhedron.box([-0.3] * 3 + [-9] * 3 + [-1] * 2, [0.3] * 3 + [9] * 3 + [1] * 2)
    controller = LinearMPC(masses, cost, 10, constraints=room, soft=200.0, soft_quadratic=100.0)
    hard = LinearMPC(masses, cost, 10, constraints=room)
    x0 = np.array([0.3001, 0, 0, 0, 0, 0])
    assert hard.solve(x0).status == "infeasible"
    found = controller.solve(x0)
    assert found.status == "solved"
    assert found.broken[0, 0] == pytest.approx(1e-4)
    assert list(np.flatnonzero(found.broken.any(axis=0))) == [0]
    rng, ended = np.random.default_rng(6), 0
    for start in rng.uniform(-1, 1, (200, 6)) * ([0.3] * 3 + [0.3] * 3):
        x = start
        ended += hard.solve(x + rng.normal(size=6) * 0.01).status != "solved"
        for _ in range(4):
            x = masses.step(x, controller(x + rng.normal(size=6) * 0.01))
    assert ended > 10


def test_increments_are_counted_from_the_input_that_was_applied():
    controller = LinearMPC(CART, COST, N, max_increment=[0.1])
    free = controller.solve([2.0, 0]).u
    assert free == pytest.approx([-1])  # nothing is known of an input before
    controller.applied(np.zeros(1))
    u = [controller([2.0, 0])[0] for _ in range(4)]
    np.testing.assert_allclose(u, [-0.1, -0.2, -0.3, -0.4], atol=1e-9)
    controller.reset()
    assert controller.solve([2.0, 0]).u == pytest.approx([-1])


def test_in_other_units_the_plan_is_the_same():
    T, S = np.diag([1e4, 1e-3]), 1e3
    other = LinearSystem(T @ CART.A @ np.linalg.inv(T), T @ CART.B / S, dt=0.1, u_min=-S, u_max=S)
    inverse = np.diag([1e-4, 1e3])
    cost = QuadraticCost(1e6 * inverse @ COST.Q @ inverse, 1e6 * COST.R / S**2)
    room = Polyhedron(ROOM.H @ np.diag([1e-4, 1e3, 1 / S]), ROOM.h)
    one = LinearMPC(CART, COST, N, constraints=ROOM, soft=20.0, max_increment=0.4)
    two = LinearMPC(other, cost, N, constraints=room, soft=2e7, max_increment=0.4 * S)
    for x0 in states(30):
        d = np.array([0.01, -0.02])
        a = one.solve(x0, disturbance=d, u_before=[0.2]).trajectory.u
        b = two.solve(T @ x0, disturbance=T @ d, u_before=[0.2 * S]).trajectory.u
        np.testing.assert_allclose(a, b / S, rtol=0, atol=1e-7)


@pytest.mark.parametrize("LinearMPC", [LinearMPC])
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"soft": 0.0}, "soft"),
        ({"soft": [1.0]}, "soft"),
        ({"soft": np.nan}, "soft"),
        ({"soft": 1.0, "constraints": None}, "soft"),
        ({"soft_quadratic": 1.0}, "soft_quadratic"),
        ({"soft": 1.0, "soft_quadratic": -1.0}, "soft_quadratic"),
        ({"max_increment": 0.0}, "max_increment"),
        ({"max_increment": [1.0, 1.0]}, "max_increment"),
        ({"blocks": [3, 4]}, "blocks"),
        ({"blocks": [0, 8]}, "blocks"),
        ({"blocks": 8}, "blocks"),
    ],
)
def test_bad_input_of_the_options(LinearMPC, changed, message):
    given = {"system": CART, "cost": COST, "horizon": N, "constraints": ROOM, **changed}
    with pytest.raises(ValueError, match=message):
        LinearMPC(**given)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"disturbance": [1.0]}, "disturbance"),
        ({"disturbance": [np.nan, 0]}, "disturbance"),
        ({"u_before": [1.0, 2]}, "u_before"),
        ({"reference": Trajectory(np.zeros((3, 2)), np.zeros((2, 1)))}, "reference.x"),
    ],
)
def test_bad_input_of_a_solve(changed, message):
    with pytest.raises(ValueError, match=message):
        LinearMPC(CART, COST, N).solve([0.0, 0], **changed)
