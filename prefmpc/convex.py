"""Learning a quadratic σ is a convex problem: one minimum, Newton's method, a certificate.

σ is linear in (Q, R), so the negative log-likelihood of the answers is convex in them; a Wishart
prior makes the problem strictly convex, and keeps Q and R positive definite. Nothing is random:
the same data and prior give the same answer.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike

from prefmpc._checks import (
    finite_array,
    instance,
    nonnegative,
    positive_int,
    psd_matrix,
    require_x64,
    to_numpy,
)
from prefmpc.comparisons import Comparisons
from prefmpc.models import QuadraticCost
from prefmpc.training import FitError

Status = Literal["converged", "max_iterations", "not_finite"]

SMALLEST_SHAPE = 64
"""Data sets are padded to this many pairs times a power of four, so that few shapes compile."""


@dataclasses.dataclass(frozen=True, eq=False)
class WishartPrior:
    """What is believed of Q and R before anybody answered: a mode, and how strongly.

    log p(Q, R) = −strength·[tr(Q₀⁻¹Q) − log det Q + tr(R₀⁻¹R) − log det R] + const, the logarithm
    of two Wishart densities with modes Q₀ and R₀. The *scale* of the mode says how sharp the
    answers are expected to be: σ is in units of log-odds.

    Parameters
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        Q₀ and R₀, symmetric positive definite.
    strength : float
        Positive. As many "pseudo-observations" of each direction as it is large.

    Raises
    ------
    ValueError
        If a mode is not positive definite or ``strength`` is not positive.
    """

    Q: np.ndarray
    R: np.ndarray
    strength: float = 1.0

    def __post_init__(self) -> None:
        for name in ("Q", "R"):
            matrix = psd_matrix(name, getattr(self, name), definite=True)
            if matrix.ndim != 2:
                raise ValueError(f"{name} must be one matrix, got shape {matrix.shape}")
            object.__setattr__(self, name, matrix)
        if not nonnegative("strength", self.strength) > 0:
            raise ValueError(f"strength must be positive, got {self.strength}")


def bryson(
    x_max: ArrayLike, u_max: ArrayLike, *, scale: float = 1.0, strength: float = 1.0
) -> WishartPrior:
    """Return the prior of an engineer who knows only the largest acceptable deviations.

    Bryson's rule: each weight is 1 / (largest acceptable value)², so that a signal at its limit
    costs ``scale`` in each step.

    Parameters
    ----------
    x_max : array (nx,)
    u_max : array (nu,)
        Positive, in the units of x and u.
    scale, strength : float
        Positive; see `WishartPrior`.
    """
    if not nonnegative("scale", scale) > 0:
        raise ValueError(f"scale must be positive, got {scale}")
    weights = []
    for name, value in {"x_max": x_max, "u_max": u_max}.items():
        limit = np.asarray(finite_array(name, value, ndim=1))
        if limit.size == 0 or (limit <= 0).any():
            raise ValueError(f"{name} must hold positive deviations, got {limit}")
        weights.append(np.diag(scale / limit**2))
    return WishartPrior(weights[0], weights[1], strength)


@dataclasses.dataclass(frozen=True)
class MapResult:
    """The most probable (Q, R) after the answers.

    Attributes
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        As the solver left them; `model` refuses to hand out an unfinished one.
    status : "converged", "max_iterations" or "not_finite".
    objective : float
        −log posterior up to a constant: Σ cross-entropy + the prior's term.
    decrement : float
        λ²/2, half the squared Newton decrement where the solver stopped: to second order the
        distance of ``objective`` from its minimum.
    iterations : int
    seconds : float
        Wall time, compilation included if there was one.
    """

    Q: np.ndarray
    R: np.ndarray
    status: Status
    objective: float
    decrement: float
    iterations: int
    seconds: float

    @property
    def success(self) -> bool:
        """Whether the decrement certifies the minimum."""
        return self.status == "converged"

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return f"{self.status} after {self.iterations} Newton steps, decrement {self.decrement:.1e}"

    @property
    def model(self) -> QuadraticCost:
        """The learned σ. Raises a `FitError` unless the minimum was reached."""
        if not self.success:
            raise FitError(f"fit_map: {self.message}")
        return QuadraticCost(self.Q, self.R)


def fit_map(
    comparisons: Comparisons,
    prior: WishartPrior,
    *,
    structure: Literal["full", "diagonal"] = "full",
    max_iterations: int = 100,
    tol: float = 1e-10,
) -> MapResult:
    """Return the maximum a posteriori weights of a quadratic σ: one start, no randomness.

    Minimises Σ_i cross-entropy(z_i, label_i) − log prior(Q, R) with the log-odds
    z_i = σ(second_i) − σ(first_i), eq. (4) of arXiv 2511.22502, over positive definite Q and R,
    by Newton's method with exact derivatives from the prior's mode.

    Parameters
    ----------
    comparisons : Comparisons
        Labels may be soft; the noise of the answers is in the scale of Q and R.
    prior : WishartPrior
    structure : {"full", "diagonal"}
        Which entries of Q and R may differ from zero. "diagonal" needs a diagonal prior.
    tol : float
        Stop when half the squared Newton decrement is below ``tol`` times 1 + abs(objective).

    Returns
    -------
    MapResult

    Raises
    ------
    ValueError
        If an argument is out of range, or prior and trajectories do not fit each other.
    """
    require_x64()
    began = time.perf_counter()
    instance("comparisons", comparisons, Comparisons)
    instance("prior", prior, WishartPrior)
    limit, tol = positive_int("max_iterations", max_iterations), nonnegative("tol", tol)
    trajectories = comparisons.trajectories
    nx, nu = trajectories.x.shape[-1], trajectories.u.shape[-1]
    if prior.Q.shape != (nx, nx) or prior.R.shape != (nu, nu):
        raise ValueError(
            f"prior must weigh {nx} states and {nu} inputs, "
            f"got Q {prior.Q.shape} and R {prior.R.shape}"
        )
    W0 = np.block([[prior.Q, np.zeros((nx, nu))], [np.zeros((nu, nx)), prior.R]])
    places = _places(nx, nu, structure, W0)

    # Units in which the prior's mode has a unit diagonal: nothing then depends on those of x, u.
    unit = 1 / np.sqrt(np.diag(W0))
    moments = np.asarray(QuadraticCost.features(trajectories))
    if not np.isfinite(moments).all():
        raise ValueError("comparisons must have finite second moments, got an overflow")
    everything = _places(nx, nu, "full", W0)
    number = {pair: k for k, pair in enumerate(zip(*everything, strict=True))}
    columns = [number[pair] for pair in zip(*places, strict=True)]
    scaled = moments[:, columns] / (unit[places[0]] * unit[places[1]])
    n = len(comparisons)
    size = _padded_size(n)
    gap = np.zeros((size, len(columns)))
    np.subtract(scaled[comparisons.second], scaled[comparisons.first], out=gap[:n])
    labels, weights = np.zeros(size), np.zeros(size)
    labels[:n], weights[:n] = comparisons.labels, 1.0

    mode = W0 * unit * unit[:, None]
    out = _newton(gap, labels, weights, places, mode, float(prior.strength), tol, limit)
    w, objective, decrement, iterations = to_numpy(out)
    small = decrement <= tol * (1 + abs(objective))
    objective = objective + 2 * prior.strength * np.log(unit).sum()  # log det in the user's units
    W = np.zeros_like(W0)
    W[places] = w
    W[places[::-1]] = w
    W = W / unit / unit[:, None]
    status: Status = "converged"
    if not (np.isfinite(W).all() and np.isfinite(objective)):
        status = "not_finite"
    elif not small:
        status = "max_iterations"
    result = MapResult(
        Q=W[:nx, :nx],
        R=W[nx:, nx:],
        status=status,
        objective=float(objective),
        decrement=float(decrement),
        iterations=int(iterations),
        seconds=time.perf_counter() - began,
    )
    if not result.success:
        warnings.warn(f"fit_map: {result.message}", RuntimeWarning, stacklevel=2)
    return result


def _padded_size(n: int) -> int:
    size = SMALLEST_SHAPE
    while size < n:
        size *= 4
    return size


def _places(nx: int, nu: int, structure: str, W0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns of the free entries of blkdiag(Q, R), lower triangles."""
    if structure not in ("full", "diagonal"):
        raise ValueError(f'structure must be "full" or "diagonal", got {structure!r}')
    if structure == "diagonal":
        if np.abs(W0 - np.diag(np.diag(W0))).max() > 0:
            raise ValueError('prior must be diagonal for structure="diagonal", its Q or R is not')
        return np.arange(nx + nu), np.arange(nx + nu)
    parts = [(np.tril_indices(nx), 0), (np.tril_indices(nu), nx)]
    rows, columns = zip(*((r + at, c + at) for (r, c), at in parts), strict=True)
    return np.concatenate(rows), np.concatenate(columns)


