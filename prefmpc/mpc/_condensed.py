"""MPC with the states eliminated, in coordinates that keep all digits, for a batch of controllers.

The inputs are U = E x_0 + Y w: the unconstrained plan, which is the closed loop of the LQR of the
same horizon, and what is added to it. With w in the unit of √σ the cost is ½‖w‖² and a constant.
The Hessian of the condensed problem is (Y Yᵀ)⁻¹, and never formed: on an unstable plant it grows
with A to the power of 2N, while Y consists of responses of a closed loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc._limits import MOVES, input_size, unmoved
from prefmpc.systems.linear import LinearSystem


class Sets(NamedTuple):
    """Polyhedra beside the input bounds: H_z (x_k, u_k) ≤ h_z on every stage, H_N x_N ≤ h_N."""

    stage: Any
    stage_limit: Any
    last: Any
    last_limit: Any
    P: Any
    """x_NᵀPx_N is added to σ."""


class Law(NamedTuple):
    """u_k = −K_k x_k + L_kᵀ w_k: the inputs as the states along a plan ask for them."""

    K: Any
    L: Any


class Fixed(NamedTuple):
    """Rows that no input moves are conditions on x_0; the rest says what counts as on the limit."""

    rows: Any
    """Which of the rows (r,) beside the inputs these are."""
    A: Any
    B: Any
    u_size: Any
    Hx: Any
    """The rows in the states (r, nx), see `row_sizes`."""
    h: Any
    unit: Any
    """What the rows were divided by (r,)."""


class CondensedProblem(NamedTuple):
    """min ½‖w‖² over lower ≤ E x_0 + Y w ≤ upper; the first N·nu rows are the inputs / scale.

    All rows of Y have unit length, except for those that no input moves, which are zero.
    """

    Y: Any
    E: Any
    lower: Any
    upper: Any
    scale: Any
    bounds: Any
    """Limits (2, n) of the inputs themselves: what is at a limit is there to the last digit."""
    order: Any
    """Which rows to look at first: with limits on the states, those of early stages. What cannot be
    kept on an unstable plant shows there, before everything grows beyond measure."""
    dual: Any
    """Y Yᵀ, how far one row moves when the multiplier of another grows; None if it is large."""
    fixed: Fixed | None
    law: Law | None


@jax.custom_jvp
def inverse_root(M: Any) -> Any:
    """Return L⁻¹ for a positive definite M = L Lᵀ."""
    return jax.lax.linalg.triangular_solve(
        jax.lax.linalg.cholesky(M, symmetrize_input=False),
        jnp.broadcast_to(jnp.eye(M.shape[-1]), M.shape),
        left_side=True,
        lower=True,
    )


@inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    # By products alone: LAPACK calls that do not depend on each other can wait for each other
    # forever in a thread pool of two.
    root = inverse_root(primals[0])
    turned = root @ tangents[0] @ root.swapaxes(-1, -2)
    half = jnp.tril(turned) - turned * jnp.eye(turned.shape[-1]) / 2
    return root, -half @ root


def condense(
    system: LinearSystem, cost: QuadraticCost, horizon: int, sets: Sets | None = None
) -> CondensedProblem:
    """Eliminate the states of eq. (7) or (12) of arXiv 2511.22502 for one controller."""
    P = jnp.zeros_like(cost.Q) if sets is None or sets.P is None else sets.P
    law = _law(system, cost, horizon, P)
    rows = Sets(None, None, None, None, None) if sets is None else sets
    Y, E = _responses(system, law, rows)
    lower, upper = (jnp.tile(bound, horizon) for bound in (system.u_min, system.u_max))
    limits, states, still = [], [], []
    if rows.stage is not None:
        Hx, Hu = rows.stage[:, : system.nx], rows.stage[:, system.nx :]
        limits.append(jnp.tile(rows.stage_limit, horizon))
        states.append(jnp.tile(Hx, (horizon, 1)))
        still.append(unmoved(system.A, system.B, Hx, Hu, horizon).ravel())
    if rows.last is not None:
        limits.append(rows.last_limit)
        states.append(rows.last)
        still.append(unmoved(system.A, system.B, rows.last, None, horizon + 1)[-1])
    if not limits:
        return _normalised(Y, E, lower, upper, jnp.zeros(len(Y)), None, law)
    left = horizon - np.arange(horizon)
    times: list[Any] = [np.repeat(left, system.nu)]
    if rows.stage is not None:
        times.append(np.repeat(left, len(rows.stage)))
    if rows.last is not None:
        times.append(np.zeros(len(rows.last)))
    order = np.concatenate(times) * (rows.stage is not None)
    h, unit = jnp.concatenate(limits), jnp.ones(())
    size = input_size(system.u_min, system.u_max)
    fixed = Fixed(
        jnp.concatenate(still), system.A, system.B, size, jnp.concatenate(states), h, unit
    )
    lower = jnp.concatenate([lower, jnp.full(len(h), -jnp.inf)])
    upper = jnp.concatenate([upper, h])
    return _normalised(Y, E, lower, upper, jnp.asarray(order, float), fixed, law)


def _law(system: LinearSystem, cost: QuadraticCost, horizon: int, P: Any) -> Law:
    """Return the LQR of the horizon, by the Riccati recursion in Joseph's form."""
    A, B, Q, R = system.A, system.B, cost.Q, cost.R

    def back(P: Any, _: None) -> tuple[Any, Law]:
        L = inverse_root(2 * (R + B.T @ P @ B))
        K = L.T @ (L @ (2 * B.T @ P @ A))
        closed = A - B @ K
        P = Q + K.T @ R @ K + closed.T @ P @ closed
        return (P + P.T) / 2, Law(K, L)

    return jax.lax.scan(back, jnp.asarray(P), None, length=horizon, reverse=True)[1]


