"""Coordinates in which every point is a positive definite (Q, R), and Laplace's method in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from prefmpc._checks import to_numpy
from prefmpc.learning._newton import backtrack
from prefmpc.learning._problem import Problem, data_derivatives, loss


class Chart(NamedTuple):
    """η (p,) ↦ w (p,): W = C L Lᵀ Cᵀ, with the logarithms of the diagonal of L as coordinates.

    C Cᵀ is the prior's mode. Before any answer, the squared diagonal entries of L are gamma
    distributed and the others Gaussian (Bartlett), so that a Gaussian in η is a good start.
    """

    entries: Any
    root: Any
    """C (d, d), lower triangular."""

    @classmethod
    def of(cls, problem: Problem) -> Chart:
        """Return the chart of a problem; a ValueError if its zeros do not allow one."""
        entries, root = problem.entries, np.linalg.cholesky(problem.mode)
        free = entries.basis.any(axis=0)
        product = (root != 0).astype(int) @ np.tril(free).astype(int)
        if ((product @ product.T > 0) & ~free).any():
            raise ValueError(
                "structure must be block-diagonal, or such that a Cholesky factor has the same "
                "zeros, for a posterior: reorder the signals, or choose priors by cross-validation"
            )
        return cls(entries, root)

    @property
    def diagonal(self) -> Any:
        """Which coordinates are logarithms (p,)."""
        return self.entries.rows == self.entries.columns

    @property
    def below(self) -> Any:
        """How many free entries stand below each diagonal one in its column (p,)."""
        same = self.entries.columns[:, None] == self.entries.columns
        return jnp.sum(same, axis=1) - 1

    def factor(self, eta: Any) -> Any:
        """Return L (d, d)."""
        entries = jnp.where(self.diagonal, jnp.exp(eta), eta)
        return jnp.tril(self.entries.matrix(entries))

    def weights(self, eta: Any) -> Any:
        """Return w (p,)."""
        half = self.root @ self.factor(eta)
        return (half @ half.T)[self.entries.rows, self.entries.columns]

    def coordinates(self, w: Any) -> Any:
        """Return η of w."""
        half = jnp.linalg.cholesky(self.entries.matrix(w))
        L = solve_triangular(self.root, half, lower=True)
        entries = L[self.entries.rows, self.entries.columns]
        return jnp.where(self.diagonal, jnp.log(jnp.where(self.diagonal, entries, 1.0)), entries)

    def minus_log_prior(self, eta: Any, strength: Any) -> Any:
        """Return −log of the prior's density of η, with its normaliser.

        Each L_jj² is gamma distributed, each L_ij Gaussian: Bartlett's decomposition.
        """
        shape = strength + 1 + self.below / 2
        square = jnp.where(self.diagonal, jnp.exp(2 * eta), eta**2)
        gamma = jax.scipy.special.gammaln(shape) - shape * jnp.log(strength)
        gauss = 0.5 * jnp.log(jnp.pi / strength)
        jacobian = jnp.log(2.0) + 2 * shape * eta
        return strength * jnp.sum(square) + jnp.sum(
            jnp.where(self.diagonal, gamma - jacobian, gauss)
        )


class Laplace(NamedTuple):
    """The Gaussian around the mode η (p,) of the chart, and the evidence by Laplace's method."""

    eta: Any
    root: Any
    """(p, p): the Hessian at the mode is root·rootᵀ, with orthogonal columns."""
    log_evidence: Any
    decrement: Any

    def coordinates(self, standard: Any) -> Any:
        """Return η (..., p) of points (..., p) for which the Gaussian is a standard one."""
        return self.eta + standard @ (self.root / jnp.sum(self.root**2, axis=0)).T


def minus_log_posterior(
    chart: Chart, eta: Any, gap: Any, labels: Any, weights: Any, strength: Any
) -> Any:
    """Return −log of likelihood times the prior's density, over η."""
    return loss(chart.weights(eta) @ gap, labels, weights) + chart.minus_log_prior(eta, strength)


def laplace(chart: Chart, w: Any, gap: Any, labels: Any, weights: Any, strength: Any) -> Laplace:
    """Minimise −log posterior in the chart by damped Newton steps, from the MAP w."""

    def value(eta: Any) -> Any:
        return minus_log_posterior(chart, eta, gap, labels, weights, strength)

    def derivatives(eta: Any) -> tuple[Any, Any]:
        slope, curvature = data_derivatives(gap, chart.weights(eta) @ gap, labels, weights)

        def rest(eta: Any) -> Any:  # what is left after the data's own curvature; p × p only
            return chart.weights(eta) @ slope + chart.minus_log_prior(eta, strength)

        J = jax.jacfwd(chart.weights)(eta)
        return jax.grad(rest)(eta), J.T @ curvature @ J + jax.hessian(rest)(eta)

    def unfinished(carry: Any) -> Any:
        _, _, _, decrement, k = carry
        return (k < 50) & ~(decrement <= 1e-9)

    def move(carry: Any) -> Any:
        eta, now, _, _, k = carry
        gradient, hessian = derivatives(eta)
        values, vectors = jnp.linalg.eigh(hessian)
        # Not convex in η: away from the mode, turn directions of negative curvature round.
        values = jnp.maximum(jnp.abs(values), 1e-6 * jnp.max(jnp.abs(values)))
        turned = vectors.T @ gradient
        step = -vectors @ (turned / values)
        decrement = 0.5 * turned @ (turned / values)
        slack = 1e-12 * (1 + jnp.abs(now))
        t, trial = backtrack(
            lambda t: value(eta + t * step), now, 0.2 * decrement, slack, shrink=0.5, least=1e-9
        )
        done = decrement <= 1e-9
        eta, now = jnp.where(done, eta, eta + t * step), jnp.where(done, now, trial)
        return eta, now, vectors * jnp.sqrt(values), decrement, k + 1

    eta = chart.coordinates(w)
    p = eta.size
    carry: Any = (eta, value(eta), jnp.eye(p), jnp.inf, 0)
    eta, now, root, decrement, _ = jax.lax.while_loop(unfinished, move, carry)
    half_log_det = jnp.sum(jnp.log(jnp.linalg.norm(root, axis=0)))
    return Laplace(eta, root, -now + p / 2 * jnp.log(2 * jnp.pi) - half_log_det, decrement)


_laplace = jax.jit(laplace)
_laplace_many = jax.jit(jax.vmap(laplace, in_axes=(Chart(None, 0), 0, None, None, None, 0)))


def laplaces(problems: Sequence[Problem], w: Sequence[np.ndarray]) -> list[Laplace]:
    """Apply Laplace's method to problems that share their data, starting from their MAP w."""
    first = problems[0]
    data = first.gap, first.labels, first.weights
    charts = [Chart.of(problem) for problem in problems]
    if len(problems) == 1:
        return [to_numpy(_laplace(charts[0], w[0], *data, first.strength))]
    stack = Chart(charts[0].entries, np.stack([chart.root for chart in charts]))
    strength = np.array([problem.strength for problem in problems])
    out = to_numpy(_laplace_many(stack, np.stack(w), *data, strength))
    return [Laplace(*parts) for parts in zip(*out, strict=True)]
