"""What is known of the weights after some answers: Laplace's method in log weights, and samples."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import expit

from prefmpc.asking.features import FeatureMap

LAPSE_CENTRE = np.log(0.04 / 0.96)
LAPSE_SPREAD = 1.0
"""An estimated lapse rate has a logit with this mean and standard deviation: 1 % to 15 % or so."""

STEPS = 100
TOLERANCE = 1e-9
SLICES = 8
"""Updates of every sample that starts from Laplace's Gaussian."""


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian of mean zero in the coordinates η of a chart.

    Attributes
    ----------
    spread : float
        Standard deviation of each log weight about the centre.
    sharpness : float
        Standard deviation of what all log weights have in common, in addition: how sharp a
        person's answers are is known less than what they weigh against what.
    coupling : float
        Standard deviation of the other coordinates.
    """

    spread: float
    sharpness: float
    coupling: float

    def covariance(self, diagonal: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of η; ``diagonal`` says which entries are log weights."""
        own = np.where(diagonal, self.spread, self.coupling) ** 2
        return np.diag(own) + self.sharpness**2 * np.outer(diagonal, diagonal)


@dataclasses.dataclass(frozen=True, eq=False)
class Laplace:
    """The Gaussian about a most probable η.

    Attributes
    ----------
    eta : array (p,)
    lapse : float
        The given lapse rate, or the most probable one.
    decrement : float
        Half the squared Newton decrement where the iteration stopped, with the exact Hessian.
    curvature : float
        The least eigenvalue of that Hessian in units in which the prior's is 1.
    root : array (q, q)
        Covariance = root·rootᵀ, of η and of the logit of the lapse rate if that is estimated.
    at : array (q,)
        η, and that logit.
    """

    eta: np.ndarray
    lapse: float
    decrement: float
    curvature: float
    root: np.ndarray
    at: np.ndarray

    @property
    def success(self) -> bool:
        """Whether decrement and curvature certify a (local) maximum of the posterior density."""
        return bool(self.decrement <= TOLERANCE and self.curvature > 0)