def _responses(system: LinearSystem, law: Law, sets: Sets) -> tuple[Any, Any]:
    """Return Y (m, n) and E (m, nx): inputs first, then the rows of the stages, then the last."""
    A, B, nx, nu = system.A, system.B, system.nx, system.nu
    horizon = len(law.K)
    n = horizon * nu

    def step(X: Any, now: tuple[Any, Any, Any]) -> tuple[Any, Any]:
        K, L, here = now
        own = jnp.concatenate([jnp.kron(here, L.T), jnp.zeros((nu, nx))], axis=1)
        U = own - K @ X
        rows = None
        if sets.stage is not None:
            rows = sets.stage[:, :nx] @ X + sets.stage[:, nx:] @ U
        return A @ X + B @ U, (U, rows)

    # The columns are those of w, then those of x_0.
    start = jnp.concatenate([jnp.zeros((nx, n)), jnp.eye(nx)], axis=1)
    last, (U, rows) = jax.lax.scan(step, start, (law.K, law.L, jnp.eye(horizon)))
    parts = [U.reshape(-1, n + nx)]
    if rows is not None:
        parts.append(rows.reshape(-1, n + nx))
    if sets.last is not None:
        parts.append(sets.last @ last)
    responses = jnp.concatenate(parts)
    return responses[:, :n], responses[:, n:]


def scaled(
    H: Any, F: Any, lower: Any, upper: Any, rows: tuple[Any, Any, Any] | None = None
) -> CondensedProblem:
    """Prepare min ½ UᵀHU + (F x_0)ᵀU over lower ≤ U ≤ upper, G U ≤ limits − E x_0.

    ``rows`` are G (r, n), E (r, nx) and limits (r,).
    """
    unit = 1 / jnp.sqrt(jnp.diag(H))
    root = inverse_root((H * unit).T * unit)
    Y = root.T * unit[:, None]
    plan = -Y @ (Y.T @ F)
    if rows is None:
        return _normalised(Y, plan, lower, upper, jnp.zeros(len(Y)), None, None)
    G, E, limits = rows
    nx = F.shape[1]
    still = jnp.linalg.norm(G @ Y, axis=1) <= MOVES * (jnp.abs(G) @ jnp.linalg.norm(Y, axis=1))
    nothing = jnp.zeros((nx, nx)), jnp.zeros((nx, 1)), jnp.zeros(1)
    fixed = Fixed(still, *nothing, E, limits, jnp.ones(()))
    lower = jnp.concatenate([lower, jnp.full(len(limits), -jnp.inf)])
    upper = jnp.concatenate([upper, limits])
    responses = jnp.concatenate([plan, E + G @ plan])
    Y = jnp.concatenate([Y, G @ Y])
    return _normalised(Y, responses, lower, upper, jnp.zeros(len(Y)), fixed, None)


def _normalised(
    Y: Any, E: Any, lower: Any, upper: Any, order: Any, fixed: Fixed | None, law: Law | None
) -> CondensedProblem:
    """Give the rows unit length."""
    # The unit of a row changes no solution: it needs no derivative.
    length = jax.lax.stop_gradient(jnp.linalg.norm(Y, axis=1))
    n = Y.shape[1]
    if fixed is not None:
        still = jnp.concatenate([jnp.zeros(n, bool), fixed.rows | (length[n:] == 0)])
        length = jnp.where(still, 1.0, length)
        Y = jnp.where(still[:, None], 0.0, Y)
        fixed = fixed._replace(rows=still[n:], unit=length[n:])
    Y, E = Y / length[:, None], E / length[:, None]
    dual = Y @ Y.T if len(Y) <= 2 * n else None
    limits, bounds = (lower / length, upper / length), jnp.stack([lower[:n], upper[:n]])
    return CondensedProblem(Y, E, *limits, length[:n], bounds, order, dual, fixed, law)
