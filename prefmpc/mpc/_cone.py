"""Convex σ as cvxpy expressions, and cone programs that Clarabel solves again and again."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from prefmpc._checks import instance, nonnegative, sequence
from prefmpc.models import QuadraticCost, SumCost
from prefmpc.mpc.solution import MPCSolution, check_dimension, infeasible_message, predicted
from prefmpc.mpc.terminal import stage_constraints
from prefmpc.networks import ICNNCost
from prefmpc.sets import SecondOrderCone
from prefmpc.systems import LinearSystem

# Clarabel calls a point "almost solved" when it gets no further than the reduced tolerances.
_TOLERANCES = {
    **{"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8},
    **{"reduced_tol_gap_abs": 1e-6, "reduced_tol_gap_rel": 1e-6, "reduced_tol_feas": 1e-6},
}

TIGHT = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
"""Where there is hardly any room u is sensitive; only exponential cones do not reach this."""

# About one exponential-cone program in 2000 stops at a residual of 1e-6, by an unlucky rounding:
# other steps arrive.
_SECOND_TRIES: tuple[dict[str, Any], ...] = (
    {"max_step_fraction": 0.9},
    {"equilibrate_enable": False},
)


@dataclasses.dataclass(frozen=True)
class ConeSolution:
    """What Clarabel found; ``residual`` is the largest of its residuals and relative gap."""

    z: np.ndarray
    objective: float
    status: str
    message: str
    iterations: int
    residual: float


def mpc_solution(
    system: LinearSystem,
    x0: np.ndarray,
    states: np.ndarray,
    inputs: np.ndarray,
    found: ConeSolution,
    began: float,
) -> MPCSolution:
    """Return the answer of a controller: the plan, or NaN and the reason why there is none."""
    message, cost = found.message, found.objective
    if found.status == "infeasible":
        message = infeasible_message(x0, len(inputs))
    if found.status != "solved":
        states, inputs = np.full_like(states, np.nan), np.full_like(inputs, np.nan)
        cost = np.nan
    inputs = np.clip(inputs, system.u_min, system.u_max)
    return MPCSolution(
        u=inputs[0],
        trajectory=predicted(system, states, inputs),
        cost=cost,
        status=found.status,
        message=message,
        iterations=found.iterations,
        residual=found.residual,
        seconds=time.perf_counter() - began,
    )


class ConeProgram:
    """min ½ zᵀPz + qᵀz subject to b − A z in a product of cones; only b changes between solves.

    Set up once: a new b keeps scaling, ordering and symbolic factorisation.
    """

    def __init__(
        self,
        P: Any,
        q: np.ndarray,
        A: Any,
        b: np.ndarray,
        cones: Sequence[Any],
        options: dict[str, Any] | None = None,
    ) -> None:
        self._options = options or {}
        self._data = sp.triu(P, format="csc"), q, sp.csc_matrix(A), b, list(cones)
        self._solver = self._new_solver({})

    def _new_solver(self, options: dict[str, Any]) -> Any:
        import clarabel

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # it may drop rows, which then cannot be changed
        for name, value in {**_TOLERANCES, **self._options, **options}.items():
            setattr(settings, name, value)
        return clarabel.DefaultSolver(*self._data, settings)

    def solve(self, b: np.ndarray) -> ConeSolution:
        """Solve for another b, same shape; never raises, the status says how it went."""
        found = self._run(self._solver, b)
        for options in _SECOND_TRIES:
            if found.status != "failed":
                break
            found = self._run(self._new_solver(options), b)
        return found

    @staticmethod
    def _run(solver: Any, b: np.ndarray) -> ConeSolution:
        solver.update(b=b)
        found = solver.solve()
        said = str(found.status)
        status = {"Solved": "solved", "AlmostSolved": "solved", "PrimalInfeasible": "infeasible"}
        gap = abs(found.obj_val - found.obj_val_dual) / max(1.0, abs(found.obj_val))
        residual = float(max(found.r_prim, found.r_dual, gap))
        messages = {"Solved": "optimal", "AlmostSolved": f"optimal up to {residual:.1e}"}
        return ConeSolution(
            z=np.asarray(found.x),
            objective=float(found.obj_val),
            status=status.get(said, "failed"),
            message=messages.get(said, f"Clarabel says {said!r}"),
            iterations=int(found.iterations),
            residual=residual,
        )


class ParametricProgram:
    """A cvxpy problem whose single parameter only shifts right-hand sides, solved directly.

    cvxpy takes the problem apart once; a solve then costs what Clarabel needs.
    """

    def __init__(self, problem: Any, parameter: Any, variables: Sequence[Any]) -> None:
        import cvxpy

        cp: Any = cvxpy

        def taken_apart(value: np.ndarray) -> tuple[dict[str, Any], float]:
            parameter.value = value
            data, _, inverse = problem.get_problem_data(
                cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND
            )
            return data, float(inverse[-1]["offset"])

        data, self._offset = taken_apart(np.zeros(parameter.shape))
        self._base = data["b"]
        self._slope = np.stack(
            [taken_apart(unit)[0]["b"] - self._base for unit in np.eye(parameter.size)], axis=1
        )
        size = len(data["c"])
        P = data.get("P", sp.csc_matrix((size, size)))
        dims = data["dims"]
        options = {} if dims.exp else TIGHT
        self._program = ConeProgram(P, data["c"], data["A"], self._base, _cones(dims), options)
        first = data["param_prob"].var_id_to_col
        self._places = [(first[v.id], v.shape) for v in variables]

    def solve(self, value: np.ndarray) -> tuple[ConeSolution, list[np.ndarray]]:
        """Return the solution for a value of the parameter, and the variables in it."""
        found = self._program.solve(self._base + self._slope @ value)
        parts = [
            found.z[start : start + int(np.prod(shape))].reshape(shape, order="F")
            for start, shape in self._places
        ]
        return dataclasses.replace(found, objective=found.objective + self._offset), parts


def _cones(dims: Any) -> list[Any]:
    """Return the cones of cvxpy's standard form, in its order, as Clarabel wants them."""
    import clarabel

    return [
        clarabel.ZeroConeT(dims.zero),
        clarabel.NonnegativeConeT(dims.nonneg),
        *(clarabel.SecondOrderConeT(size) for size in dims.soc),
        *(clarabel.ExponentialConeT() for _ in range(dims.exp)),
    ]


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
    act = {
        "softplus": cp.logistic,
        "relu": cp.pos,
        "squared_relu": lambda a: cp.square(cp.pos(a)),
    }[cost.activation]
    ones = np.ones((v.shape[0], 1))

    def units(v: Any) -> Any:
        z = act(v @ np.asarray(cost.V[0]).T + ones @ np.asarray(cost.b[0])[None])
        for V, b, W in zip(cost.V[1:], cost.b[1:], cost.U, strict=True):
            z = act(z @ np.asarray(W).T + v @ np.asarray(V).T + ones @ np.asarray(b)[None])
        return z

    last = (units(v) + units(-v)) / 2 if cost.even else units(v)
    total = cp.sum(last @ np.asarray(cost.c))
    return total + cost.floor * cp.sum_squares(v) if cost.floor else total


def stage_limits(
    cp: Any, system: LinearSystem, constraints: Any, output_cones: Sequence[Any], X: Any, U: Any
) -> list[Any]:
    """Return (x, u) ∈ Z for every row of X (N, nx) and U (N, nu) as cvxpy constraints.

    Raises a ValueError if a set does not fit.
    """
    Z = stage_constraints(system, constraints)
    cones = sequence("output_cones", output_cones)
    for i, cone in enumerate(cones):
        instance(f"output_cones[{i}]", cone, SecondOrderCone)
        check_dimension(f"output_cones[{i}]", cone.dim, system.ny)
    limits = []
    if len(Z.h):
        limits.append(cp.hstack([X, U]) @ Z.H.T <= np.tile(Z.h, (X.shape[0], 1)))
    Y = X @ system.C.T
    for cone in cones:
        limits.append(cp.norm(Y @ cone.F.T + cone.g, 2, axis=1) <= Y @ cone.c + cone.d)
    return limits


def _factor(matrix: np.ndarray) -> np.ndarray:
    """Return F with F Fᵀ = matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.clip(values, 0, None))
