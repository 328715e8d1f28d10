"""The peers that learn a quadratic σ, each as somebody who knows it well would use it.

Two problems. "MAP": minimise Σ cross-entropy − log prior, as `fit_map` does; W = blkdiag(Q, R) is
known then by one number, the objective. "recipe": the mean cross-entropy and a small ridge on the
entries of Cholesky factors from 20 random starts, as the paper and `fit` do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxopt import LBFGSB
from scipy.linalg import block_diag
from scipy.optimize import minimize

import prefmpc
from prefmpc.learning._starts import projected_adam

LOWER = 1e-6
"""Least diagonal entry of a Cholesky factor, relative to the prior's: W stays definite."""


class Features:
    """Differences of second moments, lower triangles of blkdiag(S_x, S_u), and how to unpack W."""

    def __init__(self, comparisons: prefmpc.Comparisons) -> None:
        moments = [np.asarray(S) for S in prefmpc.second_moments(comparisons.trajectories)]
        nx, nu = (S.shape[-1] for S in moments)
        tri = [np.tril_indices(k) for k in (nx, nu)]
        packed = [
            S[:, i, j] * np.where(i == j, 1.0, 2.0) for S, (i, j) in zip(moments, tri, strict=True)
        ]
        pool = np.concatenate(packed, axis=1)
        self.gap = pool[comparisons.second] - pool[comparisons.first]
        self.labels = np.asarray(comparisons.labels)
        self.rows, self.columns = (np.concatenate([tri[0][k], tri[1][k] + nx]) for k in (0, 1))
        self.double = np.where(self.rows == self.columns, 1.0, 2.0)
        self.size = nx + nu

    def factor(self, theta: np.ndarray) -> np.ndarray:
        """Return the lower triangular L (d, d) with these entries."""
        L = np.zeros((self.size, self.size))
        L[self.rows, self.columns] = theta
        return L

    def losses(self, w: np.ndarray) -> tuple[float, np.ndarray]:
        """Return Σ cross-entropy for the lower triangle w of W, and its derivative."""
        z = self.gap @ w
        small = np.exp(-np.abs(z))
        value = np.maximum(z, 0).sum() + np.log1p(small).sum() - self.labels @ z
        p = np.where(z >= 0, 1.0, small) / (1 + small)
        return float(value), self.gap.T @ (p - self.labels)

    def through_factor(self, L: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the derivative for the entries of L from that for the lower triangle of L Lᵀ."""
        M = np.zeros_like(L)
        M[self.rows, self.columns] = slope / self.double
        return (2 * (M + M.T - np.diag(np.diag(M))) @ L)[self.rows, self.columns]


def scipy_map(comparisons: prefmpc.Comparisons, prior: prefmpc.WishartPrior) -> float:
    """SciPy's L-BFGS-B with NumPy gradients on Cholesky factors in units of the prior."""
    data = Features(comparisons)
    mode = block_diag(prior.Q, prior.R)
    unit = np.sqrt(np.diag(mode))
    scale = (unit[:, None] * unit)[data.rows, data.columns]
    precision = np.linalg.inv(mode / unit / unit[:, None])
    diagonal = data.rows == data.columns

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        L = data.factor(theta)
        W = L @ L.T
        value, slope = data.losses(W[data.rows, data.columns] * scale)
        log_det = 2 * np.log(theta[diagonal]).sum()
        value += prior.strength * (np.sum(precision * W) - log_det)
        gradient = data.through_factor(L, slope * scale)
        gradient += prior.strength * (2 * precision @ L)[data.rows, data.columns]
        gradient[diagonal] -= prior.strength * 2 / theta[diagonal]
        return value, gradient

    start = np.linalg.cholesky(mode / unit / unit[:, None])[data.rows, data.columns]
    bounds = [(LOWER, None) if d else (None, None) for d in diagonal]
    options = {"maxiter": 5000, "maxfun": 10_000, "maxcor": 20, "ftol": 1e-13, "gtol": 1e-6}
    found = minimize(objective, start, jac=True, bounds=bounds, method="L-BFGS-B", options=options)
    return float(found.fun - prior.strength * 2 * np.log(unit).sum())


def clarabel_map(comparisons: prefmpc.Comparisons, prior: prefmpc.WishartPrior) -> float:
    """The same as a conic program for Clarabel, through CVXPY: it has n exponential cones."""
    import cvxpy as cp

    data = Features(comparisons)
    nx, nu = len(prior.Q), len(prior.R)
    Q, R = cp.Variable((nx, nx), PSD=True), cp.Variable((nu, nu), PSD=True)
    entries = [Q[i, j] for i, j in zip(*np.tril_indices(nx), strict=True)]
    entries += [R[i, j] for i, j in zip(*np.tril_indices(nu), strict=True)]
    z = data.gap @ cp.hstack(entries)
    objective = cp.sum(cp.logistic(z)) - data.labels @ z
    for W, mode in ((Q, prior.Q), (R, prior.R)):
        objective += prior.strength * (cp.trace(np.linalg.inv(mode) @ W) - cp.log_det(W))
    problem = cp.Problem(cp.Minimize(objective))
    problem.solve(solver=cp.CLARABEL)
    return float(problem.value)


def scipy_recipe(comparisons: prefmpc.Comparisons, starts: prefmpc.QuadraticCost) -> float:
    """The recipe's objective by SciPy's L-BFGS-B with NumPy gradients, one start after another."""
    data = Features(comparisons)
    n = len(comparisons)
    low, high = starts[0].bounds()
    bounds = list(zip(np.asarray(low.theta), np.asarray(high.theta), strict=True))

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        L = data.factor(theta)
        value, slope = data.losses((L @ L.T)[data.rows, data.columns])
        gradient = data.through_factor(L, slope) / n + 2e-6 * theta
        return value / n + 1e-6 * theta @ theta, gradient

    options = {"maxiter": 1000, "ftol": 1e-12, "gtol": 1e-4}
    return min(
        float(
            minimize(
                objective, start, jac=True, bounds=bounds, method="L-BFGS-B", options=options
            ).fun
        )
        for start in np.asarray(starts.theta)
    )


def jaxopt_recipe(
    comparisons: prefmpc.Comparisons, starts: prefmpc.QuadraticCost
) -> Callable[[], float]:
    """The recipe as published: one restart after another on trajectories, jaxopt's L-BFGS-B."""
    first, second = (jax.tree.map(jnp.asarray, side) for side in comparisons.pairs)
    labels = jnp.asarray(comparisons.labels)

    def loss(model: prefmpc.QuadraticCost) -> Any:
        z = jax.vmap(lambda a, b: stage_by_stage(model, b) - stage_by_stage(model, a))(
            first, second
        )
        ridge = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(model))
        return optax.sigmoid_binary_cross_entropy(z, labels).mean() + 1e-6 * ridge

    # implicit_diff and unroll as they come would compile each line search step by step.
    solver = LBFGSB(
        loss, maxiter=1000, history_size=10, tol=1e-3, implicit_diff=False, unroll=False
    )

    @jax.jit
    def train(start: prefmpc.QuadraticCost) -> Any:
        bounds = start.bounds()
        warm = projected_adam(loss, start, bounds, 200, 0.01)
        return loss(solver.run(warm, bounds=bounds).params)

    return lambda: min(float(train(starts[i])) for i in range(len(starts.theta)))


def stage_by_stage(model: prefmpc.QuadraticCost, T: prefmpc.Trajectory) -> Any:
    """σ as the sum over time of eq. (10), step by step."""
    x, u = T.x[:-1], T.u
    return jnp.einsum("ki,ij,kj->", x, model.Q, x) + jnp.einsum("ki,ij,kj->", u, model.R, u)
