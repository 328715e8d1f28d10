"""A primal-dual interior-point method for many small quadratic programs side by side.

min ½ xᵀPx + qᵀx over l ≤ G x ≤ u, with P ≻ 0, through the homogeneous embedding of Goulart and
Chen (arXiv 2405.12762): a scalar τ ends at 0 instead of 1 where the problem is infeasible, and
the multipliers then are the proof. Predictor and corrector steps as Mehrotra's; each problem is
frozen when it is done.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax.linalg import cholesky, triangular_solve

LIMIT = 50
TOLERANCE = 1e-10
PROOF = 1e-9
"""‖Gᵀz‖∞ relative to −hᵀz > 0: how exactly multipliers have to prove that there is no solution."""

TO_BOUNDARY = 0.99


class _Point(NamedTuple):
    """x (b, n); slacks s and multipliers z (b, 2, m) of upper and lower limits; τ and κ (b,)."""

    x: Any
    s: Any
    z: Any
    tau: Any
    kappa: Any


class _State(NamedTuple):
    point: _Point
    done: Any
    infeasible: Any
    count: Any


class Interior(NamedTuple):
    """x (b, n), multipliers (b, m) of u minus those of l, proven infeasible (b,), steps (b,)."""

    x: Any
    multipliers: Any
    infeasible: Any
    count: Any


def _times(M: Any, v: Any) -> Any:
    return jnp.einsum("bij,bj->bi", M, v)


def _back(M: Any, v: Any) -> Any:
    return jnp.einsum("bij,bi->bj", M, v)


def _column(a: Any) -> Any:
    return a[:, None, None]


def interior_point(P: Any, q: Any, G: Any, lower: Any, upper: Any, skip: Any) -> Interior:
    """Solve b problems: P (b, n, n), q (b, n), G (b, m, n), lower and upper (b, m).

    Where ``skip`` (b,) nothing is done. Infinite limits are none.
    """
    limits = jnp.stack([upper, -lower], axis=1)
    real = jnp.isfinite(limits) & ~_column(skip)
    h = jnp.where(real, limits, 0.0)
    q = jnp.where(skip[:, None], 0.0, q)
    # In units in which the solution has about the size 1.
    size = jnp.maximum(jnp.abs(q).max(-1), 1e-12)
    q, h = q / size[:, None], h / _column(size)
    count = jnp.sum(real, axis=(1, 2)) + 1
    largest_q, largest_h = 1 + jnp.abs(q).max(-1), 1 + jnp.abs(h).max((1, 2))

    def rows(x: Any) -> Any:
        """G x for upper and −G x for lower limits."""
        y = _times(G, x)
        return jnp.where(real, jnp.stack([y, -y], axis=1), 0.0)

    def columns(z: Any) -> Any:
        return _back(G, z[:, 0] - z[:, 1])

    def total(a: Any, b: Any) -> Any:
        return jnp.sum(a * b, axis=tuple(range(1, a.ndim)))

    def inverse_root(weight: Any) -> Any:
        """L⁻¹ of P + Gᵀ diag(weight) G = L Lᵀ: products with it are cheaper than solves."""
        M = P + jnp.swapaxes(G, 1, 2) @ (G * weight.sum(1)[..., None])
        eye = jnp.broadcast_to(jnp.eye(q.shape[1]), M.shape)
        root = cholesky(M, symmetrize_input=False)
        return triangular_solve(root, eye, left_side=True, lower=True)

    def start() -> _Point:
        root = inverse_root(jnp.where(real, 1.0, 0.0))
        x = _back(root, _times(root, columns(h) - q))
        z = rows(x) - h

        def positive(v: Any) -> Any:
            lowest = jnp.where(real, v, jnp.inf).min((1, 2))
            return jnp.where(real, v + _column(jnp.where(lowest > 1e-8, 0.0, 1 - lowest)), 0.0)

        one = jnp.ones(len(q))
        return _Point(x, jnp.where(real, positive(-z), 1.0), positive(z), one, one)

    def move(carry: tuple[Any, _State]) -> tuple[Any, _State]:
        k, state = carry
        x, s, z, tau, kappa = state.point
        t, scaled = tau[:, None], x / tau[:, None]
        Px = _times(P, scaled)
        on_x = -(Px * t + columns(z) + q * t)
        on_z = -jnp.where(real, rows(x) + s - h * t[..., None], 0.0)
        on_tau = -(kappa + total(q, x) + total(h, z) + total(x, Px))
        weight = z / s
        root = inverse_root(weight)
        slope = q + 2 * Px

        def solved(right: Any) -> Any:
            return _back(root, _times(root, right))

        x_tau = solved(columns(weight * h) - q)
        z_tau = weight * (rows(x_tau) - h)
        bend = -kappa / tau + total(slope, x_tau) + total(h, z_tau) - total(scaled, Px)

        def direction(keep: Any, on_sz: Any, on_tk: Any) -> _Point:
            """Newton's step to residuals ``keep`` times as large, with given products s∘z, τκ."""
            rest = 1 - keep
            shift = jnp.where(real, _column(rest) * on_z - on_sz / jnp.where(real, z, 1.0), 0.0)
            dx = solved(rest[:, None] * on_x + columns(weight * shift))
            dz = weight * (rows(dx) - shift)
            dtau = (rest * on_tau - on_tk / tau - total(slope, dx) - total(h, dz)) / bend
            dx, dz = dx + dtau[:, None] * x_tau, dz + _column(dtau) * z_tau
            for _ in range(2):
                # Near the solution the weights reach 1e10 and more: what rounding has left over.
                error = rest[:, None] * on_x - _times(P, dx) - columns(dz) - q * dtau[:, None]
                more = solved(error)
                dx, dz = dx + more, dz + weight * rows(more)
            ds = jnp.where(real, (on_sz - s * dz) / jnp.where(real, z, 1.0), 0.0)
            return _Point(dx, ds, dz, dtau, (on_tk - kappa * dtau) / tau)

        def length(d: _Point) -> Any:
            def room(v: Any, dv: Any) -> Any:
                return jnp.where(dv < 0, -v / jnp.where(dv < 0, dv, 1.0), jnp.inf)

            parts = [room(s, d.s).min((1, 2)), room(z, d.z).min((1, 2))]
            parts += [room(tau, d.tau), room(kappa, d.kappa)]
            return jnp.minimum(jnp.stack(parts).min(0), 1.0)

        mu = (total(s, z) + tau * kappa) / count
        straight = direction(jnp.zeros_like(tau), -s * z, -kappa * tau)
        keep = (1 - length(straight)) ** 3
        bent = direction(
            keep,
            jnp.where(real, _column(keep * mu) - s * z - straight.s * straight.z, 0.0),
            keep * mu - kappa * tau - straight.tau * straight.kappa,
        )
        step = jnp.minimum(TO_BOUNDARY * length(bent), 1.0)
        broken = ~(jnp.isfinite(step) & jnp.isfinite(bent.x).all(-1))
        stay = state.done | broken

        def moved(v: Any, dv: Any) -> Any:
            axes = (-1,) + (1,) * (v.ndim - 1)
            return jnp.where(stay.reshape(axes), v, v + step.reshape(axes) * dv)

        point = jax.tree.map(moved, state.point, bent)
        arrived, proof = _verdict(point)
        infeasible = state.infeasible | (proof & ~arrived & ~state.done)
        done = state.done | broken | arrived | proof
        return k + 1, _State(point, done, infeasible, state.count + ~state.done)

    def _verdict(point: _Point) -> tuple[Any, Any]:
        """Whether the point is optimal, and whether it proves that there is none."""
        x, s, z, tau, _ = point
        t, scaled = tau[:, None], x / tau[:, None]
        Px, pull = _times(P, scaled), columns(z)
        primal = jnp.abs(jnp.where(real, rows(scaled) + (s / t[..., None]) - h, 0.0)).max((1, 2))
        dual = jnp.abs(Px + pull / t + q).max(-1)
        curve, by_h = total(scaled, Px), total(h, z)
        value = curve / 2 + total(q, scaled)
        gap = jnp.abs(value + curve / 2 + by_h / tau) / (1 + jnp.abs(value))
        worst = jnp.stack([primal / largest_h, dual / largest_q, gap]).max(0)
        return worst <= TOLERANCE, (by_h < 0) & (jnp.abs(pull).max(-1) <= -PROOF * by_h)

    nothing = jnp.zeros(len(q), dtype=bool)
    begin = _State(start(), skip, nothing, jnp.zeros(len(q), dtype=int))
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] < LIMIT) & ~jnp.all(carry[1].done), move, (0, begin)
    )
    back = size / end.point.tau
    z = end.point.z * _column(back)
    return Interior(end.point.x * back[:, None], z[:, 0] - z[:, 1], end.infeasible, end.count)