class Belief:
    """The posterior of η for P(first preferred) = ε/2 + (1 − ε)·logistic(σ(second) − σ(first)).

    Neither in η nor with a lapse rate ε is −log posterior convex in general. The number that is
    computed is therefore the certificate of a local minimum: the Newton decrement and the least
    eigenvalue of the exact Hessian there. With ε > 0 the search starts from the solution for
    ε = 0, that one from the centre of the prior, so that the result is a function of the answers.

    Parameters
    ----------
    features : FeatureMap
    prior : Prior
    lapse : float or None
        ε in [0, 1); None: estimated with the weights.
    """

    def __init__(self, features: FeatureMap, prior: Prior, lapse: float | None) -> None:
        self.features, self.chart, self.lapse = features, features.chart, lapse
        covariance = prior.covariance(self.chart.diagonal)
        self._unit = np.linalg.cholesky(covariance)
        self.precision = np.linalg.inv(covariance)
        self.p = len(covariance)

    def fit(self, gap: np.ndarray, labels: np.ndarray) -> Laplace:
        """Return the Gaussian about the most probable η.

        Parameters
        ----------
        gap : array (n, p)
            Features of the second trajectory minus those of the first.
        labels : array (n,)
            P(first preferred) in [0, 1].
        """
        plain = self._newton(np.zeros(self.p), gap, labels, 0.0)
        if self.lapse == 0.0:
            return plain
        if self.lapse is None:
            return self._newton(np.append(plain.eta, LAPSE_CENTRE), gap, labels, None)
        return self._newton(plain.eta, gap, labels, self.lapse)

    def _newton(
        self, at: np.ndarray, gap: np.ndarray, labels: np.ndarray, lapse: float | None
    ) -> Laplace:
        """Minimise −log posterior by Newton's method with directions of negative curvature turned.

        Scaled so that the prior is a standard Gaussian.
        """
        unit = np.eye(len(at))
        unit[: self.p, : self.p] = self._unit
        if lapse is None:
            unit[-1, -1] = LAPSE_SPREAD
        now = self._energy(at[None], gap, labels, lapse)[0]
        for _ in range(STEPS):
            gradient, hessian = self._slopes(at, gap, labels, lapse)
            values, vectors = np.linalg.eigh(unit.T @ hessian @ unit)
            turned = vectors.T @ (unit.T @ gradient)
            size = np.maximum(np.abs(values), 1e-3)
            decrement = float(0.5 * turned @ (turned / size))
            if decrement <= TOLERANCE and values[0] > 0:
                break
            step = -unit @ (vectors @ (turned / size))
            t = min(1.0, 4.0 / (np.abs(np.linalg.solve(unit, step)).max() + 1e-300))
            for _ in range(40):
                trial = self._energy((at + t * step)[None], gap, labels, lapse)[0]
                if trial <= now - 0.2 * t * decrement + 1e-13 * abs(now):
                    break
                t /= 2
            else:
                break
            at, now = at + t * step, trial
        root = unit @ (vectors / np.sqrt(np.maximum(values, 1e-3)))
        return Laplace(
            eta=at[: self.p],
            lapse=float(expit(at[-1])) if lapse is None else lapse,
            decrement=decrement if np.isfinite(now) else np.inf,
            curvature=float(values[0]),
            root=root,
            at=at,
        )

    def _energy(
        self, at: np.ndarray, gap: np.ndarray, labels: np.ndarray, lapse: float | None
    ) -> np.ndarray:
        """Return −log posterior (m,) up to a constant at points (m, q)."""
        eta = at[:, : self.p]
        prior = 0.5 * np.einsum("mi,ij,mj->m", eta, self.precision, eta)
        with np.errstate(over="ignore", invalid="ignore"):
            z = self.chart.weights(eta) @ gap.T
            if lapse is None:
                prior = prior + 0.5 * ((at[:, -1] - LAPSE_CENTRE) / LAPSE_SPREAD) ** 2
                loss = _lapsing(z, labels, expit(at[:, -1:]))[0]
            elif lapse:
                loss = _lapsing(z, labels, lapse)[0]
            else:
                loss = np.logaddexp(0, z) - labels * z
            total = prior + loss.sum(-1)
        return np.where(np.isfinite(total), total, np.inf)

    def _slopes(
        self, at: np.ndarray, gap: np.ndarray, labels: np.ndarray, lapse: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient (q,) and Hessian (q, q) of −log posterior."""
        eta = at[: self.p]
        jacobian, second = self.chart.derivatives(eta)
        z = gap @ self.chart.weights(eta)
        if lapse == 0.0:
            s = expit(z)
            slope, curvature = s - labels, s * (1 - s)
        else:
            rate = expit(at[-1]) if lapse is None else lapse
            _, slope, curvature, by_rate = _lapsing(z, labels, rate)
        g = gap.T @ slope
        to_eta = gap @ jacobian
        gradient = jacobian.T @ g + self.precision @ eta
        hessian = to_eta.T @ (curvature[:, None] * to_eta) + second(g) + self.precision
        if lapse is not None:
            return gradient, hessian
        step, bend = rate * (1 - rate), rate * (1 - rate) * (1 - 2 * rate)
        first, mixed, twice = by_rate
        theta = (at[-1] - LAPSE_CENTRE) / LAPSE_SPREAD**2
        corner = step**2 * twice.sum() + bend * first.sum() + 1 / LAPSE_SPREAD**2
        side = step * (to_eta.T @ mixed)
        return (
            np.append(gradient, step * first.sum() + theta),
            np.block([[hessian, side[:, None]], [side[None], np.array([[corner]])]]),
        )

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

        Elliptical slice sampling about Laplace's Gaussian, all chains at once: each starts from a
        draw of the Gaussian and is moved ``slices`` times; with 0 they are Laplace's draws.
        """
        q = len(laplace.at)
        lapse = self.lapse if q == self.p else None
        x = rng.standard_normal((count, q))

        def excess(x: np.ndarray) -> np.ndarray:
            """Return log posterior − log of the Gaussian, up to a constant."""
            at = laplace.at + x @ laplace.root.T
            return 0.5 * (x**2).sum(-1) - self._energy(at, gap, labels, lapse)

        level = excess(x) if slices else np.zeros(count)
        for _ in range(slices):
            x, level = _slice(x, level, excess, rng)
        at = laplace.at + x @ laplace.root.T
        rates = expit(at[:, -1]) if lapse is None else np.full(count, lapse)
        return at[:, : self.p], rates


def _slice(x, level, excess, rng):  # type: ignore[no-untyped-def]
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
        found = excess(trial)
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


def _lapsing(z, labels, rate):  # type: ignore[no-untyped-def]
    """Return the loss, its two derivatives by z, and those by the rate: ∂ε, ∂ε∂z and ∂ε²."""
    s = expit(z)
    p = rate / 2 + (1 - rate) * s
    q = rate / 2 + (1 - rate) * (1 - s)
    loss = -labels * np.log(p) - (1 - labels) * np.log(q)
    by_p = (1 - labels) / q - labels / p
    by_pp = labels / p**2 + (1 - labels) / q**2
    ds = s * (1 - s)
    p_z, p_zz, p_e, p_ez = (1 - rate) * ds, (1 - rate) * ds * (1 - 2 * s), 0.5 - s, -ds
    curvature = by_pp * p_z**2 + by_p * p_zz
    by_rate = by_p * p_e, by_pp * p_e * p_z + by_p * p_ez, by_pp * p_e**2
    return loss, by_p * p_z, curvature, by_rate
