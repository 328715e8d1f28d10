"""Linear MPC with a quadratic σ as a sparse quadratic program, solved by OSQP."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike
from scipy.optimize import Bounds, LinearConstraint, milp

from prefmpc._checks import instance, positive_int
from prefmpc.models import QuadraticCost
from prefmpc.mpc.solution import (
    MPCError,
    MPCSolution,
    check_dimension,
    check_problem,
    check_state,
    infeasible_message,
)
from prefmpc.mpc.terminal import TerminalIngredients
from prefmpc.sets import Polyhedron
from prefmpc.systems import LinearSystem
from prefmpc.trajectories import Trajectory

# OSQP's own default of 1e-3 leaves inputs off by 4e-3.
_SETTINGS = {
    "eps_abs": 1e-7,
    "eps_rel": 1e-7,
    "eps_prim_inf": 1e-8,
    "polishing": True,
    "max_iter": 20_000,
    "verbose": False,
}

_ANYTHING = Bounds(-np.inf, np.inf)


class LinearMPC:
    """The controller min σ(T) s.t. x_0 = x(t), the dynamics, (x_k, u_k) ∈ Z, x_N ∈ X_N.

    Implements eq. (7) of arXiv 2511.22502 for a linear plant, polyhedral sets and quadratic σ;
    with input bounds alone this is eq. (12). The problem is set up once; each solve only changes
    the initial state.

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
        if cost.batch_shape:
            raise ValueError(
                f"cost must be a single model, got a stack of shape {cost.batch_shape}; "
                "BatchedMPC takes stacks"
            )
        self.system = system
        self.cost = cost
        self.horizon = positive_int("horizon", horizon)
        final = np.zeros((system.nx, system.nx))
        if isinstance(terminal, TerminalIngredients):
            final, terminal = terminal.P, terminal.polyhedron
        for name, given, dim in (
            ("constraints", constraints, system.nx + system.nu),
            ("terminal", terminal, system.nx),
        ):
            if given is None:
                continue
            instance(name, given, Polyhedron)
            check_dimension(name, given.dim, dim)
        check_dimension("terminal", len(final), system.nx)
        self._build(constraints, terminal, final)

    def _build(
        self, constraints: Polyhedron | None, terminal: Polyhedron | None, final: np.ndarray
    ) -> None:
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
        self._lower, self._upper = np.concatenate(lower), np.concatenate(upper)
        self._solver = osqp.OSQP()
        self._solver.setup(
            sp.triu(P, format="csc"),  # OSQP reads a lower triangle without complaint, and wrongly
            np.zeros(states + inputs),
            self._rows,
            self._lower,
            self._upper,
            **_SETTINGS,
        )

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0 (nx,); see `MPCSolution`. Raises a ValueError on a bad x0."""
        x0 = np.asarray(check_state(x0, self.system.nx))
        if x0.ndim != 1:
            raise ValueError(f"x0 must have shape ({self.system.nx},), got {x0.shape}")
        began = time.perf_counter()
        self._lower[: x0.size] = self._upper[: x0.size] = -x0
        self._solver.update(l=self._lower, u=self._upper)
        result = self._solver.solve(raise_error=False)
        return self._solution(x0, result, time.perf_counter() - began)

    def __call__(self, x0: ArrayLike) -> np.ndarray:
        """Return the input to apply, u*_0 (nu,). Raises an `MPCError` if the solve failed."""
        solution = self.solve(x0)
        if not solution.success:
            raise MPCError(solution)
        return solution.u

    def _feasible(self) -> bool:
        """Whether any point satisfies the constraints: a linear program, where OSQP cannot tell."""
        limits = LinearConstraint(self._rows, self._lower, self._upper)
        answer = milp(np.zeros(self._rows.shape[1]), constraints=limits, bounds=_ANYTHING)
        return int(answer.status) != 2

    def _solution(self, x0: np.ndarray, result: Any, seconds: float) -> MPCSolution:
        import osqp

        N, nx, nu = self.horizon, self.system.nx, self.system.nu
        nothing = "infeasible", infeasible_message(x0, N)
        status, message = {
            osqp.SolverStatus.OSQP_SOLVED: ("solved", "optimal"),
            osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: nothing,
            osqp.SolverStatus.OSQP_MAX_ITER_REACHED: (
                "max_iterations",
                f"no solution of the wanted accuracy after {result.info.iter} iterations",
            ),
        }.get(result.info.status_val, ("failed", f"OSQP says {result.info.status!r}"))
        if status not in ("solved", "infeasible") and not self._feasible():
            status, message = nothing
        inputs = np.full((N, nu), np.nan)
        states = np.full((N + 1, nx), np.nan)
        cost = np.nan
        if status == "solved" and not np.isfinite(result.x).all():
            status, message = "failed", "OSQP returned values that are not finite"
        if status == "solved":
            states, inputs = np.split(result.x, [nx * (N + 1)])
            states = states.reshape(N + 1, nx)
            inputs = np.clip(inputs.reshape(N, nu), self.system.u_min, self.system.u_max)
            cost = float(result.info.obj_val)
        return MPCSolution(
            u=inputs[0],
            trajectory=predicted(self.system, states, inputs),
            cost=cost,
            status=status,
            message=message,
            iterations=int(result.info.iter),
            residual=max(float(result.info.prim_res), float(result.info.dual_res)),
            seconds=seconds,
        )


def predicted(system: LinearSystem, states: np.ndarray, inputs: np.ndarray) -> Trajectory:
    """Return a plan as a trajectory, NaN where the solve failed."""
    from prefmpc._pytree import bypass_init

    # Built without validation: the values of a failed solve are NaN on purpose.
    return bypass_init(Trajectory, x=states, u=inputs, y=states[:-1] @ system.C.T)
