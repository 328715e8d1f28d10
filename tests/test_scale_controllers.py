"""Units and the size of σ change nothing: plants with all signals scaled by 1e-9 … 1e9."""

from __future__ import annotations

import numpy as np
import pytest

from prefmpc import (
    ConvexMPC,
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    check_stability,
    steady_state,
    terminal_ingredients,
)

CLOSE = 1e-6


class Case:
    """A random plant with its σ, limits and state, and the same in other units."""

    def __init__(self, seed, largest=6):
        rng = np.random.default_rng(seed)
        self.nx, self.nu = int(rng.integers(2, largest)), int(rng.integers(1, 3))
        A = rng.normal(size=(self.nx, self.nx))
        self.A = A * rng.uniform(0.5, 2) / np.abs(np.linalg.eigvals(A)).max()
        self.B = rng.normal(size=(self.nx, self.nu))
        self.C = rng.normal(size=(self.nu, self.nx))
        Q = rng.normal(size=(self.nx, self.nx))
        self.Q, self.R = Q @ Q.T, np.diag(10 ** rng.uniform(-2, 1, self.nu))
        self.u_max = 1.0 if rng.random() < 0.7 else np.inf
        size = rng.choice([0, 1e-9, 1e-6, 1e-3, 0.1, 1])
        self.x0 = size * rng.normal(size=self.nx)
        self.horizon = int(rng.choice([2, 3, 10, 30, 100], p=[0.1, 0.25, 0.4, 0.2, 0.05]))
        self.limited = rng.random() < 0.5
        self.H = rng.normal(size=(2, self.nx + self.nu))
        self.H[0, self.nx :] = 0
        self.h = 1.2 * np.abs(self.H[:, : self.nx] @ self.x0) + 0.1
        self.y_r = rng.choice([0, 1e-6, 0.1, 1]) * rng.normal(size=self.nu)
        self.sx, self.su, self.sy = (
            10 ** rng.uniform(-9, 9, size) for size in (self.nx, self.nu, self.nu)
        )
        self.c = 10 ** rng.uniform(-9, 9)

    def plain(self, h=None):
        return self._made(np.ones(self.nx), np.ones(self.nu), np.ones(self.nu), 1.0, h)

    def scaled(self, h=None):
        return self._made(self.sx, self.su, self.sy, self.c, h)

    def _made(self, sx, su, sy, c, h):
        system = LinearSystem(
            self.A * sx[:, None] / sx, self.B * sx[:, None] / su, sy[:, None] * self.C / sx,
            dt=1, u_min=-self.u_max * su, u_max=self.u_max * su,
        )  # fmt: skip
        cost = QuadraticCost(c * self.Q / sx / sx[:, None], c * self.R / su / su[:, None])
        H = self.H / np.concatenate([sx, su])
        return system, cost, Polyhedron(H, self.h if h is None else h) if self.limited else None


def near(value, wanted):
    return np.abs(value - wanted).max() <= CLOSE * np.abs(wanted).max()


@pytest.mark.parametrize(("kind", "cases"), [(LinearMPC, 220), (ConvexMPC, 50)])
def test_plans_are_the_same_plans(kind, cases):
    solved, failed = 0, 0
    for seed in range(cases):
        case = Case(seed)
        answers = [
            kind(system, cost, case.horizon, constraints=Z).solve(x0)
            for (system, cost, Z), x0 in (
                (case.plain(), case.x0),
                (case.scaled(), case.x0 * case.sx),
            )
        ]
        plain, scaled = answers
        assert scaled.status == plain.status
        # What no plan can be told from is another verdict, see test_trusted_plans.
        failed += plain.status == "failed" and "always leave a plan" not in plain.message
        if plain.success:
            solved += 1
            assert near(scaled.trajectory.u / case.su, plain.trajectory.u)
            assert near(scaled.trajectory.x / case.sx, plain.trajectory.x)
            assert scaled.cost / case.c == pytest.approx(plain.cost, rel=CLOSE)
            assert (case.x0 == 0).all() or plain.trajectory.x.any()
    assert solved > 0.9 * cases
    # Unstable plants that the inputs cannot hold: over 30 steps σ grows to 1e13 times its start.
    assert failed <= 0.01 * cases


def test_a_plan_is_in_proportion_to_a_small_state():
    # Limits that are not met have no say: without them the plan is linear in x_0.
    for seed in range(20):
        case = Case(seed)
        system, cost, Z = case.scaled()
        x0 = np.random.default_rng(seed).normal(size=case.nx) * case.sx
        free = LinearSystem(system.A, system.B, dt=1)
        whole = LinearMPC(free, cost, case.horizon).solve(x0)
        for share in (1e-4, 1e-9, 1e-30):
            part = LinearMPC(system, cost, case.horizon, constraints=Z).solve(share * x0)
            assert part.success
            if share < 1e-4:
                unit = whole.trajectory.u / case.su * share
                assert near(part.trajectory.u / case.su, unit)


def test_terminal_ingredients_are_the_same():
    for seed in range(60):
        case = Case(seed, largest=5)
        (system, cost, Z), (other, weighed, also) = case.plain(), case.scaled()
        end = terminal_ingredients(system, cost, constraints=Z)
        scaled = terminal_ingredients(other, weighed, constraints=also)
        assert near(scaled.K * case.sx / case.su[:, None], end.K)
        assert near(scaled.P * case.sx * case.sx[:, None] / case.c, end.P)
        if len(end.polyhedron.h):
            assert scaled.ellipsoid.level / case.c == pytest.approx(end.ellipsoid.level, rel=CLOSE)
            x = np.random.default_rng(seed).normal(size=(20, case.nx))
            edge, same = (
                (states @ sets.polyhedron.H.T / sets.polyhedron.h).max(axis=1)
                for states, sets in ((x, end), (x * case.sx, scaled))
            )
            assert near(same, edge)


def test_stability_is_the_same_question():
    answers = []
    for seed in range(50):
        case = Case(seed, largest=5)
        h = np.array([-0.2, 0.5]) if seed % 2 else None
        (system, cost, Z), (other, weighed, also) = case.plain(h), case.scaled(h)
        check = check_stability(system, cost, constraints=Z)
        scaled = check_stability(other, weighed, constraints=also)
        assert scaled.stable == check.stable
        answers.append(check.stable)
        if check.stable:
            z, same = (np.concatenate([c.x, c.u]) for c in (check, scaled))
            assert near(same / np.concatenate([case.sx, case.su]), z)
            assert near(scaled.multiplier * case.sx / case.c, check.multiplier)
            assert scaled.stage_cost / case.c == pytest.approx(check.stage_cost, rel=CLOSE)
    assert sum(answers) > 30


def test_set_points_are_the_same():
    reached = 0
    for seed in range(80):
        case = Case(seed)
        (system, _, Z), (other, _, also) = case.plain(), case.scaled()
        try:
            held = steady_state(system, case.y_r, constraints=Z)
        except ValueError:
            with pytest.raises(ValueError, match="outside of the constraints"):
                steady_state(other, case.y_r * case.sy, constraints=also)
        else:
            reached += 1
            scaled = steady_state(other, case.y_r * case.sy, constraints=also)
            assert near(held.y, case.y_r)
            assert near(scaled.u / case.su, held.u)
            assert near(scaled.x / case.sx, held.x)
    assert reached > 40
