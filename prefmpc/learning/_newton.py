"""Newton's method along a path of ever weaker priors, for the problems of `_problem`."""

from __future__ import annotations

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
from prefmpc.learning._problem import Data, Entries, Problem, identity

TO_BOUNDARY = 0.95
"""No step goes further towards a singular matrix than this share of the way."""

SHRINK = 4.0
"""What scale and strength of the prior come nearer by, from one problem of the path to the next."""

LOG_ODDS = 100.0
"""Size of the log-odds where the path begins: more, and wrong ones have no curvature left."""

ALMOST = 1e-4
"""The dual's Hessian is trusted to this decrement; from there on the exact one is used."""


def backtrack(
    value: Callable[[Any], Any], now: Any, slope: Any, slack: Any, shrink: float, least: float
) -> tuple[Any, Any]:
    """Return the first t of 1, ``shrink``, … with value(t) ≤ now − t·slope + slack, and value(t).

    A NaN is refused; t ≤ ``least`` says that none was found.
    """

    def refused(search: tuple[Any, Any]) -> Any:
        t, trial = search
        return ~(trial <= now - t * slope + slack) & (t > least)

    def shorter(search: tuple[Any, Any]) -> tuple[Any, Any]:
        t = search[0] * shrink
        return t, value(t)

    start: Any = (1 / shrink, jnp.nan)
    found: tuple[Any, Any] = jax.lax.while_loop(refused, shorter, start)
    return found


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


def inverse(W: Any) -> Any:
    """Return W⁻¹ of a positive definite W."""
    root = solve_triangular(factor(W), jnp.eye(len(W)), lower=True)
    return root.T @ root


def newton_step(hessian: Any, gradient: Any) -> tuple[Any, Any]:
    """Return the step −H⁻¹g and its decrement gᵀH⁻¹g/2, solved in units of a unit diagonal."""
    unit = 1 / jnp.sqrt(jnp.diag(hessian))
    L = factor(hessian * unit * unit[:, None])
    half = solve_triangular(L, gradient * unit, lower=True)
    return -unit * solve_triangular(L, half, lower=True, trans=1), half @ half / 2


class Minimum(NamedTuple):
    """What `newton` found: w (p,), the objective, its decrement λ²/2 and Hessian (p, p)."""

    w: Any
    objective: Any
    log_likelihood: Any
    decrement: Any
    hessian: Any
    """Of weights, then thresholds."""
    steps: Any
    thresholds: Any = ()

    @property
    def covariance(self) -> Any:
        """Laplace's covariance (p, p) of the weights."""
        p = self.w.size
        return np.linalg.inv(self.hessian)[:p, :p]

    def converged(self, tol: float) -> bool:
        """Whether the decrement certifies the minimum; the last step may have moved the value."""
        found = self.w, self.objective, self.decrement, self.thresholds
        numbers = [np.isfinite(part).all() for part in found]
        # Nothing is small beside an infinite objective.
        return all(numbers) and bool(self.decrement <= 1.01 * tol * (1 + abs(self.objective)))


class _Prior(NamedTuple):
    """A prior of the path: ``tightness`` is the wanted scale of the mode over its own."""

    strength: Any
    tightness: Any


class _Iterate(NamedTuple):
    w: Any
    """Weights (p,), then thresholds."""
    z: Any
    dual: Any
    """Z (d, d): strength·W⁻¹ in the end."""
    prior: _Prior
    objective: Any
    decrement: Any
    hessian: Any
    steps: Any
    stuck: Any


