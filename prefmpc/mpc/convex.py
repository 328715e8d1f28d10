"""MPC with any convex σ and convex constraint sets: a cone program through cvxpy and Clarabel."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import instance, positive_int, single
from prefmpc.models import QuadraticCost, SumCost
from prefmpc.mpc._cone import ParametricProgram, expression, mpc_solution, stage_limits
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    check_dimension,
    check_single_state,
)
from prefmpc.mpc.stability import StabilityCheck
from prefmpc.mpc.terminal import TerminalIngredients, terminal_set
from prefmpc.networks import ICNNCost
from prefmpc.sets import Ellipsoid, Polyhedron, SecondOrderCone
from prefmpc.systems import LinearSystem


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
        import cvxpy

        cp: Any = cvxpy
        instance("system", system, LinearSystem)
        single("system", system, "; BatchedMPC takes stacks")
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        nx, nu, N = system.nx, system.nu, self.horizon
        x0 = cp.Parameter(nx)
        X, U = cp.Variable((N + 1, nx)), cp.Variable((N, nu))
        total = expression(cp, cost, X[:-1], U)
        limits = [
            X[0] == x0,
            X[1:] == X[:-1] @ system.A.T + U @ system.B.T,
            *stage_limits(cp, system, constraints, output_cones, X[:-1], U),
        ]
        if isinstance(terminal, StabilityCheck):
            if not terminal.stable:
                raise ValueError(f"terminal must be a check that says yes, got: {terminal.reason}")
            check_dimension("terminal", terminal.x.size, nx)
            limits.append(X[N] == terminal.x)
            terminal = None
        final, last = terminal_set(terminal, nx, ellipsoid=True)
        if final is not None:
            total += cp.sum_squares(np.linalg.cholesky(final).T @ X[N])
        if isinstance(last, Ellipsoid):
            root = np.linalg.cholesky(last.P).T
            limits.append(cp.norm(root @ X[N], 2) <= np.sqrt(last.level))
        elif last is not None and len(last.h):
            limits.append(last.H @ X[N] <= last.h)
        self._program = ParametricProgram(cp.Problem(cp.Minimize(total), limits), x0, (X, U))

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0."""
        state = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        found, (states, inputs) = self._program.solve(state)
        return mpc_solution(self.system, state, states, inputs, found, began)
