"""MPC for nonlinear plants and any differentiable σ: single shooting with exact derivatives."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    choice,
    finite_array,
    function,
    instance,
    nonnegative,
    positive_int,
    shaped,
    single,
)
from prefmpc._pytree import bypass_init
from prefmpc.models import CostModel, check_model
from prefmpc.mpc import _nlp
from prefmpc.mpc import _shooting as shooting
from prefmpc.mpc._shooting import Given, Known, Problem
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    check_single_state,
    infeasible_message,
)
from prefmpc.mpc.steady import SteadyState, check_reference, with_reference
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.sets import Ellipsoid, Polyhedron
from prefmpc.systems import System
from prefmpc.trajectories import Trajectory

Solver = Literal["slsqp", "ipopt"]
FEASIBLE = 1e-6


class NonlinearMPC(Controller):
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
    solver : {"slsqp", "ipopt"}
        Newton steps on quadratic programs, with SciPy's SLSQP where these do not arrive; or IPOPT
        (``pip install prefmpc[ipopt]``). Both with exact second derivatives.
    tol : float
        How far ∇σ, relative to 1 + ‖∇σ‖∞, may be from what active constraints balance.
    max_iterations : int

    Raises
    ------
    ValueError
        If an argument is out of range or a dimension does not fit.
    ImportError
        If IPOPT is asked for and `ipyopt` is not installed.
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
        solver: Solver = "slsqp",
        tol: float = 1e-4,
        max_iterations: int = 200,
    ) -> None:
        instance("system", system, System)
        check_model("cost", cost)
        single("system", system)
        single("cost", cost)
        choice("solver", solver, get_args(Solver))
        if solver == "ipopt":
            _need_ipopt()
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        self.solver, self.tol = solver, nonnegative("tol", tol)
        self.max_iterations = positive_int("max_iterations", max_iterations)
        self._path = path
        if path is not None:
            function("path", path, 2)
            _check_path(path, system)
        self._problem = self._sets(constraints, terminal)
        self._rows = shooting.rows(self._problem, path, self.horizon)
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
        try:
            jax.eval_shape(self.cost, bypass_init(Trajectory, x=x, u=u, y=y, u_before=u[0], **r))
        except ValueError as error:
            raise ValueError(f"cost must fit the system and the horizon: {error}") from None

    def reset(self) -> None:
        """Forget the last plan and the last input."""
        self._plan: np.ndarray | None = None
        self._applied = np.full(self.system.nu, np.nan)

    def applied(self, u: np.ndarray) -> None:
        """Take note of an input that the plant received: the next Δu starts there."""
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
        packed = self._packed(state, reference, u_before)
        program = self._program(*packed)
        tries = []
        message = ""
        for guess in self._starts(program, reference, start):
            value, c = program.values(guess)
            if not (np.isfinite(value) and np.isfinite(c).all()):
                message = "f, g, path or σ returns NaN or infinity along the plan to start from"
                continue
            tries.append(_nlp.attempt(program, guess, self.solver, self.max_iterations, self.tol))
            if tries[-1].good(FEASIBLE, self.tol):
                break
            if tries[-1].violation > FEASIBLE:
                nearer, violation = _nlp.least_violation(program, tries[-1].z)
                if violation > FEASIBLE:
                    message = (
                        f"{infeasible_message(state, self.horizon)}: the best plan found breaks "
                        f"them by {violation:.2g}"
                    )
                    continue
                tries.append(
                    _nlp.attempt(program, nearer, self.solver, self.max_iterations, self.tol)
                )
                if tries[-1].good(FEASIBLE, self.tol):
                    break
        return self._solution(packed, reference, tries, message, began)

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
        if not (excess <= FEASIBLE).all():
            raise ValueError(f"reference must satisfy path(x, u) ≤ 0, got {excess}")

    def _starts(self, program: Any, reference: Any, start: Any) -> list[np.ndarray]:
        """Return scaled inputs to start from, the most promising first."""
        N, nu, scale = self.horizon, self.system.nu, self._problem.scale
        if start is not None:
            U = np.asarray(finite_array("start", start))
            if U.shape != (N, nu):
                raise ValueError(f"start must have shape ({N}, {nu}), got {U.shape}")
            return [np.clip(U.ravel() / scale, program.lower, program.upper)]
        rest = np.zeros(nu) if reference is None else reference.u
        plans = [np.tile(rest, (N, 1))]
        if self._plan is not None:
            plans.append(np.concatenate([self._plan[1:], self._plan[-1:]]))
            plans.append(np.concatenate([self._plan[1:], rest[None]]))
        guesses = [np.clip(U.ravel() / scale, program.lower, program.upper) for U in plans]

        def merit(z: np.ndarray) -> float:
            value, c = program.values(z)
            total = value + 1e3 * (1 + abs(value)) * np.maximum(c, 0).sum()
            return float(total) if np.isfinite(total) else np.inf

        ranked = sorted(guesses, key=merit)
        return ranked[:2] if len(ranked) > 1 else ranked

    def _program(self, layout: Known, flat: Any) -> _nlp.Program:
        scale = self._problem.scale
        low, high = (np.tile(b, self.horizon) for b in (self.system.u_min, self.system.u_max))

        @_nlp.remembered
        def values(z: np.ndarray) -> tuple[float, np.ndarray]:
            f, c = shooting.values(layout, flat, z)
            return float(f), np.asarray(c)

        @_nlp.remembered
        def slopes(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            g, J = shooting.slopes(layout, flat, z)
            return np.asarray(g), np.asarray(J)

        def curvature(z: np.ndarray, multipliers: np.ndarray, factor: float) -> np.ndarray:
            return np.asarray(shooting.curvature(layout, flat, z, multipliers, factor))

        return _nlp.Program(values, slopes, curvature, low / scale, high / scale, self._rows)

    def _solution(
        self,
        packed: tuple[Known, Any],
        reference: SteadyState | None,
        tries: list[_nlp.Attempt],
        message: str,
        began: float,
    ) -> MPCSolution:
        N, nu = self.horizon, self.system.nu
        good = tries[-1] if tries and tries[-1].good(FEASIBLE, self.tol) else None
        best = good or min(tries, key=lambda t: (t.violation > FEASIBLE, t.residual), default=None)
        status, cost = "solved", np.nan
        U = np.full((N, nu), np.nan)
        X = np.full((N + 1, self.system.nx), np.nan)
        if good is not None:
            message = "a local minimum"
            z = (good.z * self._problem.scale).reshape(N, nu)
            U = np.clip(z, self.system.u_min, self.system.u_max)
            f, x = shooting.along(*packed, U)
            cost, X = float(f), np.array(x)
            self._plan = U
        elif best is None:
            status = "failed"
        elif best.violation > FEASIBLE:
            status = "infeasible" if message.startswith("no input") else "failed"
            message = message or f"the plan breaks the constraints by {best.violation:.2g}"
        else:
            status = "max_iterations" if best.limited else "failed"
            message = (
                f"{best.iterations} iterations ended at a plan that is not a minimum: residual "
                f"{best.residual:.2g}, wanted {self.tol:.2g}"
            )
        if good is None:
            self._plan = None
        solution = MPCSolution(
            u=U[0],
            trajectory=bypass_init(Trajectory, x=X, u=U, y=self.system.output(X[:-1])),
            cost=cost,
            status=status,
            message=message,
            iterations=sum(t.iterations for t in tries),
            residual=best.residual if best is not None else np.inf,
            seconds=time.perf_counter() - began,
        )
        return with_reference(solution, reference)


def _need_ipopt() -> None:
    try:
        import ipyopt  # noqa: F401
    except ImportError as error:
        raise ImportError(
            'solver="ipopt" needs the package ipyopt: pip install "prefmpc[ipopt]"'
        ) from error


def _check_path(path: Callable[[Any, Any], Any], system: System) -> None:
    x, u = (jax.ShapeDtypeStruct((size,), np.float64) for size in (system.nx, system.nu))
    try:
        shape = jax.eval_shape(path, x, u).shape
    except Exception as error:
        raise ValueError(f"path(x, u) must work on JAX arrays, but raised: {error}") from error
    if len(shape) != 1:
        raise ValueError(f"path must return an array of shape (m,), got shape {shape}")
