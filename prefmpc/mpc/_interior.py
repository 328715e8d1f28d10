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
TOLERANCE = 1e-12
PROOF = 1e-9
"""‖Gᵀz‖∞ relative to −hᵀz > 0: how exactly multipliers have to prove that there is no solution."""

TO_BOUNDARY = 0.99
REFINEMENTS = 2


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
        Px, pull = _times(P, scaled), columns(z)
        on_x = -(Px * t + pull + q * t)
        on_z = -jnp.where(real, rows(x) + s - h * t[..., None], 0.0)
        curve, by_x, by_h = total(scaled, Px), total(q, scaled), total(h, z)
        on_tau = -(kappa + tau * by_x + by_h + tau * curve)

        gap = jnp.abs(curve + by_x + by_h / tau) / (1 + jnp.abs(curve / 2 + by_x))
        primal, dual = jnp.abs(on_z).max((1, 2)) / largest_h, jnp.abs(on_x).max(-1) / largest_q
        worst = jnp.maximum(jnp.maximum(primal, dual) / tau, gap)
        # At a degenerate corner a slack and its multiplier both go to zero, and more slowly.
        both = jnp.where(real, jnp.minimum(s, z), 0.0).max((1, 2)) / tau
        arrived = (worst <= TOLERANCE) & (both <= 100 * TOLERANCE)
        proof = (by_h < 0) & (jnp.abs(pull).max(-1) <= -PROOF * by_h) & ~arrived
        infeasible = state.infeasible | (proof & ~state.done)
        done = state.done | arrived | proof

        weight = z / s
        root = inverse_root(weight)
        slope = q + 2 * Px

        def solved(on_x: Any, on_z: Any) -> tuple[Any, Any]:
            """Solve P dx + Gᵀdz = on_x and G dx − dz/weight = on_z."""

            def refined(_: Any, both: tuple[Any, Any]) -> tuple[Any, Any]:
                # Near the solution weights reach 1e10 and more: what rounding has left over.
                dx, dz = both
                more = on_x - _times(P, dx) - columns(dz)
                more = _back(root, _times(root, more))
                return dx + more, dz + weight * rows(more)

            first = jnp.zeros_like(x), -weight * on_z
            return jax.lax.fori_loop(0, 1 + REFINEMENTS, refined, first)

        x_tau, z_tau = solved(-q, h)
        bend = -kappa / tau + total(slope, x_tau) + total(h, z_tau) - curve

        def length(d: _Point) -> Any:
            def room(v: Any, dv: Any) -> Any:
                return jnp.where(dv < 0, -v / jnp.where(dv < 0, dv, 1.0), jnp.inf)

            parts = [room(s, d.s).min((1, 2)), room(z, d.z).min((1, 2))]
            parts += [room(tau, d.tau), room(kappa, d.kappa)]
            return jnp.minimum(jnp.stack(parts).min(0), 1.0)

        mu = (total(s, z) + tau * kappa) / count

        def newton(_: Any, last: _Point) -> _Point:
            """Mehrotra's predictor if ``last`` is 0, and the corrector that follows it."""
            keep = (1 - length(last)) ** 3
            rest = 1 - keep
            on_sz = jnp.where(real, _column(keep * mu) - s * z - last.s * last.z, 0.0)
            on_tk = keep * mu - kappa * tau - last.tau * last.kappa
            shift = jnp.where(real, _column(rest) * on_z - on_sz / jnp.where(real, z, 1.0), 0.0)
            dx, dz = solved(rest[:, None] * on_x, shift)
            dtau = (rest * on_tau - on_tk / tau - total(slope, dx) - total(h, dz)) / bend
            dx, dz = dx + dtau[:, None] * x_tau, dz + _column(dtau) * z_tau
            ds = jnp.where(real, (on_sz - s * dz) / jnp.where(real, z, 1.0), 0.0)
            return _Point(dx, ds, dz, dtau, (on_tk - kappa * dtau) / tau)

        none = jax.tree.map(jnp.zeros_like, state.point)
        bent = jax.lax.fori_loop(0, 2, newton, none)
        step = jnp.minimum(TO_BOUNDARY * length(bent), 1.0)
        done |= ~(jnp.isfinite(step) & jnp.isfinite(bent.x).all(-1))

        def moved(v: Any, dv: Any) -> Any:
            axes = (-1,) + (1,) * (v.ndim - 1)
            return jnp.where(done.reshape(axes), v, v + step.reshape(axes) * dv)

        point = jax.tree.map(moved, state.point, bent)
        return k + 1, _State(point, done, infeasible, state.count + ~done)

    nothing = jnp.zeros(len(q), dtype=bool)
    begin = _State(start(), skip, nothing, jnp.zeros(len(q), dtype=int))
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] <= LIMIT) & ~jnp.all(carry[1].done), move, (0, begin)
    )
    back = size / end.point.tau
    z = end.point.z * _column(back)
    return Interior(end.point.x * back[:, None], z[:, 0] - z[:, 1], end.infeasible, end.count)
