"""MPC with the states eliminated: a quadratic program in the inputs, for a batch of controllers."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc.models import QuadraticCost
from prefmpc.systems import LinearSystem

ON_LIMIT = 1e-6
"""How far beyond a limit x_0 may be, in the unit of the limit, to count as on it."""


class Sets(NamedTuple):
    """Polyhedra beside the input bounds: H_z (x_k, u_k) ≤ h_z on every stage, H_N x_N ≤ h_N."""

    stage: Any
    stage_limit: Any
    last: Any
    last_limit: Any
    P: Any
    """x_NᵀPx_N is added to σ."""


class CondensedProblem(NamedTuple):
    """min ½ VᵀHV + (F x_0)ᵀV over lower − E x_0 ≤ G V ≤ upper − E x_0; the inputs are scale·V.

    The first N·nu rows of G are the identity: the input bounds. H has a unit diagonal, the other
    rows of G have unit length. G and E are None if there is nothing but input bounds.
    """

    H: Any
    inverse: Any
    """H⁻¹"""
    dual: Any
    """G H⁻¹ Gᵀ (m, m): how far one row moves when the multiplier of another grows."""
    F: Any
    G: Any
    E: Any
    lower: Any
    upper: Any
    scale: Any
    amplification: Any
    """How much farther than a projected gradient step the optimum may be, in units of the input."""
    step: Any
    """1/L: the length of a safe gradient step."""


def responses(system: LinearSystem, horizon: int) -> tuple[Any, Any]:
    """Return Φ (N + 1, nx, nx) and Γ (N + 1, nx, N·nu): x_k = Φ_k x_0 + Γ_k U."""
    A, B = jnp.asarray(system.A), jnp.asarray(system.B)
    _, Phi = jax.lax.scan(lambda P, _: (A @ P, P), jnp.eye(system.nx), None, length=horizon + 1)
    delay = np.arange(horizon + 1)[:, None] - np.arange(horizon) - 1  # steps from u_j until x_k
    blocks = jnp.where(delay[..., None, None] >= 0, (Phi @ B)[np.maximum(delay, 0)], 0.0)
    return Phi, blocks.swapaxes(1, 2).reshape(horizon + 1, system.nx, horizon * system.nu)


@jax.custom_jvp
def inverse_of(H: Any) -> Any:
    """Return H⁻¹ of a positive definite matrix."""
    root = jax.lax.linalg.triangular_solve(
        jax.lax.linalg.cholesky(H, symmetrize_input=False),
        jnp.eye(H.shape[-1]),
        left_side=True,
        lower=True,
    )
    return root.T @ root


@inverse_of.defjvp
def _inverse_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    # By products alone: LAPACK calls that do not depend on each other can wait for each other
    # forever in a thread pool of two.
    inverse = inverse_of(primals[0])
    return inverse, -inverse @ tangents[0] @ inverse


def _largest_eigenvalue(H: Any) -> Any:
    """Return an upper bound, at most n^{1/8} times too high: the largest row sum of H⁸, ^(1/8)."""
    size = jnp.abs(H).sum(-1).max(-1)
    power = H / size
    for _ in range(3):
        power = power @ power
    return size * jnp.abs(power).sum(-1).max(-1) ** 0.125


def condense(
    system: LinearSystem, cost: QuadraticCost, horizon: int, sets: Sets | None = None
) -> CondensedProblem:
    """Eliminate the states of eq. (7) or (12) of arXiv 2511.22502 for one controller."""
    Phi, Gamma = responses(system, horizon)
    Q = jnp.broadcast_to(cost.Q, (horizon, *cost.Q.shape))
    P = jnp.zeros_like(cost.Q) if sets is None or sets.P is None else sets.P
    weighted = jnp.concatenate([Q, P[None]]) @ Gamma
    n = horizon * system.nu
    columns, flat = Gamma.reshape(-1, n), weighted.reshape(-1, n)
    H = 2 * (columns.T @ flat + jnp.kron(jnp.eye(horizon), cost.R))
    F = 2 * flat.T @ Phi.reshape(-1, system.nx)
    lower, upper = (jnp.tile(bound, horizon) for bound in (system.u_min, system.u_max))
    if sets is None or (sets.stage is None and sets.last is None):
        return scaled(H, F, lower, upper)
    return scaled(H, F, lower, upper, _rows(sets, Phi, Gamma, system.nu))


def scaled(
    H: Any, F: Any, lower: Any, upper: Any, rows: tuple[Any, Any, Any] | None = None
) -> CondensedProblem:
    """Prepare min ½ UᵀHU + (F x_0)ᵀU over lower ≤ U ≤ upper, G U ≤ limits − E x_0.

    ``rows`` are G (r, n), E (r, nx) and limits (r,).
    """
    n = len(H)
    scale = 1 / jnp.sqrt(jnp.diag(H))
    H = (H * scale).T * scale
    H = (H + H.T) / 2
    inverse = inverse_of(H)
    lower, upper = lower / scale, upper / scale
    G = E = None
    dual = inverse
    if rows is not None:
        G, E, limits = rows
        # The unit of a row changes no solution: it needs no derivative.
        length = jax.lax.stop_gradient(jnp.linalg.norm(G * scale, axis=1))
        # What no input moves is a condition on x_0: one that lies on a limit keeps to it, even if
        # rounding has pushed it over.
        moves = length > 1e-12
        limits = limits + jnp.where(moves, 0.0, ON_LIMIT)
        length = jnp.where(moves, length, 1.0)[:, None]
        G = jnp.concatenate([jnp.eye(n), G * scale / length])
        E = jnp.concatenate([jnp.zeros((n, E.shape[1])), E / length])
        lower = jnp.concatenate([lower, jnp.full(len(limits), -jnp.inf)])
        upper = jnp.concatenate([upper, limits / length[:, 0]])
        dual = G @ inverse @ G.T
    largest, least = _largest_eigenvalue(H), 1 / _largest_eigenvalue(inverse)
    return CondensedProblem(
        H=H,
        inverse=inverse,
        dual=dual,
        F=F * scale[:, None],
        G=G,
        E=E,
        lower=lower,
        upper=upper,
        scale=scale,
        amplification=jax.lax.stop_gradient((largest / least - 1) * jnp.max(scale)),
        step=jax.lax.stop_gradient(1 / largest),
    )


def _rows(sets: Sets, Phi: Any, Gamma: Any, nu: int) -> tuple[Any, Any, Any]:
    """Return G, E, limits of the rows G U ≤ limits − E x_0 that the polyhedra make."""
    horizon, nx, n = len(Phi) - 1, Phi.shape[1], Gamma.shape[-1]
    G, E, limits = [], [], []
    if sets.stage is not None:
        Hx, Hu = sets.stage[:, :nx], sets.stage[:, nx:]
        now = jnp.eye(n).reshape(horizon, nu, n)
        G.append((Hx @ Gamma[:-1] + Hu @ now).reshape(-1, n))
        E.append((Hx @ Phi[:-1]).reshape(-1, nx))
        limits.append(jnp.tile(sets.stage_limit, horizon))
    if sets.last is not None:
        G.append(sets.last @ Gamma[-1])
        E.append(sets.last @ Phi[-1])
        limits.append(sets.last_limit)
    return jnp.concatenate(G), jnp.concatenate(E), jnp.concatenate(limits)
