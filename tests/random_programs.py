"""Random quadratic programs, feasible and not, solved by the library's batch and by Clarabel."""

from __future__ import annotations

import clarabel
import jax
import numpy as np
import scipy.sparse as sp

from prefmpc.mpc._batched_qp import solve
from prefmpc.mpc._condensed import scaled


@jax.jit
def answers(H, q, lower, upper, G, h):
    """Solve min ½ vᵀHv + qᵀv over lower ≤ v ≤ upper, G v ≤ h, all with a leading axis."""

    def prepared(H, q, lower, upper, G, h):
        return scaled(H, q[:, None], lower, upper, (G, np.zeros((len(h), 1)), h))

    problems = jax.vmap(prepared)(H, q, lower, upper, G, h)
    return solve(problems, np.ones((len(q), 1, 1)), 1e-8)


def random_programs(count, n, rows, rng):
    """Half of them infeasible, by very little and by much; badly conditioned ones among them."""
    A = rng.normal(size=(count, n, n))
    H = A @ A.swapaxes(1, 2) / n + 10 ** rng.uniform(-2, 1, (count, 1, 1)) * np.eye(n)
    q = rng.normal(size=(count, n)) * 10 ** rng.uniform(-1, 1.5, (count, 1))
    G = rng.normal(size=(count, rows, n))
    inside = G @ rng.normal(size=(count, n, 1))
    h = inside[..., 0] + rng.uniform(0, 1, (count, rows))
    worse = np.where(rng.random(count) < 0.5, 10 ** rng.uniform(-1, 1, count), 0)
    lower = np.where(rng.random((count, n)) < 0.3, -np.inf, -3.0)
    return H, q, lower, np.full((count, n), 3.0), G, h - worse[:, None]


def by_clarabel(H, q, lower, upper, G, h):
    n, finite = len(q), np.isfinite(lower)
    A = np.concatenate([np.eye(n), -np.eye(n)[finite], G])
    b = np.concatenate([upper, -lower[finite], h])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    cones = [clarabel.NonnegativeConeT(len(b))]
    solver = clarabel.DefaultSolver(
        sp.triu(H, format="csc"), q, sp.csc_matrix(A), b, cones, settings
    )
    found = solver.solve()
    status = {"Solved": "solved", "AlmostSolved": "solved", "PrimalInfeasible": "infeasible"}
    return status[str(found.status)], np.array(found.x)
