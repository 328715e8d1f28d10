"""Costs of trajectories as quadratic forms of x(0), the input before, and the inputs to come.

A cost vᵀWv of v = (x_0, u_before, U) or v = (x_0, U) is all that an MPC with input bounds needs:
the plant is in W.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._pytree import stacked
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.models.signals import Signal
from prefmpc.mpc._batched_qp import SOLVED, solve
from prefmpc.mpc._condensed import CondensedProblem, scaled
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem

PRECISION = 1e-6
"""Error of a plan, relative to its largest input, that counts as solved."""


def responses(system: LinearSystem, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Φ (N, nx, nx) and Γ (N, nx, N·nu): x_k = Φ_k x_0 + Γ_k U."""
    Phi = np.stack([np.linalg.matrix_power(system.A, k) for k in range(horizon)])
    Gamma = np.zeros((horizon, system.nx, horizon, system.nu))
    for k in range(1, horizon):
        Gamma[k, :, :k] = np.swapaxes(Phi[k - 1 :: -1] @ system.B, 0, 1)
    return Phi, Gamma.reshape(horizon, system.nx, -1)


def trajectory_rows(system: LinearSystem, signals: Sequence[Signal], horizon: int) -> np.ndarray:
    """Return Z (N, n, nx + nu + N·nu): the signals at step k are Z_k (x_0, u_before, U).

    For "x", "y", "du" and "dy", in the order of `prefmpc.select`.
    """
    nx, nu = system.nx, system.nu
    Phi, Gamma = responses(system, horizon)
    X = np.concatenate([Phi, np.zeros((horizon, nx, nu)), Gamma], axis=2)
    U = np.eye(nu + horizon * nu).reshape(horizon + 1, nu, -1)
    U = np.concatenate([np.zeros((horizon + 1, nu, nx)), U], axis=2)
    Y = system.C @ X
    known = {"x": X, "y": Y, "du": np.diff(U, axis=0), "dy": np.diff(Y, axis=0, prepend=Y[:1])}
    return np.concatenate([known[name] for name in signals], axis=1)


def condensed_weights(Z: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return W with Σ_k z_kᵀQz_k + u_kᵀRu_k = vᵀWv, for v = (x_0, u_before, U) and z_k = Z_k v."""
    W = np.einsum("kai,ab,kbj->ij", Z, Q, Z)
    inputs = len(Z) * len(R)
    W[-inputs:, -inputs:] += np.kron(np.eye(len(Z)), R)
    return W


def learned_weights(cost: QuadraticCost, nx: int) -> np.ndarray:
    """Return W over (x_0, U) of a quadratic of the view "x0"; its R weighs u_0 once more."""
    W = np.array(cost.Q)
    nu = cost.R.shape[-1]
    W[nx : nx + nu, nx : nx + nu] += cost.R
    return W


def input_problem(W: np.ndarray, n: int, u_max: np.ndarray) -> CondensedProblem:
    """Return min vᵀWv over abs(U) ≤ u_max for v = (what is given (n,), U): no plant is needed."""
    upper = np.tile(u_max, (len(W) - n) // len(u_max))
    return scaled(2 * W[n:, n:], 2 * W[n:, :n], -upper, upper)


def plans(W: np.ndarray, given: np.ndarray, system: LinearSystem) -> np.ndarray:
    """Return the plans U (m, N, nu) that minimise vᵀWv for every row of ``given`` (m, n)."""
    problem = input_problem(W, given.shape[-1], system.u_max)
    single = jax.tree.map(lambda leaf: leaf[None], problem)
    answer = jax.jit(solve)(single, given[None], PRECISION)
    if not np.all(answer.status == SOLVED):
        raise RuntimeError("a plan was not solved")
    return np.asarray(answer.U).reshape(len(given), -1, system.nu)


def blind_to_before(W: np.ndarray, system: LinearSystem) -> np.ndarray:
    """Return weights over (x_0, u_before, U) that are those over (x_0, U): u_before costs 0."""
    nx, nu = system.nx, system.nu
    return np.insert(np.insert(W, [nx] * nu, 0.0, axis=0), [nx] * nu, 0.0, axis=1)


def weight_loops(
    system: LinearSystem, weights: Sequence[np.ndarray], x0: np.ndarray, steps: int
) -> Trajectory:
    """Return the closed loops (c, m) of several W over (x_0, u_before, U) from x0 (m, nx).

    The input before the first one is 0. Raises a RuntimeError if a problem is not solved.
    """
    count = len(weights)
    filled = [*weights, *[weights[-1]] * (-count % 8)]  # few shapes to compile
    problems = [input_problem(W, system.nx + system.nu, system.u_max) for W in filled]
    stack = stacked(problems)
    x, u = (np.asarray(part)[:count] for part in _loops(system, stack, x0, steps))
    if not np.isfinite(u).all():
        raise RuntimeError("a closed loop met an MPC problem that was not solved")
    rest = np.zeros((*u.shape[:2], system.nu))
    return Trajectory(x, u, system.output(x[..., :-1, :]), u_before=rest)


@jax.jit(static_argnums=3)
def _loops(system: LinearSystem, problems: Any, x0: Any, steps: int) -> Any:
    def step(now: Any, _: None) -> tuple[Any, tuple[Any, Any]]:
        x, before = now
        answer = solve(problems, jnp.concatenate([x, before], axis=-1), PRECISION)
        u = jnp.where((answer.status == SOLVED)[..., None], answer.U[..., : system.nu], jnp.nan)
        x_next = system.step(x, u)
        return (x_next, u), (x_next, u)

    count = len(problems.scale)
    start = jnp.broadcast_to(x0, (count, *x0.shape)), jnp.zeros((count, len(x0), system.nu))
    _, (x, u) = jax.lax.scan(step, start, None, length=steps)
    x = jnp.concatenate([start[0][None], x])
    return jnp.moveaxis(x, 0, 2), jnp.moveaxis(u, 0, 2)