class _Path(NamedTuple):
    """What stays the same during the iteration, and the steps of it."""

    data: Data
    entries: Entries
    mode: Any
    precision: Any
    """(p,): the derivative of tr(mode⁻¹W)."""
    goal: _Prior
    spread: Any
    """Of the thresholds' prior."""
    tol: Any
    total: Callable[[Any], Any]
    """Adds up what is a sum over comparisons, where these are shared among devices."""

    def matrix(self, w: Any) -> Any:
        """Return W (d, d) of weights and thresholds."""
        return self.entries.matrix(w[: self.precision.size])

    def objective(self, w: Any, z: Any, prior: _Prior) -> Any:
        """Return −log posterior, NaN outside of the cone, where Cholesky fails."""
        p = self.precision.size
        log_det = 2 * jnp.sum(jnp.log(jnp.diag(factor(self.matrix(w)))))
        distance = prior.tightness * (self.precision @ w[:p]) - log_det
        value = self.total(self.data.loss(z)) + prior.strength * distance
        units = w[p:] * (prior.tightness / self.spread)  # thresholds are of the size of σ
        return value if w.size == p else value + units @ units / 2

    def begin(self) -> _Iterate:
        """Start at the mode of a prior so tight and strong that it is nearly the minimum."""
        entries, total = self.entries, self.total
        w = self.mode[entries.rows, entries.columns]
        p, more = w.size, len(self.data.gap) - w.size
        w = jnp.concatenate([w, jnp.zeros(more)]) if more else w
        z = self.data.logits(w)
        size = jnp.sqrt(self.data.mean_square(z, total))
        tightness = jnp.maximum(1.0, size / LOG_ODDS)
        w, W_inverse = w / tightness, inverse(self.mode) * tightness
        z = jax.tree.map(lambda part: part / tightness, z)
        gradient = total(self.data.gradient(z))[:p]
        count = jnp.where(entries.rows == entries.columns, 1.0, 2.0)
        pull = self.mode @ entries.matrix(gradient / count) / tightness
        strength = jnp.maximum(self.goal.strength, jnp.sqrt(jnp.abs(jnp.sum(pull * pull.T))))
        prior = _Prior(strength, tightness)
        value, dual = self.objective(w, z, prior), strength * W_inverse
        nothing = jnp.zeros((w.size, w.size))
        return _Iterate(w, z, dual, prior, value, jnp.inf, nothing, 0, False)

    def small(self, decrement: Any, objective: Any) -> Any:
        """Say whether a decrement is below the tolerance."""
        return decrement <= self.tol * (1 + jnp.abs(objective))

    def move(self, at: _Iterate) -> _Iterate:
        """Take a step in w and Z, and go on to the next prior of the path where w is near."""
        prior = at.prior
        arrived = (prior.strength <= self.goal.strength) & (prior.tightness <= self.goal.tightness)
        W_inverse = inverse(self.matrix(at.w))
        gradient, data_hessian = self.data.derivatives(at.z, self.total)
        pull = prior.strength * (
            prior.tightness * self.precision - self.entries.gradient(W_inverse)
        )
        # Near the end Z = strength·W⁻¹ up to rounding; then the exact Hessian is as good.
        exact = arrived & (at.decrement <= ALMOST * (1 + jnp.abs(at.objective)))
        partner = jnp.where(exact, prior.strength * W_inverse, at.dual)
        bend = product_hessian(W_inverse, partner, self.entries)
        if more := at.w.size - pull.size:
            precision = (prior.tightness / self.spread) ** 2
            pull = jnp.concatenate([pull, at.w[pull.size :] * precision])
            bend = jax.scipy.linalg.block_diag(bend, jnp.eye(more) * precision)
        gradient, hessian = gradient + pull, data_hessian + bend
        step, decrement = newton_step(hessian, gradient)

        now = self.objective(at.w, at.z, prior)
        dz = self.data.logits(step)
        t, value = self.line_search(at, step, dz, now, decrement)
        dual, t = self.moved_dual(at, W_inverse, self.matrix(step), t)
        final = arrived & self.small(decrement, now)
        stuck = ~(final & exact) & ~(t > 1e-12)
        t = jnp.where(stuck, 0.0, t)  # a certified point still takes the step that it has paid for
        return _Iterate(
            at.w + t * step,
            jax.tree.map(lambda a, b: a + t * b, at.z, dz),
            dual,
            self.next_prior(prior, decrement),
            jnp.where(t > 0, value, now),
            # Only the exact Hessian at the end of the path certifies anything.
            jnp.where(arrived, jnp.where(exact | ~final, decrement, ALMOST), jnp.inf),
            hessian,
            at.steps + (t > 0),
            stuck,
        )

    def line_search(
        self, at: _Iterate, step: Any, dz: Any, now: Any, decrement: Any
    ) -> tuple[Any, Any]:
        """Return the length of the step and the objective there."""
        W, dW = self.matrix(at.w), self.matrix(step)

        def value(t: Any) -> Any:
            room = factor(W + t / TO_BOUNDARY * dW)[-1, -1]  # NaN if the boundary is too near
            z = jax.tree.map(lambda a, b: a + t * b, at.z, dz)
            trial = self.objective(at.w + t * step, z, at.prior)
            return jnp.where(jnp.isnan(room), jnp.nan, trial)

        slack = 1e-13 * (1 + jnp.abs(now))
        return backtrack(value, now, 0.05 * decrement, slack, shrink=0.6, least=1e-12)

    def moved_dual(self, at: _Iterate, W_inverse: Any, dW: Any, t: Any) -> tuple[Any, Any]:
        """Return Z after its own Newton step, as far as it stays positive definite; and t."""
        turned = W_inverse @ dW @ at.dual
        change = at.prior.strength * W_inverse - at.dual - (turned + turned.T) / 2
        t, change = jax.lax.optimization_barrier((t, change))  # LAPACK again: after the line search

        def outside(s: Any) -> Any:
            return jnp.isnan(factor(at.dual + s / TO_BOUNDARY * change)[-1, -1]) & (s > 1e-9)

        return at.dual + jax.lax.while_loop(outside, lambda s: 0.7 * s, 1.0) * change, t

    def next_prior(self, prior: _Prior, decrement: Any) -> _Prior:
        """Return the next prior of the path where w is near the minimum, else the same."""
        near = decrement <= 3 * prior.strength

        def nearer(now: Any, goal: Any) -> Any:
            following = jnp.where(now < 2.5 * SHRINK * goal, goal, now / SHRINK)
            return jnp.where(near, following, now)

        return _Prior(*map(nearer, prior, self.goal))


