"""The convex problem of the most probable (Q, R) in the form that Newton's method wants."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.sharding import Mesh

from prefmpc._checks import to_numpy
from prefmpc._sharding import WHOLE, on_mesh, shares
from prefmpc.learning.priors import WishartPrior
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.trajectories import Trajectory, second_moments

BLOCK = 4096
"""Comparisons that are worked on at a time; sizes above are padded to powers of two."""


class Entries(NamedTuple):
    """The free entries w (p,) of W = blkdiag(Q, R) (d, d), lower triangle."""

    rows: Any
    columns: Any
    basis: Any
    """(p, d, d): W = Σ_a w_a·basis_a."""

    @classmethod
    def of(cls, rows: np.ndarray, columns: np.ndarray) -> Entries:
        """Prepare the basis."""
        basis = np.zeros((rows.size,) + (rows.max() + 1,) * 2)
        number = np.arange(rows.size)
        basis[number, rows, columns] = basis[number, columns, rows] = 1.0
        return cls(rows, columns, basis)

    def matrix(self, w: Any) -> Any:
        """Return W (..., d, d) from w (..., p)."""
        p, d = self.basis.shape[:2]
        return (w @ self.basis.reshape(p, d * d)).reshape(*w.shape[:-1], d, d)

    def gradient(self, M: Any) -> Any:
        """Return the derivative (p,) of tr(M W) with respect to w, for a symmetric M (d, d)."""
        return self.basis.reshape(len(self.rows), -1) @ M.reshape(-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Minimise Σ cross-entropy(gapᵀw) − strength·[log det W − tr(mode⁻¹W)] over W ≻ 0.

    In units in which a prior's mode has a unit diagonal: nothing then depends on the units of
    x and u. W in the user's units is ``W / unit / unit[:, None]``.
    """

    entries: Entries
    unit: np.ndarray
    """(d,)"""
    gap: np.ndarray
    """(p, size): second moments of the second trajectory minus those of the first."""
    labels: np.ndarray
    weights: np.ndarray
    """(size,): 1 for a comparison, 0 for padding."""
    mode: np.ndarray
    strength: float

    @property
    def log_unit(self) -> float:
        """log det W in the problem's units minus that in the user's."""
        return 2 * float(np.log(self.unit).sum())

    def in_user_units(self, w: np.ndarray) -> np.ndarray:
        """Return matrices W (..., d, d) in the user's units from w (..., p)."""
        return np.asarray(self.entries.matrix(w)) / self.unit / self.unit[:, None]


def signals(trajectories: Trajectory, outputs: np.ndarray | None) -> Trajectory:
    """Return the trajectories of what is weighed: the states, or y = ``outputs`` @ x."""
    if outputs is None:
        return trajectories
    return Trajectory(np.asarray(trajectories.x) @ outputs.T, trajectories.u)


def scaled_moments(
    trajectories: Trajectory, rows: np.ndarray, columns: np.ndarray, unit: np.ndarray
) -> np.ndarray:
    """Return the second moments (p, n_t) that belong to the free entries, in the given units."""
    with np.errstate(over="ignore"):
        moments = _block_diagonal(*(np.asarray(S) for S in second_moments(trajectories)))
    if not np.isfinite(moments).all():
        raise ValueError("comparisons must have finite second moments, got an overflow")
    count = np.where(rows == columns, 1.0, 2.0)
    return moments[:, rows, columns].T * (count / (unit[rows] * unit[columns]))[:, None]


def build(
    comparisons: Comparisons,
    priors: Sequence[WishartPrior],
    entries: Entries,
    outputs: np.ndarray | None,
    size: int,
) -> list[Problem]:
    """Prepare one problem for each prior, all in the units of the first.

    Padded to ``size`` comparisons with some of weight 0.
    """
    n = len(comparisons)
    modes = [_block_diagonal(prior.Q, prior.R) for prior in priors]
    unit = 1 / np.sqrt(np.diag(modes[0]))
    gap = np.zeros((entries.rows.size, size))
    gap[:, :n] = pair_gaps(comparisons, entries, unit, outputs)
    labels, weights = np.zeros(size), np.zeros(size)
    labels[:n], weights[:n] = comparisons.labels, 1.0
    return [
        Problem(
            entries, unit, gap, labels, weights, W0 * unit * unit[:, None], float(prior.strength)
        )
        for W0, prior in zip(modes, priors, strict=True)
    ]


