"""Linear MPC with a quadratic σ as a sparse quadratic program for OSQP; Clarabel stands by."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import positive_int, single
from prefmpc.models import QuadraticCost
from prefmpc.mpc._cone import TIGHT, ConeProgram, ConeSolution, mpc_solution
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    check_problem,
    check_single_state,
)
from prefmpc.mpc.steady import SteadyState, check_reference, with_reference
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.sets import Polyhedron
from prefmpc.systems import LinearSystem

# OSQP's own default of 1e-3 leaves inputs off by 4e-3.
_SETTINGS = {
    "eps_abs": 1e-7,
    "eps_rel": 1e-7,
    "eps_prim_inf": 1e-8,
    "polishing": True,
    "max_iter": 20_000,
    "verbose": False,
}


class LinearMPC(Controller):
    """The controller min σ(T) s.t. x_0 = x(t), the dynamics, (x_k, u_k) ∈ Z, x_N ∈ X_N.

    Implements eq. (7) of arXiv 2511.22502 for a linear plant, polyhedral sets and quadratic σ;
    with input bounds alone this is eq. (12). The problem is set up once; each solve only changes
    the initial state. OSQP solves it, warm; Clarabel solves what OSQP does not finish.

    Parameters
    ----------
    system : LinearSystem
        Its input bounds are part of Z.
    cost : QuadraticCost
        σ. It does not weigh x_N, so that the last input of T* is 0 if it may be.
    horizon : int
        N ≥ 1.
    constraints : Polyhedron, optional
        Over the stacked (x_k, u_k), dimension nx + nu, for k = 0 … N−1.
    terminal : Polyhedron or TerminalIngredients, optional
        X_N, of dimension nx; or the ingredients of `terminal_ingredients`: their polyhedron is
        X_N, and x_NᵀPx_N is added to the cost.

    Raises
    ------
    ValueError
        If the horizon is below 1, or a dimension does not fit.
    """

    def __init__(
        self,
        system: LinearSystem,
        cost: QuadraticCost,
        horizon: int,
        *,
        constraints: Polyhedron | None = None,
        terminal: Polyhedron | TerminalIngredients | None = None,
    ) -> None:
        check_problem(system, cost)
        for name, part in {"system": system, "cost": cost}.items():
            single(name, part, "; BatchedMPC takes stacks")
        self.system = system
        self.cost = cost
        self.horizon = positive_int("horizon", horizon)
        check_polyhedron("constraints", constraints, system.nx + system.nu)
        self._constraints = constraints
        final, last = terminal_set(terminal, system.nx)
        self._ingredients = final is not None
        self._build(constraints, last, np.zeros((system.nx,) * 2) if final is None else final)

    def _build(self, constraints: Polyhedron | None, terminal: Any, final: np.ndarray) -> None:
        import osqp

        system, N = self.system, self.horizon
        nx, nu = system.nx, system.nu
        # Decision vector: x_0 … x_N, then u_0 … u_{N−1}.
        states, inputs = nx * (N + 1), nu * N
        weights = [sp.kron(sp.eye(N), 2 * np.asarray(self.cost.Q)), sp.csc_matrix(2 * final)]
        P = sp.block_diag([*weights, sp.kron(sp.eye(N), 2 * np.asarray(self.cost.R))])
        dynamics = sp.kron(sp.eye(N + 1), -sp.eye(nx)) + sp.kron(sp.eye(N + 1, k=-1), system.A)
        forcing = sp.vstack([sp.csc_matrix((nx, inputs)), sp.kron(sp.eye(N), system.B)])
        rows = [sp.hstack([dynamics, forcing])]
        lower, upper = [np.zeros(states)], [np.zeros(states)]
        bounded = np.tile(np.isfinite(system.u_min) | np.isfinite(system.u_max), N)
        box = sp.hstack([sp.csc_matrix((inputs, states)), sp.eye(inputs)]).tocsr()
        rows.append(box[bounded])
        lower.append(np.tile(system.u_min, N)[bounded])
        upper.append(np.tile(system.u_max, N)[bounded])
        if constraints is not None:
            Hx, Hu = constraints.H[:, :nx], constraints.H[:, nx:]
            stages = sp.hstack([sp.eye(N), sp.csc_matrix((N, 1))])
            rows.append(sp.hstack([sp.kron(stages, Hx), sp.kron(sp.eye(N), Hu)]))
            lower.append(np.full(N * len(constraints.h), -np.inf))
            upper.append(np.tile(constraints.h, N))
        if terminal is not None:
            last = sp.csc_matrix(np.eye(N + 1)[-1:])
            rows.append(
                sp.hstack([sp.kron(last, terminal.H), sp.csc_matrix((len(terminal.h), inputs))])
            )
            lower.append(np.full(len(terminal.h), -np.inf))
            upper.append(terminal.h)
        self._rows = sp.vstack(rows, format="csc")
        self._open = np.concatenate(lower), np.concatenate(upper)
        self._lower, self._upper = self._open
        self._P = sp.triu(P, format="csc")
        self._backup: ConeProgram | None = None
        self._solver = osqp.OSQP()
        self._solver.setup(
            self._P,  # OSQP reads a lower triangle without complaint, and wrongly
            np.zeros(states + inputs),
            self._rows,
            self._lower,
            self._upper,
            **_SETTINGS,
        )

    def solve(self, x0: ArrayLike, *, reference: SteadyState | None = None) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0.

        With a ``reference`` σ sees deviations from it; the sets stay where they are.
        """
        x0 = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        self._lower, self._upper = (bound.copy() for bound in self._open)
        self._lower[: x0.size] = self._upper[: x0.size] = -x0
        self._origin = np.zeros(self._rows.shape[1])
        if reference is not None:
            check_reference(reference, self.system, self._constraints, self._ingredients)
            N = self.horizon
            self._origin = np.concatenate([np.tile(reference.x, N + 1), np.tile(reference.u, N)])
            # Unknown are the deviations: what they leave of every limit.
            shift = self._rows @ self._origin
            self._lower, self._upper = self._lower - shift, self._upper - shift
        self._solver.update(l=self._lower, u=self._upper)
        result = self._solver.solve(raise_error=False)
        solution = self._solution(x0, result, began)
        return with_reference(solution, reference)

    def _by_interior_point(self, iterations: int) -> ConeSolution:
        """Solve with Clarabel what OSQP gave up on: problems with hardly any room, as a rule."""
        import clarabel

        if self._backup is None:
            same = self._open[0] == self._open[1]
            # A z = b, then A z ≤ upper, then −A z ≤ −lower, where these are finite.
            low, high = (np.isfinite(bound) for bound in self._open)
            self._split = same, ~same & high, ~same & low
            equal, above, below = (self._rows.tocsr()[part] for part in self._split)
            rows = sp.vstack([equal, above, -below])
            cones = [
                clarabel.ZeroConeT(equal.shape[0]),
                clarabel.NonnegativeConeT(above.shape[0] + below.shape[0]),
            ]
            nothing = np.zeros(rows.shape[1])
            self._backup = ConeProgram(
                self._P, nothing, rows, self._right_hand_side(), cones, TIGHT
            )
        found = self._backup.solve(self._right_hand_side())
        note = f"{found.message}, by Clarabel after OSQP stopped at {iterations} iterations"
        return dataclasses.replace(found, message=note)

    def _right_hand_side(self) -> np.ndarray:
        same, above, below = self._split
        return np.concatenate([self._upper[same], self._upper[above], -self._lower[below]])

    def _solution(self, x0: np.ndarray, result: Any, began: float) -> MPCSolution:
        import osqp

        N, nx, nu = self.horizon, self.system.nx, self.system.nu
        found = ConeSolution(
            z=np.asarray(result.x),
            objective=float(result.info.obj_val),
            status={
                osqp.SolverStatus.OSQP_SOLVED: "solved",
                osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: "infeasible",
            }.get(result.info.status_val, "unfinished"),
            message="optimal",
            iterations=int(result.info.iter),
            residual=max(float(result.info.prim_res), float(result.info.dual_res)),
        )
        finished = found.status == "infeasible" or np.isfinite(found.z).all()
        if found.status == "unfinished" or not finished:
            found = self._by_interior_point(found.iterations)
        size = nx * (N + 1) + nu * N
        solved = found.status == "solved"
        plan = found.z + self._origin if solved else np.full(size, np.nan)
        states, inputs = plan[: nx * (N + 1)], plan[nx * (N + 1) :]
        return mpc_solution(
            self.system, x0, states.reshape(-1, nx), inputs.reshape(-1, nu), found, began
        )
