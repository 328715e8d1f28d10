"""What is known of the weights after some answers: Laplace's method in log weights, and samples."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from prefmpc.asking.features import FeatureMap
from prefmpc.asking.likelihood import lapsing

LAPSE_CENTRE = np.log(0.04 / 0.96)
LAPSE_SPREAD = 1.0
"""An estimated lapse rate has a logit with this mean and standard deviation: 1 % to 15 % or so."""

LEVELS = np.linspace(-3.0, 3.0, 13)
"""Sharpnesses at which Laplace's method is applied, in standard deviations of the prior's."""

STEPS = 100
TOLERANCE = 1e-9
"""Of the certificate; the search itself goes on to `POLISHED`, where rounding ends it."""

POLISHED = 1e-18
ROUGH = 1e-4
"""A level whose search stopped with a larger decrement, or at no minimum, has no say: its evidence
is not known. In a narrow valley `STEPS` may not be enough."""

FLAT = 1e-3
"""No curvature counts as less than this share of the prior's for a Newton step."""

WIDE = 0.25
"""Nor less than this for a Gaussian: it is nowhere wider than twice the prior, since answers that
say nothing of a direction leave what was known before."""

SLICES = 15
"""Updates of every sample that starts from Laplace's Gaussians: without them a posterior after
some 20 answers is a little too sure of the sharpness, and the bound of the regret too low."""


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian of mean zero in the coordinates η of a chart.

    Attributes
    ----------
    spread : float
        Standard deviation of each log weight about what all have in common.
    sharpness : float
        Standard deviation of what all log weights have in common: how sharp the answers are.
    coupling : float
        Standard deviation of the other coordinates.
    """

    spread: float
    sharpness: float
    coupling: float


@dataclasses.dataclass(frozen=True, eq=False)
class Laplace:
    """Gaussians about the most probable points, one for each level of sharpness.

    Attributes
    ----------
    eta : array (p,)
        The most probable η at the sharpness that the answers speak for most.
    lapse : float
        The given lapse rate, or the most probable one there.
    decrement : float
        Half the squared Newton decrement there, with the exact Hessian.
    curvature : float
        The least eigenvalue of that Hessian, in units in which the prior's is 1.
    at : array (K, q)
        The centres, in units in which the prior is a standard Gaussian.
    roots : array (K, q, q)
        Covariance = root·rootᵀ.
    weights : array (K,)
        How probable each level is.
    """

    eta: np.ndarray
    lapse: float
    decrement: float
    curvature: float
    at: np.ndarray
    roots: np.ndarray
    weights: np.ndarray

    @property
    def success(self) -> bool:
        """Whether decrement and curvature certify a (local) maximum of the posterior density."""
        return bool(self.decrement <= TOLERANCE and self.curvature > 0)


class Belief:
    """The posterior of η for P(first preferred) = ε/2 + (1 − ε)·logistic(σ(second) − σ(first)).

    A person whose answers are hardly sharper than chance leaves all weights possible; a sharp one
    leaves few. Where questions halve what is possible, few sharp weights explain whatever is
    answered, so that the most probable point of all is sharp and says nothing. Hence Laplace's
    method is applied for each of several sharpnesses, which are then weighed by their evidence.

    Neither in η nor with a lapse rate ε is −log posterior convex in general. The number that is
    computed is the certificate of a local minimum: the Newton decrement, and the least eigenvalue
    of the exact Hessian. The search starts where answers say next to nothing, at the lowest
    sharpness and at the prior's centre, where the problem is convex, and follows the minimum from
    level to level, first with ε = 0: the result is a function of the answers alone.

    Parameters
    ----------
    features : FeatureMap
    prior : Prior
    lapse : float or None
        ε in [0, 1); None: estimated with the weights.
    """

    def __init__(self, features: FeatureMap, prior: Prior, lapse: float | None) -> None:
        self.features, self.chart, self.lapse = features, features.chart, lapse
        diagonal = self.chart.diagonal
        self.p, d = diagonal.size, int(diagonal.sum())
        # η = level·common + basis·v with a standard Gaussian v.
        self._common = diagonal * float(np.hypot(prior.sharpness, prior.spread / np.sqrt(d)))
        ratios = np.linalg.svd(np.ones((1, d)))[2][1:].T
        basis = np.zeros((self.p, self.p - 1))
        basis[diagonal, : d - 1] = prior.spread * ratios
        basis[~diagonal, d - 1 :] = prior.coupling * np.eye(self.p - d)
        self._basis = basis

    def fit(self, gap: np.ndarray, labels: np.ndarray) -> Laplace:
        """Return the Gaussians about the most probable η.

        Parameters
        ----------
        gap : array (n, p)
            Features of the second trajectory minus those of the first.
        labels : array (n,)
            P(first preferred) in [0, 1].
        """
        data = gap, labels
        minima = []
        at = np.zeros(self.p - 1)
        for level in LEVELS:
            minimum = self._newton(at, level, *data, 0.0)
            at = minimum.at
            if self.lapse is None:
                minimum = self._newton(np.append(at, 0.0), level, *data, None)
            elif self.lapse:
                minimum = self._newton(at, level, *data, self.lapse)
            minima.append(minimum)
        evidence = np.array([m.evidence for m in minima])
        found = np.array([m.decrement <= ROUGH and m.curvature > 0 for m in minima])
        if found.any():
            evidence[~found] = -np.inf
        weights = np.exp(evidence - evidence.max())
        best = minima[int(np.argmax(weights))]
        return Laplace(
            eta=self._eta(best.at[None], LEVELS[np.argmax(weights)])[0],
            lapse=float(self._rate(best.at)) if self.lapse is None else self.lapse,
            decrement=best.decrement,
            curvature=best.curvature,
            at=np.stack([m.at for m in minima]),
            roots=np.stack([m.root for m in minima]),
            weights=weights / weights.sum(),
        )

    def _eta(self, at: np.ndarray, level: Any) -> np.ndarray:
        """Return η (m, p) at points (m, q) and levels () or (m,)."""
        level = np.broadcast_to(level, len(at))
        return level[:, None] * self._common + at[:, : self.p - 1] @ self._basis.T

    @staticmethod
    def _rate(at: np.ndarray) -> Any:
        """Return an estimated lapse rate."""
        return expit(LAPSE_CENTRE + LAPSE_SPREAD * at[..., -1])

    def _newton(
        self,
        at: np.ndarray,
        level: float,
        gap: np.ndarray,
        labels: np.ndarray,
        lapse: float | None,
    ) -> _Minimum:
        """Minimise −log posterior by Newton's method; directions of negative curvature turn."""
        data = gap, labels, lapse
        now = self._energy(at[None], level, *data)[0]
        for _ in range(STEPS):
            gradient, hessian = self._slopes(at, level, *data)
            values, vectors = np.linalg.eigh(hessian)
            turned = vectors.T @ gradient
            size = np.maximum(np.abs(values), FLAT)
            decrement = float(0.5 * turned @ (turned / size))
            if decrement <= POLISHED and values[0] > 0:
                break
            step = -vectors @ (turned / size)
            t = min(1.0, 3.0 / np.abs(step).max())
            while t > 1e-10:
                trial = self._energy((at + t * step)[None], level, *data)[0]
                if trial <= now - 0.2 * t * decrement + 1e-13 * abs(now):
                    break
                t /= 2
            else:
                break
            at, now = at + t * step, trial
        size = np.maximum(values, WIDE)
        evidence = -now - 0.5 * np.log(size).sum() - 0.5 * level**2
        decrement = decrement if np.isfinite(now) else np.inf
        # The symmetric root, since the signs of eigenvectors are arbitrary.
        root = vectors / np.sqrt(size) @ vectors.T
        return _Minimum(at, root, float(evidence), decrement, float(values[0]))

    def _energy(
        self, at: np.ndarray, level: Any, gap: np.ndarray, labels: np.ndarray, lapse: float | None
    ) -> np.ndarray:
        """Return −log posterior (m,) up to a constant at points (m, q)."""
        with np.errstate(over="ignore", invalid="ignore"):
            z = self.chart.weights(self._eta(at, level)) @ gap.T
            if lapse == 0.0:
                loss = np.maximum(z, 0) + np.log1p(np.exp(-np.abs(z))) - labels * z
            else:
                rate = self._rate(at)[:, None] if lapse is None else lapse
                loss = lapsing(z, labels, rate)[0]
            total = 0.5 * (at**2).sum(-1) + loss.sum(-1)
        return np.where(np.isfinite(total), total, np.inf)

    def _slopes(
        self, at: np.ndarray, level: float, gap: np.ndarray, labels: np.ndarray, lapse: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient (q,) and Hessian (q, q) of −log posterior."""
        eta, n = self._eta(at[None], level)[0], self.p - 1
        jacobian, second = self.chart.derivatives(eta)
        z = gap @ self.chart.weights(eta)
        if lapse == 0.0:
            s = expit(z)
            slope, curvature = s - labels, s * (1 - s)
        else:
            rate = self._rate(at) if lapse is None else lapse
            _, slope, curvature, by_rate = lapsing(z, labels, rate)
        to_at = gap @ (jacobian @ self._basis)
        gradient, hessian = at.copy(), np.eye(len(at))
        gradient[:n] += to_at.T @ slope
        hessian[:n, :n] += to_at.T @ (curvature[:, None] * to_at)
        hessian[:n, :n] += self._basis.T @ second(gap.T @ slope) @ self._basis
        if lapse is None:
            first, mixed, twice = by_rate
            step = LAPSE_SPREAD * rate * (1 - rate)
            gradient[n] += step * first.sum()
            bend = LAPSE_SPREAD * step * (1 - 2 * rate)
            hessian[n, n] += step**2 * twice.sum() + bend * first.sum()
            hessian[n, :n] = hessian[:n, n] = step * (to_at.T @ mixed)
        return gradient, hessian

    def draws(
        self,
        laplace: Laplace,
        gap: np.ndarray,
        labels: np.ndarray,
        count: int,
        rng: np.random.Generator,
        *,
        slices: int = SLICES,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return η (count, p) and lapse rates (count,) from the posterior.

        All chains at once: each starts from a draw of Laplace's Gaussians and is moved ``slices``
        times, within its level by elliptical slice sampling, and then to one of the two next
        levels, or not, by Metropolis's rule; with 0 they are Laplace's draws.
        """
        q = laplace.at.shape[1]
        lapse = self.lapse if q == self.p - 1 else None
        which = rng.choice(len(LEVELS), count, p=laplace.weights)
        x = rng.standard_normal((count, q))

        def point(x: np.ndarray, k: np.ndarray) -> np.ndarray:
            return laplace.at[k] + np.einsum("mij,mj->mi", laplace.roots[k], x)

        def excess(x: np.ndarray, k: np.ndarray) -> np.ndarray:
            """Return log posterior − log of the level's Gaussian, up to a constant of the level."""
            energy = self._energy(point(x, k), LEVELS[k], gap, labels, lapse)
            return 0.5 * (x**2).sum(-1) - energy

        def here(x: np.ndarray, i: np.ndarray) -> np.ndarray:
            return excess(x, which[i])

        constant = np.linalg.slogdet(laplace.roots)[1] - 0.5 * LEVELS**2
        height = excess(x, which) if slices else np.zeros(count)
        for _ in range(slices):
            x, height = _slice(x, height, here, rng)
            # To the same place relative to the Gaussian of another level.
            step = np.where(rng.uniform(size=count) < 0.5, -1, 1)
            other = np.clip(which + step, 0, len(LEVELS) - 1)
            there = excess(x, other)
            gain = there + constant[other] - height - constant[which]
            moves = np.log(rng.uniform(size=count)) < gain
            which[moves], height[moves] = other[moves], there[moves]
        at = point(x, which)
        rates = self._rate(at) if lapse is None else np.full(count, lapse)
        return self._eta(at, LEVELS[which]), rates


class _Minimum(NamedTuple):
    at: np.ndarray
    root: np.ndarray
    evidence: float
    decrement: float
    curvature: float


def _slice(
    x: np.ndarray, level: np.ndarray, excess: Callable[..., np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Move every chain (m, q) once: Murray, Adams and MacKay's elliptical slice sampling."""
    count = len(x)
    other = rng.standard_normal(x.shape)
    floor = level + np.log(rng.uniform(size=count))
    angle = rng.uniform(0, 2 * np.pi, count)
    low, high = angle - 2 * np.pi, angle.copy()
    new, value = x.copy(), level.copy()
    open_ = np.arange(count)
    for _ in range(30):
        a = angle[open_, None]
        trial = np.cos(a) * x[open_] + np.sin(a) * other[open_]
        found = excess(trial, open_)
        good = found >= floor[open_]
        new[open_[good]], value[open_[good]] = trial[good], found[good]
        open_ = open_[~good]
        if not open_.size:
            break
        below = angle[open_] < 0
        low[open_] = np.where(below, angle[open_], low[open_])
        high[open_] = np.where(below, high[open_], angle[open_])
        angle[open_] = rng.uniform(low[open_], high[open_])
    return new, value
