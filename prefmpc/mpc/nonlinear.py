"""MPC for nonlinear plants and any differentiable σ: single shooting with exact derivatives."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    choice,
    finite_array,
    instance,
    nonnegative,
    positive_int,
    shaped,
    single,
    traced,
)
from prefmpc._pytree import bypass_init
from prefmpc.models.quadratic import CostModel, check_model
from prefmpc.mpc import _shooting as shooting
from prefmpc.mpc._limits import ON_LIMIT
from prefmpc.mpc._newton import attempt, least_violation
from prefmpc.mpc._nlp import Attempt, Program, promising, remembered
from prefmpc.mpc._shooting import Given, Known, Problem
from prefmpc.mpc._turns import Turns
from prefmpc.mpc._units import Units, own_units
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    Outcome,
    check_single_state,
    infeasible_message,
    mpc_solution,
)
from prefmpc.mpc.steady import SteadyState, check_reference, with_reference
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import System
from prefmpc.systems.nonlinear import traced_shape
from prefmpc.systems.sets import Ellipsoid, Polyhedron

Solver = Literal["newton"]


class NonlinearMPC(Turns, Controller):
    """The controller min σ(T) s.t. x_0 = x(t), x_{k+1} = f(x_k, u_k), (x_k, u_k) ∈ Z, x_N ∈ X_N.

    Implements eq. (7) of arXiv 2511.22502 for any plant and any differentiable σ. The inputs are
    the only unknowns (single shooting); JAX differentiates through the plant. The answer is a
    local minimum: constraints and the conditions for a minimum are checked after each solve,
    whatever the solver says of itself.

    Parameters
    ----------
    system : LinearSystem or NonlinearSystem
        Its input bounds are part of Z.
    cost : σ model
        A single one. Where it is not smooth, solves may stop at a kink and count as failed.
    horizon : int
        N ≥ 1.
    constraints : Polyhedron, optional
        Over the stacked (x_k, u_k), for k = 0 … N−1.
    path : function x (nx,), u (nu,) → array (m,), optional
        In `jax.numpy`; path(x_k, u_k) ≤ 0 for k = 0 … N−1.
    terminal : Polyhedron, Ellipsoid or TerminalIngredients, optional
        X_N; or the ingredients, whose polyhedron is X_N and whose x_NᵀPx_N is added to the cost.
    solver : "newton"
        Newton steps with exact second derivatives, each a quadratic program; where these get
        stuck, SciPy's SLSQP takes over.
    tol : float
        How far ∇σ may be from what active constraints balance, relative to the size of the terms
        that it is the sum of: in any units of σ, states and inputs the same.
    max_iterations : int

    Raises
    ------
    ValueError
        If an argument is out of range or a dimension does not fit.
    """

    def __init__(
        self,
        system: System,
        cost: CostModel,
        horizon: int,
        *,
        constraints: Polyhedron | None = None,
        path: Callable[[Any, Any], Any] | None = None,
        terminal: Polyhedron | Ellipsoid | TerminalIngredients | None = None,
        solver: Solver = "newton",
        tol: float = 1e-4,
        max_iterations: int = 200,
    ) -> None:
        instance("system", system, System)
        check_model("cost", cost)
        single("system", system)
        single("cost", cost)
        choice("solver", solver, get_args(Solver))
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        self.solver, self.tol = solver, nonnegative("tol", tol)
        self.max_iterations = positive_int("max_iterations", max_iterations)
        self._path = path
        if path is not None:
            _check_path(path, system)
        self._problem = self._sets(constraints, terminal)
        self._rows = shooting.rows(self._problem, path, self.horizon)
        super().__init__()  # the lock: a solve starts from the plan of the one before
        self.reset()
        self._check_cost()

    def _sets(self, constraints: Any, terminal: Any) -> Problem:
        nx, nu = self.system.nx, self.system.nu
        check_polyhedron("constraints", constraints, nx + nu)
        self._constraints = constraints
        stages = None if constraints is None else (constraints.H, constraints.h)
        final, end = terminal_set(terminal, nx, ellipsoid=True)
        self._ingredients = final is not None
        last = (end.H, end.h) if isinstance(end, Polyhedron) else None
        ball = (end.P, end.level) if isinstance(end, Ellipsoid) else None
        low, high = self.system.u_min, self.system.u_max
        half = (high - low) / 2
        scale = np.tile(np.where(np.isfinite(half) & (half > 0), half, 1.0), self.horizon)
        return Problem(self.system, self.cost, stages, last, ball, final, scale)

    def _check_cost(self) -> None:
        N, system = self.horizon, self.system
        x, u = np.zeros((N + 1, system.nx)), np.zeros((N, system.nu))
        y = np.zeros((N, system.ny))
        r = {"x_r": x[0], "u_r": u[0], "y_r": y[0]}
        trajectory = bypass_init(Trajectory, x=x, u=u, y=y, u_before=u[0], **r)
        with traced("cost"):
            try:
                jax.eval_shape(self.cost, trajectory)
            except ValueError as error:
                raise ValueError(f"cost must fit the system and the horizon: {error}") from None

    def reset(self) -> None:
        """Forget the last plan and the last input."""
        with self._lock:
            self._plan: np.ndarray | None = None
            self._applied = np.full(self.system.nu, np.nan)

    def applied(self, u: np.ndarray) -> None:
        """Take note of an input that the plant received: the next Δu starts there."""
        with self._lock:
            self._applied = np.asarray(u)

    def solve(
        self,
        x0: ArrayLike,
        *,
        reference: SteadyState | None = None,
        u_before: ArrayLike | None = None,
        start: ArrayLike | None = None,
    ) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`.

        Parameters
        ----------
        x0 : array (nx,)
        reference : SteadyState, optional
            σ sees deviations from it; without one, from the origin. Sets stay where they are.
        u_before : array (nu,), optional
            The input applied before, for σ of increments. Default: the last one that a call
            returned, if any.
        start : array (N, nu), optional
            Inputs to start from. Default: the better of the last plan, moved on by one step, and
            the input of the reference, held.
        """
        state = check_single_state(x0, self.system.nx)
        began = time.perf_counter()
        with self._lock:
            packed = self._packed(state, reference, u_before)
            program = self._program(*packed)
            tries, refusal = self._tried(program, state, self._starts(program, reference, start))
            solution = self._solution(packed, tries, refusal, began)
        return with_reference(solution, reference)

    def _tried(
        self, program: Program, state: np.ndarray, guesses: list[np.ndarray]
    ) -> tuple[list[Attempt], tuple[str, str] | None]:
        """Return what came of each start, the last one good if any is; status and why if none."""
        tries: list[Attempt] = []
        refusal = None
        for guess in guesses:
            value, c = program.values(guess)
            if not (np.isfinite(value) and np.isfinite(c).all()):
                why = "f, g, path or σ returns NaN or infinity along the plan to start from"
                refusal = "failed", why
                continue
            if (beyond := self._beyond(program, guess)) > 0:
                why = f"x(0) itself is beyond a limit by {beyond:.2g} of its size"
                return [], ("infeasible", f"{infeasible_message(state, self.horizon)}: {why}")
            found, violation = self._from(program, guess)
            tries += found
            if found[-1].good(self.tol):
                break
            if not violation <= ON_LIMIT:
                why = f"the best plan found breaks them by {violation:.2g} of their size"
                refusal = "infeasible", f"{infeasible_message(state, self.horizon)}: {why}"
        return tries, refusal

    def _from(self, program: Program, guess: np.ndarray) -> tuple[list[Attempt], float]:
        """Return the attempts from one start, and the least violation that was found."""
        own, units = own_units(program, guess, self.system.nu)
        tries = [self._attempt(own, units, guess)]
        if tries[0].feasible and not (tries[0].limited or tries[0].good(self.tol)):
            guess = tries[0].z  # in units of where it stopped
            own, units = own_units(program, guess, self.system.nu)
            tries.append(self._attempt(own, units, guess))
        if tries[-1].feasible:
            return tries, 0.0
        nearer, violation = least_violation(own, units.part(tries[-1].z))
        if violation <= ON_LIMIT:
            tries.append(self._attempt(own, units, units.whole(nearer)))
        return tries, violation

    def _attempt(self, own: Program, units: Units, guess: np.ndarray) -> Attempt:
        found = attempt(own, units.part(guess), self.max_iterations, self.tol)
        return dataclasses.replace(found, z=units.whole(found.z))

    def _beyond(self, program: Program, guess: np.ndarray) -> float:
        """Return how far x_0 is beyond limits that no input moves, 0 if it counts as on them."""
        if self._constraints is None:
            return 0.0
        fixed = np.flatnonzero(~self._constraints.H[:, self.system.nx :].any(axis=1))
        excess = program.values(guess)[1][fixed]  # those of stage 0 come first
        if not (excess > 0).any():
            return 0.0
        size = program.slopes(guess).near[fixed]
        worst = float(np.max(excess / np.where(size > 0, size, 1.0)))
        return worst if worst > ON_LIMIT else 0.0

    def _packed(self, x0: np.ndarray, reference: Any, u_before: Any) -> tuple[Known, Any]:
        values = None
        if reference is not None:
            check_reference(reference, self.system, self._constraints, self._ingredients)
            self._check_on_path(reference)
            values = reference.x, reference.u, reference.y
        before = self._applied
        if u_before is not None:
            before = np.asarray(finite_array("u_before", u_before, ndim=1))
            shaped("u_before", before, (self.system.nu,), "the system's inputs")
        given = Given(x0, values, before)
        return shooting.packed(self._problem, given, self._path, self.horizon)

    def _check_on_path(self, reference: SteadyState) -> None:
        if self._path is None:
            return
        excess = np.asarray(self._path(reference.x, reference.u))
        if (excess <= 0).all():
            return
        size = shooting.path_sizes(self._path, reference.x, reference.u)
        if not (excess <= ON_LIMIT * size).all():
            raise ValueError(f"reference must satisfy path(x, u) ≤ 0, got {excess}")

    def _starts(self, program: Any, reference: Any, start: Any) -> list[np.ndarray]:
        """Return scaled inputs to start from, the most promising first."""
        N, nu, scale = self.horizon, self.system.nu, self._problem.scale
        if start is not None:
            U = np.asarray(finite_array("start", start))
            if U.shape != (N, nu):
                raise ValueError(f"start must have shape ({N}, {nu}), got {U.shape}")
            return [program.clipped(U.ravel() / scale)]
        rest = np.zeros(nu) if reference is None else reference.u
        plans = [np.tile(rest, (N, 1))]
        if self._plan is not None:
            plans.append(np.concatenate([self._plan[1:], self._plan[-1:]]))
            plans.append(np.concatenate([self._plan[1:], rest[None]]))
        guesses = [program.clipped(U.ravel() / scale) for U in plans]
        return promising(program, guesses)[:2]

    def _program(self, layout: Known, flat: Any) -> Program:
        scale = self._problem.scale
        low, high = (np.tile(b, self.horizon) for b in (self.system.u_min, self.system.u_max))

        @remembered
        def values(z: np.ndarray) -> tuple[float, np.ndarray]:
            f, c = shooting.values(layout, flat, z)
            return float(f), np.asarray(c)

        @remembered
        def slopes(z: np.ndarray) -> shooting.Slopes:
            return shooting.Slopes.of(*shooting.slopes(layout, flat, z))

        @remembered
        def curvature(z: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
            return np.asarray(shooting.curvature(layout, flat, z, multipliers))

        return Program(values, slopes, curvature, low / scale, high / scale, self._rows)

    def _solution(
        self,
        packed: tuple[Known, Any],
        tries: list[Attempt],
        refusal: tuple[str, str] | None,
        began: float,
    ) -> MPCSolution:
        N, system = self.horizon, self.system
        ranked = sorted(tries, key=lambda t: (not t.good(self.tol), not t.feasible, t.residual))
        best = ranked[0] if ranked else None
        status, message = self._said(best, refusal)
        plan, cost = None, np.nan
        if best is not None and status == "solved":
            U = np.clip((best.z * self._problem.scale).reshape(N, -1), system.u_min, system.u_max)
            f, x = shooting.along(*packed, U)
            cost, X = float(f), np.array(x)
            plan = X, U
            if not (np.isfinite(cost) and np.isfinite(X).all()):  # σ need not see all states
                status, message = "failed", "f returns NaN or infinity along the plan"
        self._plan = plan[1] if plan is not None and status == "solved" else None
        residual = np.inf if best is None else best.residual
        outcome = Outcome(status, message, sum(t.iterations for t in tries), residual)
        return mpc_solution(system, N, outcome, began, plan, cost)

    def _said(self, best: Attempt | None, refusal: tuple[str, str] | None) -> tuple[str, str]:
        """Return status and message for the best attempt, None if there was none."""
        if best is None or not best.feasible:
            if refusal is None:
                assert best is not None
                why = f"the plan breaks the constraints by {best.violation:.2g} of their size"
                refusal = "failed", why
            return refusal
        if best.good(self.tol):
            return "solved", "a local minimum"
        return "max_iterations" if best.limited else "failed", (
            f"{best.iterations} iterations ended at a plan that is not a minimum: residual "
            f"{best.residual:.2g}, wanted {self.tol:.2g}"
        )


def _check_path(path: Callable[[Any, Any], Any], system: System) -> None:
    shape = traced_shape("path(x, u)", path, system.nx, system.nu)
    if len(shape) != 1:
        raise ValueError(f"path must return an array of shape (m,), got shape {shape}")