@jax.jit
def _newton(
    gap: Any,
    labels: Any,
    weights: Any,
    places: tuple[Any, Any],
    mode: Any,
    strength: Any,
    tol: Any,
    limit: Any,
) -> tuple[Any, Any, Any, Any]:
    """Minimise over the free entries w of W; return w, the objective, λ²/2 and the steps taken."""
    rows, columns = places
    size, d = gap.shape[1], mode.shape[0]
    # The matrices E_a with W = Σ_a w_a E_a.
    basis = jnp.zeros((size, d, d)).at[jnp.arange(size), rows, columns].set(1.0)
    basis = jnp.maximum(basis, basis.swapaxes(1, 2))
    precision = jnp.einsum("aij,ij->a", basis, jnp.linalg.inv(mode))  # tr(W₀⁻¹E_a)

    def objective(w: Any, z: Any) -> Any:
        # NaN outside of the cone, where Cholesky fails.
        diagonal = jnp.diag(jnp.linalg.cholesky(jnp.tensordot(w, basis, 1)))
        data = jnp.vdot(weights, optax.sigmoid_binary_cross_entropy(z, labels))
        return data + strength * (precision @ w - 2 * jnp.sum(jnp.log(diagonal)))

    def direction(w: Any, z: Any) -> tuple[Any, Any]:
        inverse = jnp.linalg.inv(jnp.tensordot(w, basis, 1))
        p = jax.nn.sigmoid(z)
        turned = jnp.einsum("ij,ajk->aik", inverse, basis)  # W⁻¹E_a
        gradient = gap.T @ (weights * (p - labels)) + strength * (
            precision - jnp.einsum("aii->a", turned)
        )
        hessian = (gap.T * (weights * p * (1 - p))) @ gap + strength * jnp.einsum(
            "aij,bji->ab", turned, turned
        )
        step = -jnp.linalg.solve(hessian, gradient)
        return step, -jnp.vdot(gradient, step)

    def unfinished(carry: Any) -> Any:
        _, _, value, decrement, k, stuck = carry
        return (k < limit) & ~(decrement <= tol * (1 + jnp.abs(value))) & ~stuck

    def newton(carry: Any) -> Any:
        w, z, value, _, k, _ = carry
        step, squared = direction(w, z)
        decrement = squared / 2
        done = decrement <= tol * (1 + jnp.abs(value))
        dz = gap @ step
        slack = 1e-13 * (1 + jnp.abs(value))

        def refused(search: Any) -> Any:
            t, trial = search
            return ~(trial <= value - 0.1 * t * squared + slack) & (t > 1e-12)

        def shorter(search: Any) -> Any:
            t = search[0] / 2
            return t, objective(w + t * step, z + t * dz)

        t: Any
        t, trial = jax.lax.while_loop(refused, shorter, (2.0, jnp.nan))
        stuck = ~done & (t <= 1e-12)
        t = jnp.where(done | stuck, 0.0, t)
        moved = t > 0
        return (
            w + t * step,
            z + t * dz,
            jnp.where(moved, trial, value),
            decrement,
            k + moved,
            stuck,
        )

    start = mode[rows, columns]
    z = gap @ start
    carry: Any = (start, z, objective(start, z), jnp.inf, 0, False)
    w, _, value, decrement, k, _ = jax.lax.while_loop(unfinished, newton, carry)
    return w, value, decrement, k