def newton(
    data: Data,
    entries: Entries,
    mode: Any,
    strength: Any,
    spread: Any,
    tol: Any,
    limit: Any,
    total: Callable[[Any], Any] = identity,
) -> Minimum:
    """Minimise by primal-dual Newton steps along a path of ever weaker priors.

    The path begins with a prior of so small a scale that no answer is far from the model, and so
    strong that its mode is nearly the minimum, and ends with the wanted one. The curvature of
    −log det W is taken as W⁻¹⊗Z with a dual Z instead of strength·W⁻¹⊗W⁻¹: a small eigenvalue of
    W then grows to its place at once, where it would else double in each step. At the end of the
    path the exact Hessian takes over, and its decrement is the certificate.

    Where comparisons are shared among devices, each takes the same steps.

    The calls to LAPACK depend on each other, one after the other: two that do not can wait for
    each other forever in a small thread pool.
    """
    precision, goal = entries.gradient(inverse(mode)), _Prior(strength, 1.0)
    path = _Path(data, entries, mode, precision, goal, spread, tol, total)

    def unfinished(at: _Iterate) -> Any:
        return (at.steps < limit) & ~path.small(at.decrement, at.objective) & ~at.stuck

    end = jax.lax.while_loop(unfinished, path.move, path.begin())
    value = path.objective(end.w, end.z, goal)
    log_likelihood = -total(data.loss(end.z))
    numbers = value, log_likelihood, end.decrement, end.hessian, end.steps
    return Minimum(end.w[: precision.size], *numbers, end.w[precision.size :])


_one = jax.jit(newton)
_shared, _many = (
    jax.jit(jax.vmap(newton, in_axes=(Data(gap, 0, 0, ()), None, 0, 0, None, None, None)))
    for gap in (None, 0)
)


@lru_cache(maxsize=8)
def _over(axes: Any) -> Callable[..., Minimum]:
    """Return `newton` for comparisons shared along these axes of a mesh."""

    run = partial(newton, total=lambda value: jax.lax.psum(value, axes))
    return lambda gap, labels, weights, *rest: run(Data(gap, labels, weights), *rest)


def solve(
    problems: Sequence[Problem], tol: float, limit: int, mesh: Mesh | None = None
) -> list[Minimum]:
    """Minimise all problems, which have the same shapes; more than one are solved side by side.

    With a ``mesh`` one after the other, their comparisons shared among its devices.
    """
    first = problems[0]
    if mesh is not None or len(problems) == 1:
        found = []
        for p in problems:
            rest = p.entries, p.mode, p.strength, p.spread, tol, limit
            if mesh is None:
                found.append(to_numpy(_one(p.data, *rest)))
            else:
                one = shares(mesh)
                specs = (shares(mesh, axis=1), one, one, *[WHOLE] * len(rest))
                arguments = p.gap, p.labels, p.weights, *rest
                found.append(on_mesh(_over(mesh.axis_names), mesh, specs, WHOLE, arguments))
        return found
    labels, weights, mode, strength = (
        np.stack([getattr(p, name) for p in problems])
        for name in ("labels", "weights", "mode", "strength")
    )
    shared = all(p.gap is first.gap for p in problems)
    gap = first.gap if shared else np.stack([p.gap for p in problems])
    run = _shared if shared else _many
    out = run(Data(gap, labels, weights), first.entries, mode, strength, first.spread, tol, limit)
    return [Minimum(*parts) for parts in zip(*to_numpy(out), strict=True)]
