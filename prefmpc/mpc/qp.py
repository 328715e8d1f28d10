"""Linear MPC with a quadratic σ as a sparse quadratic program for OSQP; Clarabel stands by."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import positive_int, single
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc._cone import PROVEN, SOLVED, TIGHT, ConeProgram, ConeSolution
from prefmpc.mpc._refine import Refiner
from prefmpc.mpc._stages import Bounds, StageProgram
from prefmpc.mpc._turns import Turns
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    Outcome,
    check_problem,
    check_single_state,
    explained,
    fixed_message,
    mpc_solution,
)
from prefmpc.mpc.steady import SteadyState, check_reference, with_reference
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Ellipsoid, Polyhedron

# Polishing makes of this the exact answer; what is handed out is judged by its own residual.
_SETTINGS = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "eps_prim_inf": 1e-8,
    "polishing": True,
    "max_iter": 20_000,
    "check_termination": 10,
    "verbose": False,
}

GOOD = 1e-9
"""A residual with which nobody needs to try for a better one."""


class LinearMPC(Turns, Controller):
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
        assert not isinstance(last, Ellipsoid)
        self._ingredients = final is not None
        self._limited = constraints is not None or last is not None
        weights = np.asarray(cost.Q), np.asarray(cost.R)
        self._program = StageProgram(system, weights, self.horizon, constraints, last, final)
        super().__init__()
        self._backup: ConeProgram | None = None
        self._refine: Refiner | None = None

    def solve(self, x0: ArrayLike, *, reference: SteadyState | None = None) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0.

        With a ``reference`` σ sees deviations from it; the sets stay where they are. Several
        threads may use the same controller; they take turns.
        """
        program = self._program
        x0 = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        if reference is not None:
            check_reference(reference, self.system, self._constraints, self._ingredients)
        if program.fixed.broken(x0):
            outcome = Outcome("infeasible", fixed_message(x0))
            return mpc_solution(self.system, self.horizon, outcome, began)
        bounds = program.bounds(x0, reference)
        with self._lock:
            found = self._solved(bounds)
        z = found.z * bounds.unit
        cost = program.objective(z) if found.status == "solved" else np.nan
        if bounds.origin is not None:
            z = z + bounds.origin
        states, inputs = program.split(z)
        plan = states * program.dx, inputs * program.du
        outcome = explained(found, x0, self.horizon, limited=self._limited)
        solution = mpc_solution(self.system, self.horizon, outcome, began, plan, cost)
        return with_reference(solution, reference)

    def _solved(self, bounds: Bounds) -> ConeSolution:
        """Return OSQP's answer if it can be trusted, else Clarabel's."""
        first = self._by_osqp(bounds)
        if first.status == "infeasible" or first.residual <= GOOD:
            return first
        second = self._by_clarabel(bounds, first.iterations)
        # What is nearly as good as wanted will do where nobody does better.
        return first if first.residual <= SOLVED and not second.residual <= GOOD else second

    def _by_osqp(self, bounds: Bounds) -> ConeSolution:
        import osqp

        program = self._program
        if self._solver is None:
            self._solver = osqp.OSQP()
            self._solver.setup(
                sp.triu(program.P, format="csc"),  # a lower triangle it would read wrongly
                np.zeros(program.rows.shape[1]),
                program.rows,
                bounds.lower,
                bounds.upper,
                **_SETTINGS,
            )
        else:
            self._solver.update(l=bounds.lower, u=bounds.upper)
        result = self._solver.solve(raise_error=False)
        code, z, y = result.info.status_val, np.array(result.x), np.array(result.y)
        status, message, residual = "unfinished", "OSQP did not finish", np.nan
        if code == osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
            residual = program.doubt(bounds, np.array(result.prim_inf_cert))
            status = "infeasible" if residual <= PROVEN else status
        elif code == osqp.SolverStatus.OSQP_SOLVED:
            z, y, residual = self._improved(bounds, z, y)
            status, message = ("solved", "optimal") if residual <= SOLVED else (status, message)
        return ConeSolution(z, y, np.nan, status, message, int(result.info.iter), residual)

    def _improved(
        self, bounds: Bounds, z: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return a point, better than the one given if that is not exact, and its residual."""
        program = self._program
        residual = program.residual(bounds, z, y)
        if residual <= GOOD or not (np.isfinite(z).all() and np.isfinite(y).all()):
            return z, y, residual
        if self._refine is None:
            self._refine = Refiner(program.P, program.rows)
        better = self._refine(np.zeros(len(z)), bounds.lower, bounds.upper, z, y)
        less = program.residual(bounds, *better)
        return (*better, less) if less < residual else (z, y, residual)

    def _by_clarabel(self, bounds: Bounds, iterations: int) -> ConeSolution:
        """Solve what OSQP gave up on: problems with hardly any room, as a rule."""
        program, lower, upper = self._program, bounds.lower, bounds.upper
        # A z = b, then A z ≤ upper, then −A z ≤ −lower, where these are finite.
        equal = np.arange(len(lower)) < program.equations
        above, below = (~equal & np.isfinite(bound) for bound in (upper, lower))
        if self._backup is None:
            by_rows = program.rows.tocsr()
            rows = sp.vstack([by_rows[equal], by_rows[above], -by_rows[below]])
            cones = [("zero", program.equations), ("nonnegative", int(above.sum() + below.sum()))]
            nothing = np.zeros(rows.shape[1]), np.zeros(rows.shape[0])
            self._backup = ConeProgram(program.P, nothing[0], rows, nothing[1], cones, TIGHT)
        found = self._backup.solve(np.concatenate([upper[equal], upper[above], -lower[below]]))
        y, at = np.zeros(len(lower)), np.cumsum([equal.sum(), above.sum()])
        y[equal], y[above], under = np.split(found.y, at)
        y[below] -= under
        note = f"by Clarabel after OSQP stopped at {iterations} iterations"
        if found.status != "solved":
            return dataclasses.replace(found, y=y, message=f"{found.message}, {note}")
        z, y, residual = self._improved(bounds, found.z, y)
        status, message = "solved", f"optimal, {note}"
        if not residual <= SOLVED:
            status = "failed"
            message = f"the optimality conditions are missed by {residual:.1e}, {note}"
        return dataclasses.replace(
            found, z=z, y=y, status=status, message=message, residual=residual
        )