def pair_gaps(
    comparisons: Comparisons, entries: Entries, unit: np.ndarray, outputs: np.ndarray | None
) -> np.ndarray:
    """Return the differences (p, n) of second moments, in the given units."""
    trajectories = signals(comparisons.trajectories, outputs)
    pool = scaled_moments(trajectories, entries.rows, entries.columns, unit)
    gap = pool.take(comparisons.second, axis=1)
    gap -= pool.take(comparisons.first, axis=1)
    return gap


def _block_diagonal(Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return blkdiag(Q, R) (..., d, d)."""
    n, d = Q.shape[-1], Q.shape[-1] + R.shape[-1]
    W = np.zeros((*Q.shape[:-2], d, d))
    W[..., :n, :n], W[..., n:, n:] = Q, R
    return W


def loss_and_slopes(z: Any, labels: Any, weights: Any) -> tuple[Any, Any, Any]:
    """Return Σ cross-entropy, and its first and second derivatives with respect to z (size,)."""
    p = jax.nn.sigmoid(z)
    return loss(z, labels, weights), weights * (p - labels), weights * p * (1 - p)


def second_order(gap: Any, slope: Any, curvature: Any) -> Any:
    """Return the data's Hessian gap·diag(curvature)·gapᵀ (p, p), and below it gap·slope.

    One pass over the data; many comparisons go through the cache block by block.
    """
    p, size = gap.shape

    def block(gap: Any, slope: Any, curvature: Any) -> Any:
        return jnp.concatenate([gap * curvature, slope[None]]) @ gap.T

    if size <= BLOCK:
        return block(gap, slope, curvature)

    def add(k: Any, total: Any) -> Any:
        parts = [
            jax.lax.dynamic_slice_in_dim(a, k * BLOCK, BLOCK, -1) for a in (gap, slope, curvature)
        ]
        return total + block(*parts)

    return jax.lax.fori_loop(0, size // BLOCK, add, jnp.zeros((p + 1, p)))


def loss(z: Any, labels: Any, weights: Any) -> Any:
    """Return Σ cross-entropy."""
    # log(1 + e) instead of log1p(e): below 1e-16 nothing is left in the sum anyway, and faster.
    return weights @ (jnp.maximum(z, 0) + jnp.log(1 + jnp.exp(-jnp.abs(z))) - labels * z)


def product_hessian(A: Any, B: Any, entries: Entries) -> Any:
    """Return the matrix (p, p) of the quadratic form tr(dW A dW B), for symmetric A and B (d, d).

    With A = W⁻¹ and B = strength·W⁻¹ it is the Hessian of −strength·log det W.
    """
    p = len(entries.rows)
    left, right = entries.basis @ A, (entries.basis @ B).swapaxes(1, 2)
    return left.reshape(p, -1) @ right.reshape(p, -1).T


def factor(M: Any) -> Any:
    """Return the Cholesky factor, NaN if there is none."""
    return jax.lax.linalg.cholesky(M, symmetrize_input=False)


class Minimum(NamedTuple):
    """What `newton` found: w (p,), the objective, its decrement λ²/2 and Hessian (p, p)."""

    w: Any
    objective: Any
    log_likelihood: Any
    decrement: Any
    hessian: Any
    steps: Any

    def converged(self, tol: float) -> bool:
        """Whether the decrement certifies the minimum; the last step may have moved the value."""
        numbers = [np.isfinite(part).all() for part in (self.w, self.objective, self.decrement)]
        # Nothing is small beside an infinite objective.
        return all(numbers) and bool(self.decrement <= 1.01 * tol * (1 + abs(self.objective)))


TO_BOUNDARY = 0.95
"""No step goes further towards a singular matrix than this share of the way."""

SHRINK = 4.0
"""What scale and strength of the prior come nearer by, from one problem of the path to the next."""

LOG_ODDS = 100.0
"""Size of the log-odds where the path begins: more, and wrong ones have no curvature left."""


ALMOST = 1e-4
"""The dual's Hessian is trusted to this decrement; from there on the exact one is used."""


class _State(NamedTuple):
    w: Any
    z: Any
    dual: Any
    """Z (d, d): strength·W⁻¹ in the end."""
    strength: Any
    tightness: Any
    """1 / scale of the prior's mode, relative to the wanted scale."""
    objective: Any
    decrement: Any
    hessian: Any
    steps: Any
    stuck: Any


def _here(value: Any) -> Any:
    return value


def newton(
    gap: Any,
    labels: Any,
    weights: Any,
    entries: Entries,
    mode: Any,
    wanted: Any,
    tol: Any,
    limit: Any,
    total: Callable[[Any], Any] = _here,
) -> Minimum:
    """Minimise by primal-dual Newton steps along a path of ever weaker priors.

    The path begins with a prior of so small a scale that no answer is far from the model, and so
    strong that its mode is nearly the minimum, and ends with the wanted one. The curvature of
    −log det W is taken as W⁻¹⊗Z with a dual Z instead of strength·W⁻¹⊗W⁻¹: a small eigenvalue of
    W then grows to its place at once, where it would else double in each step. At the end of the
    path the exact Hessian takes over, and its decrement is the certificate.

    ``total`` adds up what is a sum over comparisons, where these are shared among devices: each
    then takes the same steps.

    The calls to LAPACK depend on each other, one after the other: two that do not can wait for
    each other forever in a small thread pool.
    """
    eye = jnp.eye(mode.shape[0])

    def invert(W: Any) -> Any:
        root = solve_triangular(factor(W), eye, lower=True)
        return root.T @ root

    precision = entries.gradient(invert(mode))

    def objective(w: Any, z: Any, strength: Any, tightness: Any) -> Any:
        # NaN outside of the cone, where Cholesky fails.
        L = factor(entries.matrix(w))
        log_det = 2 * jnp.sum(jnp.log(jnp.diag(L)))
        return total(loss(z, labels, weights)) + strength * (tightness * (precision @ w) - log_det)

    def solve_newton(hessian: Any, gradient: Any) -> tuple[Any, Any]:
        unit = 1 / jnp.sqrt(jnp.diag(hessian))
        L = factor(hessian * unit * unit[:, None])
        half = solve_triangular(L, gradient * unit, lower=True)
        return -unit * solve_triangular(L, half, lower=True, trans=1), half @ half / 2

    def unfinished(state: _State) -> Any:
        return (state.steps < limit) & ~small(state) & ~state.stuck

    def small(state: _State) -> Any:
        return state.decrement <= tol * (1 + jnp.abs(state.objective))

    def move(state: _State) -> _State:
        w, z, dual = state.w, state.z, state.dual
        strength, tightness = state.strength, state.tightness
        arrived = (strength <= wanted) & (tightness <= 1)
        W = entries.matrix(w)
        inverse = invert(W)
        _, slope, curvature = loss_and_slopes(z, labels, weights)
        both = total(second_order(gap, slope, curvature))
        gradient = both[-1] + strength * (tightness * precision - entries.gradient(inverse))
        # Near the end Z = strength·W⁻¹ up to rounding; then the exact Hessian is as good.
        last = arrived & (state.decrement <= ALMOST * (1 + jnp.abs(state.objective)))
        partner = jnp.where(last, strength * inverse, dual)
        hessian = both[:-1] + product_hessian(inverse, partner, entries)
        step, decrement = solve_newton(hessian, gradient)

        now = objective(w, z, strength, tightness)
        dW, dz = entries.matrix(step), step @ gap
        slack = 1e-13 * (1 + jnp.abs(now))

        def refused(search: Any) -> Any:
            t, trial = search
            return ~(trial <= now - 0.05 * t * decrement + slack) & (t > 1e-12)

        def shorter(search: Any) -> Any:
            t = search[0] * 0.6
            room = factor(W + t / TO_BOUNDARY * dW)[-1, -1]  # NaN if the boundary is too near
            trial = objective(w + t * step, z + t * dz, strength, tightness)
            return t, jnp.where(jnp.isnan(room), jnp.nan, trial)

        t: Any
        t, trial = jax.lax.while_loop(refused, shorter, (1 / 0.6, jnp.nan))
        turned = inverse @ dW @ dual
        change = strength * inverse - dual - (turned + turned.T) / 2
        t, change = jax.lax.optimization_barrier((t, change))  # LAPACK again: after the line search

        def outside(s: Any) -> Any:
            return jnp.isnan(factor(dual + s / TO_BOUNDARY * change)[-1, -1]) & (s > 1e-9)

        dual = dual + jax.lax.while_loop(outside, lambda s: 0.7 * s, 1.0) * change
        final = arrived & (decrement <= tol * (1 + jnp.abs(now)))
        certified = final & last
        stuck = ~certified & ~(t > 1e-12)
        t = jnp.where(stuck, 0.0, t)  # a certified point still takes the step that it has paid for
        near = decrement <= 3 * strength

        def nearer(now: Any, goal: Any) -> Any:
            next_one = jnp.where(now < 2.5 * SHRINK * goal, goal, now / SHRINK)
            return jnp.where(near, next_one, now)

        return _State(
            w + t * step,
            z + t * dz,
            dual,
            nearer(strength, wanted),
            nearer(tightness, 1.0),
            jnp.where(t > 0, trial, now),
            # Only the exact Hessian at the end of the path certifies anything.
            jnp.where(arrived, jnp.where(last | ~final, decrement, ALMOST), jnp.inf),
            hessian,
            state.steps + (t > 0),
            stuck,
        )

    w = mode[entries.rows, entries.columns]
    z = w @ gap
    size = jnp.sqrt(total(weights @ z**2) / jnp.maximum(total(jnp.sum(weights)), 1.0))
    tightness = jnp.maximum(1.0, size / LOG_ODDS)
    w, z, inverse = w / tightness, z / tightness, invert(mode) * tightness
    _, slope, _ = loss_and_slopes(z, labels, weights)
    count = jnp.where(entries.rows == entries.columns, 1.0, 2.0)
    pull = mode @ entries.matrix(total(gap @ slope) / count) / tightness
    strength = jnp.maximum(wanted, jnp.sqrt(jnp.abs(jnp.sum(pull * pull.T))))
    start = _State(
        w,
        z,
        strength * inverse,
        strength,
        tightness,
        objective(w, z, strength, tightness),
        jnp.inf,
        jnp.zeros((w.size, w.size)),
        0,
        False,
    )
    end = jax.lax.while_loop(unfinished, move, start)
    value = objective(end.w, end.z, wanted, 1.0)
    nll = total(loss(end.z, labels, weights))
    return Minimum(end.w, value, -nll, end.decrement, end.hessian, end.steps)


_one = jax.jit(newton)
_shared, _many = (
    jax.jit(jax.vmap(newton, in_axes=(gap, 0, 0, None, 0, 0, None, None))) for gap in (None, 0)
)


@lru_cache(maxsize=8)
def _over(axes: Any) -> Callable[..., Minimum]:
    """Return `newton` for comparisons shared along these axes of a mesh."""
    return partial(newton, total=lambda value: jax.lax.psum(value, axes))


def solve_shared(p: Problem, tol: float, limit: int, mesh: Mesh) -> Minimum:
    """Minimise one problem, its comparisons shared among the devices of the mesh."""
    each = shares(mesh)
    columns = shares(mesh, axis=1)
    arguments = (p.gap, p.labels, p.weights, p.entries, p.mode, p.strength, tol, limit)
    specs = (columns, each, each, *[WHOLE] * 5)
    minimum: Minimum = on_mesh(_over(mesh.axis_names), mesh, specs, WHOLE, arguments)
    return minimum


def solve(problems: Sequence[Problem], tol: float, limit: int) -> list[Minimum]:
    """Minimise all problems, which have the same shapes; more than one are solved side by side."""
    first = problems[0]
    if len(problems) == 1:
        p = first
        return [
            to_numpy(_one(p.gap, p.labels, p.weights, p.entries, p.mode, p.strength, tol, limit))
        ]
    stack = {
        name: np.stack([getattr(p, name) for p in problems])
        for name in ("labels", "weights", "mode", "strength")
    }
    shared = all(p.gap is first.gap for p in problems)
    gap = first.gap if shared else np.stack([p.gap for p in problems])
    out = (_shared if shared else _many)(
        gap,
        stack["labels"],
        stack["weights"],
        first.entries,
        stack["mode"],
        stack["strength"],
        tol,
        limit,
    )
    return [Minimum(*parts) for parts in zip(*to_numpy(out), strict=True)]
