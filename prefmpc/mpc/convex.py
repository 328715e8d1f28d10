"""MPC with any convex σ and convex constraint sets: a cone program through cvxpy and Clarabel."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import instance, nonnegative, positive_int
from prefmpc.models import QuadraticCost, SumCost
from prefmpc.mpc.qp import predicted
from prefmpc.mpc.solution import (
    MPCError,
    MPCSolution,
    check_dimension,
    check_state,
    infeasible_message,
)
from prefmpc.mpc.terminal import TerminalIngredients, stage_constraints
from prefmpc.networks import ICNNCost
from prefmpc.sets import Ellipsoid, Polyhedron, SecondOrderCone
from prefmpc.systems import LinearSystem


class ConvexMPC:
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
    terminal : Polyhedron, Ellipsoid or TerminalIngredients, optional
        X_N; or the ingredients, whose polyhedron is X_N and whose x_NᵀPx_N is added to the cost.

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
        terminal: Polyhedron | Ellipsoid | TerminalIngredients | None = None,
    ) -> None:
        import cvxpy

        cp: Any = cvxpy
        instance("system", system, LinearSystem)
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        nx, nu, N = system.nx, system.nu, self.horizon
        if constraints is not None:
            instance("constraints", constraints, Polyhedron)
            check_dimension("constraints", constraints.dim, nx + nu)
        for i, cone in enumerate(output_cones):
            instance(f"output_cones[{i}]", cone, SecondOrderCone)
            check_dimension(f"output_cones[{i}]", cone.dim, system.ny)
        self._x0 = cp.Parameter(nx)
        self._X, self._U = cp.Variable((N + 1, nx)), cp.Variable((N, nu))
        X, U = self._X, self._U
        total = expression(cp, cost, X[:-1], U)
        Z = stage_constraints(system, constraints)
        limits = [X[0] == self._x0, X[1:] == X[:-1] @ system.A.T + U @ system.B.T]
        if len(Z.h):
            stages = cp.hstack([X[:-1], U]) @ Z.H.T
            limits.append(stages <= np.tile(Z.h, (N, 1)))
        for cone in output_cones:
            Y = X[:-1] @ system.C.T
            limits.append(cp.norm(Y @ cone.F.T + cone.g, 2, axis=1) <= Y @ cone.c + cone.d)
        if isinstance(terminal, TerminalIngredients):
            check_dimension("terminal", len(terminal.P), nx)
            total += cp.sum_squares(np.linalg.cholesky(terminal.P).T @ X[N])
            terminal = terminal.polyhedron
        if isinstance(terminal, Ellipsoid):
            check_dimension("terminal", terminal.dim, nx)
            if np.isfinite(terminal.level):
                root = np.linalg.cholesky(terminal.P).T
                limits.append(cp.norm(root @ X[N], 2) <= np.sqrt(terminal.level))
        elif terminal is not None:
            instance("terminal", terminal, Polyhedron)
            check_dimension("terminal", terminal.dim, nx)
            if len(terminal.h):
                limits.append(terminal.H @ X[N] <= terminal.h)
        self._problem = cp.Problem(cp.Minimize(total), limits)

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0."""
        import cvxpy

        cp: Any = cvxpy
        state = np.asarray(check_state(x0, self.system.nx))
        if state.ndim != 1:
            raise ValueError(f"x0 must have shape ({self.system.nx},), got {state.shape}")
        began = time.perf_counter()
        self._x0.value = state
        details = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the solver thinks of its answer is in the status
            try:
                # The steps of Problem.solve, which would not hand out the solver's residuals.
                data, chain, inverse = self._problem.get_problem_data(
                    cp.CLARABEL, solver_opts=_TOLERANCES
                )
                details = chain.solve_via_data(
                    self._problem, data, warm_start=False, verbose=False, solver_opts=_TOLERANCES
                )
                self._problem.unpack_results(details, chain, inverse)
                said = str(self._problem.status)
            except cp.SolverError as error:
                said = f"failed: {error}"
        return self._solution(state, said, _residual(details), time.perf_counter() - began)

    def __call__(self, x0: ArrayLike) -> np.ndarray:
        """Return the input to apply, u*_0 (nu,). Raises an `MPCError` if the solve failed."""
        solution = self.solve(x0)
        if not solution.success:
            raise MPCError(solution)
        return solution.u

    def _solution(self, x0: np.ndarray, said: str, residual: float, seconds: float) -> MPCSolution:
        N, nx, nu = self.horizon, self.system.nx, self.system.nu
        statuses = {
            "optimal": ("solved", "optimal"),
            "optimal_inaccurate": ("solved", f"optimal up to a residual of {residual:.1e}"),
            "infeasible": ("infeasible", infeasible_message(x0, N)),
        }
        status, message = statuses.get(said, ("failed", f"Clarabel says {said!r}"))
        inputs, states, cost = np.full((N, nu), np.nan), np.full((N + 1, nx), np.nan), np.nan
        if status == "solved":
            inputs = np.clip(self._U.value, self.system.u_min, self.system.u_max)
            states, cost = np.asarray(self._X.value), float(self._problem.value)
        return MPCSolution(
            u=inputs[0],
            trajectory=predicted(self.system, states, inputs),
            cost=cost,
            status=status,
            message=message,
            iterations=int(getattr(self._problem.solver_stats, "num_iters", 0) or 0),
            residual=residual,
            seconds=seconds,
        )


