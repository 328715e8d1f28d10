"""MPC with any convex σ and convex constraint sets: a cone program through cvxpy and Clarabel."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import instance, positive_int, single
from prefmpc._units import cost_units, free_response, matters
from prefmpc.models.networks import ICNNCost
from prefmpc.models.quadratic import QuadraticCost, SumCost
from prefmpc.mpc._expressions import (
    check_cones,
    check_convex,
    expression,
    factor,
    quadratic,
    stage_limits,
    weights,
)
from prefmpc.mpc._fixed import FixedCone, FixedRows
from prefmpc.mpc._limits import per_unit
from prefmpc.mpc._parametric import ParametricProgram
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    Outcome,
    check_dimension,
    check_single_state,
    explained,
    fixed_message,
    mpc_solution,
)
from prefmpc.mpc.stability import StabilityCheck
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Ellipsoid, Polyhedron, SecondOrderCone


class ConvexMPC(Controller):
    """The controller min σ(T) s.t. x_0 = x(t), the dynamics, (x_k, u_k) ∈ Z, x_N ∈ X_N.

    Implements eq. (7) of arXiv 2511.22502 for a linear plant, convex sets and any convex σ: a
    quadratic one, an input-convex network (its layers written as z ≥ g(·), which is exact since
    σ grows with each z), and sums of these. The problem is set up once; each solve only changes
    the initial state.

    Parameters
    ----------
    system : LinearSystem
        Its input bounds are part of Z.
    cost : QuadraticCost, ICNNCost or SumCost of these
        A single model.
    horizon : int
        N ≥ 1.
    constraints : Polyhedron, optional
        Over the stacked (x_k, u_k), for k = 0 … N−1.
    output_cones : sequence of SecondOrderCone, optional
        Over y_k, for k = 0 … N−1.
    terminal : Polyhedron, Ellipsoid, TerminalIngredients or StabilityCheck, optional
        X_N; or the ingredients, whose polyhedron is X_N and whose x_NᵀPx_N is added to the cost;
        or a check that says yes, whose steady state is the one point of X_N.

    Raises
    ------
    ValueError
        If σ is not one of the convex models, a weight makes it not convex, or a dimension does
        not fit.
    """

    def __init__(
        self,
        system: LinearSystem,
        cost: QuadraticCost | ICNNCost | SumCost,
        horizon: int,
        *,
        constraints: Polyhedron | None = None,
        output_cones: Sequence[SecondOrderCone] = (),
        terminal: Polyhedron | Ellipsoid | TerminalIngredients | StabilityCheck | None = None,
    ) -> None:
        instance("system", system, LinearSystem)
        single("system", system, "; BatchedMPC takes stacks")
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        check_convex(cost, system.nx, system.nu, self.horizon)
        check_polyhedron("constraints", constraints, system.nx + system.nu)
        check_cones(system, output_cones)
        point = None
        if isinstance(terminal, StabilityCheck):
            if not terminal.stable:
                raise ValueError(f"terminal must be a check that says yes, got: {terminal.reason}")
            check_dimension("terminal", terminal.x.size, system.nx)
            point, terminal = terminal.x, None
        final, last = terminal_set(terminal, system.nx, ellipsoid=True)
        end = last if isinstance(last, Polyhedron) else None
        self._rows = FixedRows(system, self.horizon, constraints, end)
        self._cones = [FixedCone(system, self.horizon, cone) for cone in output_cones]
        sets = constraints, last, point
        self._limited = bool(self._cones) or any(part is not None for part in sets)
        weighing = weights(cost, system.nx, system.nu)
        self._units = cost_units(system.A, system.B, *weighing, final=final, steps=self.horizon)
        self._build(constraints, output_cones, final, last, point)

    def _build(
        self, constraints: Any, output_cones: Any, final: Any, last: Any, point: Any
    ) -> None:
        """Set up the program in units in which the signals, and σ, are of order one."""
        import cvxpy

        cp: Any = cvxpy
        system, N, (dx, du) = self.system, self.horizon, self._units
        x0 = cp.Parameter(system.nx)
        X, U = cp.Variable((N + 1, system.nx)), cp.Variable((N, system.nu))
        A, B = system.A * dx / dx[:, None], system.B * du / dx[:, None]
        # What σ does not see, such as a position far away, is set aside with what becomes of it.
        aside = self._unseen(final)
        self._aside = bool(aside.any())
        self._drift = free_response(A, np.diag(aside.astype(float)), N)
        whole = X + cp.vstack([power @ x0 for power in self._drift]) if self._aside else X
        states = cp.multiply(X, np.tile(dx, (N + 1, 1)))
        inputs = cp.multiply(U, np.tile(du, (N, 1)))
        total = expression(cp, self.cost, states[:-1], inputs)
        rows, left_out = self._rows, (self._rows.stage, [cone.stage for cone in self._cones])
        limits = [
            X[0] == cp.multiply(np.where(aside, 0.0, 1.0), x0),
            X[1:] == X[:-1] @ A.T + U @ B.T,
            *stage_limits(
                cp, system, constraints, output_cones, (whole[:-1], U), self._units, left_out
            ),
        ]
        if point is not None:
            limits.append(whole[N] == point / dx)
        if final is not None:
            total += cp.sum_squares(factor(final).T @ states[N])
        if isinstance(last, Ellipsoid):
            root = factor(last.P).T * dx / np.sqrt(last.level)
            size = np.abs(root).max()
            limits.append(cp.norm(root / size @ whole[N], 2) <= 1 / size)
        elif last is not None and not rows.last.all():
            H, h = per_unit(last.H[~rows.last] * dx, last.h[~rows.last])
            limits.append(H @ whole[N] <= h)
        self._program = ParametricProgram(cp.Problem(cp.Minimize(total), limits), x0, (X, U))

    def _unseen(self, final: np.ndarray | None) -> np.ndarray:
        """Say which states a quadratic σ does not see; a network may see all."""
        if not quadratic(self.cost):
            return np.zeros(self.system.nx, dtype=bool)
        Q = weights(self.cost, self.system.nx, self.system.nu)[0]
        return ~matters(self.system.A, Q if final is None else Q + final)

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0.

        Several threads may use the same controller; they take turns.
        """
        state = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        if self._rows.broken(state) or any(cone.broken(state) for cone in self._cones):
            outcome = Outcome("infeasible", fixed_message(state))
            return mpc_solution(self.system, self.horizon, outcome, began)
        dx, du = self._units
        found, (states, inputs) = self._program.solve(state / dx)
        if self._aside:
            states = states + self._drift @ (state / dx)
        plan = states * dx, inputs * du
        outcome = explained(found, state, self.horizon, limited=self._limited)
        return mpc_solution(self.system, self.horizon, outcome, began, plan, found.objective)
