"""The peers that run closed loops, each as somebody who knows it well would use it.

All but two get the condensed problem, the states eliminated, which is what suits dense solvers
and short horizons best. It is set up once; a solve changes what depends on the state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp

from prefmpc import LinearSystem, Polyhedron

SOLVED, INFEASIBLE, UNFINISHED = "solved", "infeasible", "max_iterations"
Solve = Callable[[np.ndarray], tuple[str, np.ndarray]]
"""State (nx,) to a status and the plan (N·nu,)."""


@dataclasses.dataclass(frozen=True)
class Condensed:
    """min ½UᵀHU + (F x_0)ᵀU over lower ≤ U ≤ upper and G U ≤ limits − E x_0."""

    H: np.ndarray
    F: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    G: np.ndarray
    E: np.ndarray
    limits: np.ndarray


def condensed(
    system: LinearSystem, Q: Any, R: Any, horizon: int, constraints: Polyhedron | None = None
) -> list[Condensed]:
    """Return one problem for each of the weights Q (c, nx, nx), R (c, nu, nu), in one go."""
    A, B = np.asarray(system.A), np.asarray(system.B)
    nx, nu = B.shape
    n = horizon * nu
    powers = [np.eye(nx)]
    for _ in range(horizon - 1):
        powers.append(A @ powers[-1])
    Phi = np.stack(powers)  # states 0 … N−1: σ does not weigh x_N
    Gamma = np.zeros((horizon, nx, n))
    for k in range(1, horizon):
        for j in range(k):
            Gamma[k, :, j * nu : (j + 1) * nu] = powers[k - 1 - j] @ B
    weighted = (2 * np.asarray(Q)[:, None] @ Gamma).reshape(len(Q), -1, n).swapaxes(1, 2)
    H = weighted @ Gamma.reshape(-1, n) + 2 * np.kron(np.eye(horizon), np.asarray(R))
    F = weighted @ Phi.reshape(-1, nx)
    lower, upper = np.tile(system.u_min, horizon), np.tile(system.u_max, horizon)
    G, E, limits = np.zeros((0, n)), np.zeros((0, nx)), np.zeros(0)
    if constraints is not None:
        Hx, Hu = constraints.H[:, :nx], constraints.H[:, nx:]
        now = np.eye(n).reshape(horizon, nu, n)
        G, E = (Hx @ Gamma + Hu @ now).reshape(-1, n), (Hx @ Phi).reshape(-1, nx)
        limits = np.tile(constraints.h, horizon)
    return [Condensed(h, f, lower, upper, G, E, limits) for h, f in zip(H, F, strict=True)]


def closed_loops(
    system: LinearSystem, solve: Solve, x0: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs (m, steps, nu), NaN from a failed solve on, and the last status (m,)."""
    A, B = np.asarray(system.A), np.asarray(system.B)
    nu = B.shape[1]
    inputs = np.full((len(x0), steps, nu), np.nan)
    status = np.full(len(x0), SOLVED, dtype="<U14")
    for i, x in enumerate(x0):
        for k in range(steps):
            word, plan = solve(x)
            if word != SOLVED:
                status[i] = word
                break
            inputs[i, k] = u = plan[:nu]
            x = A @ x + B @ u
    return inputs, status


def daqp_model(problem: Condensed, tight: bool = False) -> Solve:
    """DAQP with its workspace kept; ``tight``: as exactly as it can, the reference of all."""
    import daqp

    p, rows = problem, len(problem.G) > 0
    model = daqp.Model()
    nothing = np.zeros(p.F.shape[1])
    upper, lower = _both(p, nothing)
    model.setup(p.H, p.F @ nothing, p.G, upper, lower)
    if tight:
        model.settings = {"primal_tol": 1e-12, "dual_tol": 1e-12, "zero_tol": 1e-14}

    def solve(x: np.ndarray) -> tuple[str, np.ndarray]:
        if rows:
            upper[p.lower.size :] = p.limits - p.E @ x
            model.update(f=p.F @ x, bupper=upper, blower=lower)
        else:
            model.update(f=p.F @ x)
        plan, _, flag, _ = model.solve()
        return _of_daqp(flag), plan

    return solve


def daqp_call(problem: Condensed) -> Solve:
    """DAQP called anew for each solve: no workspace, no warm start, and less to do in Python."""
    import daqp

    p = problem
    upper, lower = _both(p, np.zeros(p.F.shape[1]))
    sense = np.zeros(upper.size, dtype=np.int32)

    def solve(x: np.ndarray) -> tuple[str, np.ndarray]:
        if len(p.G):
            upper[p.lower.size :] = p.limits - p.E @ x
        plan, _, flag, _ = daqp.solve(p.H, p.F @ x, p.G, upper, lower, sense)
        return _of_daqp(flag), plan

    return solve