# Clarabel calls a point "almost solved" when it gets no further than the reduced tolerances.
_TOLERANCES = {
    **{"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8},
    **{"reduced_tol_gap_abs": 1e-6, "reduced_tol_gap_rel": 1e-6, "reduced_tol_feas": 1e-6},
}


def _residual(details: Any) -> float:
    """Return the largest of primal residual, dual residual and relative duality gap."""
    try:
        gap = abs(details.obj_val - details.obj_val_dual) / max(1.0, abs(details.obj_val))
        return float(max(details.r_prim, details.r_dual, gap))
    except AttributeError:
        return np.nan


def expression(cp: Any, cost: Any, X: Any, U: Any) -> Any:
    """Return σ as a cvxpy expression of the states X (N, nx) and the inputs U (N, nu).

    Raises a ValueError if ``cost`` is not a convex model, or does not fit.
    """
    if getattr(cost, "batch_shape", ()):
        raise ValueError(f"cost must be a single model, got a stack of shape {cost.batch_shape}")
    (N, nx), nu = X.shape, U.shape[1]
    if isinstance(cost, SumCost):
        parts = zip(cost.weights, cost.models, strict=True)
        return sum(float(weight) * expression(cp, model, X, U) for weight, model in parts)
    if isinstance(cost, QuadraticCost):
        Q, R = np.asarray(cost.Q), np.asarray(cost.R)
        if Q.shape != (nx, nx) or R.shape != (nu, nu):
            raise ValueError(
                f"cost must weigh {nx} states and {nu} inputs, got Q {Q.shape} and R {R.shape}"
            )
        return cp.sum_squares(X @ _factor(Q)) + cp.sum_squares(U @ _factor(R))
    if not isinstance(cost, ICNNCost):
        raise ValueError(
            "cost must be a convex σ (QuadraticCost, ICNNCost, or SumCost of these), "
            f"got {type(cost).__name__}"
        )
    for name, leaf in (*((f"U[{i}]", leaf) for i, leaf in enumerate(cost.U)), ("c", cost.c)):
        if not (np.asarray(leaf) >= 0).all():
            raise ValueError(f"cost must be convex, but its {name} has negative entries or NaN")
    if len(cost.scale) != nx + nu:
        raise ValueError(f"cost must see {nx + nu} signals, got {len(cost.scale)}")
    nonnegative("cost.floor", cost.floor)
    v = cp.multiply(cp.hstack([X, U]), np.tile(1 / np.asarray(cost.scale), (N, 1)))
    if cost.over == "trajectory":
        columns = np.shape(cost.V[0])[-1]
        if columns != N * (nx + nu):
            raise ValueError(
                f"horizon must be {columns // (nx + nu)}, for which cost was made, got {N}"
            )
        v = cp.reshape(v, (1, columns), order="C")
    act = cp.pos if cost.activation == "relu" else cp.logistic
    ones = np.ones((v.shape[0], 1))
    z = act(v @ np.asarray(cost.V[0]).T + ones @ np.asarray(cost.b[0])[None])
    for V, b, W in zip(cost.V[1:], cost.b[1:], cost.U, strict=True):
        z = act(z @ np.asarray(W).T + v @ np.asarray(V).T + ones @ np.asarray(b)[None])
    total = cp.sum(z @ np.asarray(cost.c))
    return total + cost.floor * cp.sum_squares(v) if cost.floor else total


def _factor(matrix: np.ndarray) -> np.ndarray:
    """Return F with F Fᵀ = matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.clip(values, 0, None))
