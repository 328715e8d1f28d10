"""Linear MPC with a quadratic σ as a sparse quadratic program for OSQP; Clarabel stands by."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, positive_int, shaped, single
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc._cone import PROVEN, SOLVED, TIGHT, ConeProgram, ConeSolution
from prefmpc.mpc._options import OptionProgram, Options
from prefmpc.mpc._refine import Refiner
from prefmpc.mpc._stages import Bounds, StageProgram, pushed_states
from prefmpc.mpc._stored import restored, stored
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
from prefmpc.preferences.trajectories import Trajectory
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

RESTORED = ("constraints", "terminal", "soft", "soft_quadratic", "max_increment", "blocks")
"""What a stored controller may have or not."""

KEPT = 1e-9
"""A soft row is kept to within this share of the size of its terms."""


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
    soft : float or array (m,), optional
        Rows of ``constraints`` may be broken, and breaking one by s ≥ 0 (in its own unit) costs
        soft·s + soft_quadratic·s² at every stage; inf keeps a row hard. Where there is a plan that
        breaks none, and ``soft`` exceeds the multipliers of the rows, that plan is the optimum.
    soft_quadratic : float or array (m,)
    max_increment : float or array (nu,), optional
        Largest size of u_k − u_{k−1}.
    blocks : sequence of int, optional
        Lengths, N in all, of the parts of the horizon within which the input is held.

    Raises
    ------
    ValueError
        If the horizon is below 1, a dimension does not fit, or a weight is not positive.
    """

    def __init__(
        self,
        system: LinearSystem,
        cost: QuadraticCost,
        horizon: int,
        *,
        constraints: Polyhedron | None = None,
        terminal: Polyhedron | TerminalIngredients | None = None,
        soft: ArrayLike | None = None,
        soft_quadratic: ArrayLike = 0.0,
        max_increment: ArrayLike | None = None,
        blocks: Sequence[int] | None = None,
    ) -> None:
        check_problem(system, cost)
        for name, part in {"system": system, "cost": cost}.items():
            single(name, part, "; BatchedMPC takes stacks")
        self.system = system
        self.cost = cost
        self.horizon = positive_int("horizon", horizon)
        check_polyhedron("constraints", constraints, system.nx + system.nu)
        self._constraints, self._terminal = constraints, terminal
        final, last = terminal_set(terminal, system.nx)
        assert not isinstance(last, Ellipsoid)
        self._ingredients = final is not None
        self._limited = constraints is not None or last is not None
        weights = np.asarray(cost.Q), np.asarray(cost.R)
        parts = system, weights, self.horizon, constraints, last, final
        asked = soft, soft_quadratic, max_increment, blocks
        self._options = Options.of(system, self.horizon, constraints, *asked)
        self._program = (
            StageProgram(*parts) if self._options is None else OptionProgram(*parts, self._options)
        )
        self._hard = constraints
        if self._options is not None and self._options.soft is not None and constraints is not None:
            kept = ~np.isfinite(self._options.soft)
            self._hard = Polyhedron(constraints.H[kept], constraints.h[kept])
        self._applied: np.ndarray | None = None
        super().__init__()
        self._backup: ConeProgram | None = None
        self._refine: Refiner | None = None

    def to_json(self) -> str:
        """Return the controller as JSON, see `from_json`; infinite numbers are null there."""
        rest: dict[str, Any] = {"horizon": self.horizon}
        rest |= {"constraints": self._constraints, "terminal": self._terminal}
        if (options := self._options) is not None:
            rest |= {"soft": options.soft, "max_increment": options.increment}
            rest["soft_quadratic"] = 0.0 if options.curved is None else options.curved
            rest["blocks"] = np.diff(np.flatnonzero(np.append(~options.same, True))).tolist()
        return stored(self.system, self.cost, rest)

    @classmethod
    def from_json(cls, text: str) -> LinearMPC:
        """Return the controller that `to_json` wrote. A ValueError names the field that is wrong.

        Nothing but numbers is read: no code can come in this way.
        """
        return cls(**restored(text, RESTORED))

    def reset(self) -> None:
        """Forget the last input, where increments are limited."""
        self._applied = None

    def applied(self, u: np.ndarray) -> None:
        """Take note of an input that the plant received: the next increment starts there."""
        self._applied = np.asarray(u)

    def solve(
        self,
        x0: ArrayLike,
        *,
        reference: SteadyState | Trajectory | None = None,
        disturbance: ArrayLike | None = None,
        u_before: ArrayLike | None = None,
    ) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on bad input.

        Several threads may use the same controller; they take turns.

        Parameters
        ----------
        x0 : array (nx,)
        reference : SteadyState or Trajectory, optional
            σ sees deviations from it; the sets stay where they are. A trajectory of N steps is
            where x and u should be from now on; it need not obey the plant.
        disturbance : array (nx,) or (N, nx), optional
            What is added to the next state, x_{k+1} = A x_k + B u_k + d_k: held, or stage by stage.
            A steady state to refer to must be one under the last of these.
        u_before : array (nu,), optional
            The input before, for ``max_increment``. Default: the last that a call returned; where
            none is known, the first increment is free.
        """
        program = self._program
        x0 = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        push, before = self._given(disturbance, u_before)
        held = self._followed(reference, push)
        pushed = None if push is None else pushed_states(self.system.A, push)
        if program.fixed.broken(x0, pushed):
            outcome = Outcome("infeasible", fixed_message(x0))
            return mpc_solution(self.system, self.horizon, outcome, began)
        limits = program.limited(before) if isinstance(program, OptionProgram) else None
        bounds = program.bounds(x0, reference, push, limits)
        with self._lock:
            found = self._solved(bounds)
        z = found.z * bounds.unit
        cost = program.objective(z) if found.status == "solved" else np.nan
        if bounds.origin is not None:
            z = z[: len(bounds.origin)] + bounds.origin
        states, inputs = program.split(z)
        plan = states * program.dx, inputs * program.du
        outcome = explained(found, x0, self.horizon, limited=self._limited)
        solution = mpc_solution(self.system, self.horizon, outcome, began, plan, cost)
        if self._options is not None and self._options.soft is not None:
            solution = dataclasses.replace(solution, broken=self._broken(solution.trajectory))
        return with_reference(solution, held)

    def _given(
        self, disturbance: ArrayLike | None, u_before: ArrayLike | None
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the disturbance (N, nx) and the input before (nu,), None if there is none."""
        nx, nu, push, before = self.system.nx, self.system.nu, None, self._applied
        if disturbance is not None:
            push = np.asarray(finite_array("disturbance", disturbance))
            if push.shape not in ((nx,), (self.horizon, nx)):
                raise ValueError(
                    f"disturbance must have shape ({nx},) or ({self.horizon}, {nx}), "
                    f"got {push.shape}"
                )
            push = np.broadcast_to(push, (self.horizon, nx))
        if u_before is not None:
            before = np.asarray(finite_array("u_before", u_before, ndim=1))
            shaped("u_before", before, (nu,), "the system's inputs")
        return push, before

    def _followed(
        self, reference: SteadyState | Trajectory | None, push: np.ndarray | None
    ) -> SteadyState | None:
        """Return the reference if it is a steady state. Raises a ValueError if it does not fit."""
        if not isinstance(reference, Trajectory):
            if reference is not None:
                sets, end = self._hard, self._ingredients
                last = None if push is None else push[-1]
                check_reference(reference, self.system, sets, end, last)
            return reference
        if self._ingredients:
            raise ValueError("reference must be None with TerminalIngredients, made for the origin")
        N, nx, nu = self.horizon, self.system.nx, self.system.nu
        for name, values, size in (("x", reference.x, (N + 1, nx)), ("u", reference.u, (N, nu))):
            if np.shape(values) != size or not np.isfinite(values).all():
                raise ValueError(f"reference.{name} must be finite and have shape {size}")
        return None

    def _broken(self, plan: Trajectory) -> np.ndarray:
        """Return by how much soft rows are broken along a plan, (N, m)."""
        Z = self._constraints
        assert Z is not None
        assert self._options is not None
        assert self._options.soft is not None
        z = np.concatenate([plan.x[:-1], plan.u], axis=1)
        beyond = z @ Z.H.T - Z.h
        room = KEPT * np.maximum(np.abs(Z.h), np.abs(z) @ np.abs(Z.H).T)
        counts = np.isfinite(self._options.soft) & ~(beyond <= room)
        return np.where(counts, beyond, 0.0)

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
                _linear(bounds, program.rows.shape[1]),
                program.rows,
                bounds.lower,
                bounds.upper,
                **_SETTINGS,
            )
        else:
            self._solver.update(q=bounds.q, l=bounds.lower, u=bounds.upper)
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
        better = self._refine(_linear(bounds, len(z)), bounds.lower, bounds.upper, z, y)
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
            q = np.zeros(rows.shape[1]) if bounds.q is None else bounds.q * bounds.unit
            self._backup = ConeProgram(program.P, q, rows, np.zeros(rows.shape[0]), cones, TIGHT)
        b = np.concatenate([upper[equal], upper[above], -lower[below]])
        # With a linear cost it has one for the unit 1, and finds a unit of its own.
        unit = 1.0 if bounds.q is None else bounds.unit
        found = self._backup.solve(b * unit)
        found = dataclasses.replace(found, z=found.z / unit, y=found.y / unit)
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


def _linear(bounds: Bounds, size: int) -> np.ndarray:
    return np.zeros(size) if bounds.q is None else bounds.q