def _both(p: Condensed, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper and lower limits of inputs and rows."""
    upper = np.concatenate([p.upper, p.limits - p.E @ x])
    return upper, np.concatenate([p.lower, np.full(len(p.G), -1e30)])


def _of_daqp(flag: int) -> str:
    return SOLVED if flag > 0 else INFEASIBLE if flag == -1 else UNFINISHED


def osqp_solver(problem: Condensed, eps: float = 1e-7) -> Solve:
    """OSQP, set up once. ``eps`` is what makes u right to 1e-6.

    Not warm: with the default interval between its checks a warm start saves no iterations here,
    and costs accuracy. Not polished: that takes half as long again.
    """
    import osqp

    p = problem
    n = p.lower.size
    upper, lower = _both(p, np.zeros(p.F.shape[1]))
    solver = osqp.OSQP()
    solver.setup(
        sp.triu(p.H, format="csc"),
        np.zeros(n),
        sp.vstack([sp.eye(n), sp.csc_matrix(p.G)], format="csc"),
        lower,
        upper,
        eps_abs=eps,
        eps_rel=eps,
        eps_prim_inf=1e-8,
        max_iter=20_000,
        warm_starting=False,
        polishing=False,
        verbose=False,
    )
    words = {
        osqp.SolverStatus.OSQP_SOLVED: SOLVED,
        osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: INFEASIBLE,
    }

    def solve(x: np.ndarray) -> tuple[str, np.ndarray]:
        if len(p.G):
            upper[n:] = p.limits - p.E @ x
            solver.update(q=p.F @ x, u=upper)
        else:
            solver.update(q=p.F @ x)
        result = solver.solve(raise_error=False)
        return words.get(result.info.status_val, UNFINISHED), result.x

    return solve


def piqp_solver(problem: Condensed, eps: float = 1e-11) -> Solve:
    """PIQP, dense, set up once. ``eps`` is what makes u right to 1e-6."""
    import piqp

    p = problem
    solver = piqp.DenseSolver()
    for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
        setattr(solver.settings, name, eps)
    c = np.zeros(p.lower.size)
    rows = {"G": np.asfortranarray(p.G), "h_u": p.limits} if len(p.G) else {}
    solver.setup(np.asfortranarray(p.H), c, x_l=p.lower, x_u=p.upper, **rows)
    words = {piqp.PIQP_SOLVED: SOLVED, piqp.PIQP_PRIMAL_INFEASIBLE: INFEASIBLE}

    def solve(x: np.ndarray) -> tuple[str, np.ndarray]:
        limits = {"h_u": p.limits - p.E @ x} if len(p.G) else {}
        solver.update(c=p.F @ x, **limits)
        return words.get(solver.solve(), UNFINISHED), solver.result.x

    return solve


MAKERS = {
    "DAQP, called": daqp_call,
    "DAQP, kept": daqp_model,
    "PIQP": piqp_solver,
    "OSQP": osqp_solver,
}


def cvxpy_solver(system: LinearSystem, Q: np.ndarray, R: np.ndarray, horizon: int) -> Solve:
    """CVXPY as its documentation advises: states kept, x_0 a Parameter (DPP), OSQP, warm."""
    import cvxpy as cp

    A, B = np.asarray(system.A), np.asarray(system.B)
    nx, nu = B.shape
    start = cp.Parameter(nx)
    x, u = cp.Variable((horizon + 1, nx)), cp.Variable((horizon, nu))
    cost = cp.sum_squares(x[:-1] @ np.linalg.cholesky(Q))
    cost += cp.sum_squares(u @ np.linalg.cholesky(R))
    limits = [x[0] == start, x[1:] == x[:-1] @ A.T + u @ B.T]
    limits += [u >= np.asarray(system.u_min), u <= np.asarray(system.u_max)]
    problem = cp.Problem(cp.Minimize(cost), limits)

    def solve(state: np.ndarray) -> tuple[str, np.ndarray]:
        start.value = state
        problem.solve(solver=cp.OSQP, eps_abs=1e-7, eps_rel=1e-7, warm_start=True)
        return (SOLVED if problem.status == "optimal" else UNFINISHED), u.value.ravel()

    return solve


def qpax_loops(
    system: LinearSystem, problems: list[Condensed], steps: int, tol: float
) -> Callable[[np.ndarray], Any]:
    """qpax, mapped over states (or over as many problems), a step a scan, all compiled.

    The answer maps x0 (m, nx) to inputs (m, steps, nu) and what qpax says: converged or not.
    """
    import jax
    import jax.numpy as jnp
    import qpax

    many = len(problems) > 1
    H, F = (
        np.stack([getattr(p, name) for p in problems]) if many else getattr(problems[0], name)
        for name in "HF"
    )
    p = problems[0]
    n = p.lower.size
    G = np.vstack([np.eye(n), -np.eye(n)])
    h = np.concatenate([p.upper, -p.lower])
    A, B = np.asarray(system.A), np.asarray(system.B)

    def one(H: Any, F: Any, x: Any) -> Any:
        z, _, _, _, converged, _ = qpax.solve_qp(
            H, F @ x, jnp.zeros((0, n)), jnp.zeros(0), G, h, solver_tol=tol
        )
        return z[: B.shape[1]], converged

    mapped = jax.vmap(one, in_axes=(0, 0, 0) if many else (None, None, 0))

    @jax.jit
    def run(H: Any, F: Any, x0: Any) -> Any:
        def step(x: Any, _: None) -> Any:
            u, converged = mapped(H, F, x)
            return x @ A.T + u @ B.T, (u, converged)

        _, (u, converged) = jax.lax.scan(step, x0, None, length=steps)
        return u.swapaxes(0, 1), converged.swapaxes(0, 1)

    return lambda x0: jax.block_until_ready(run(H, F, x0))
