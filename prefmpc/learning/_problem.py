"""The convex problem of the most probable (Q, R), in the form that Newton's method wants."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array
from prefmpc.learning.choices import NO_THRESHOLDS, Thresholds, Wide, gaps
from prefmpc.learning.losses import padded_size
from prefmpc.learning.priors import Structure, WishartPrior, free_entries
from prefmpc.preferences.answers import Answers
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.recordings import applied, batches
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
    outputs: np.ndarray | None
    """C (ny, nx), where outputs are weighed instead of states."""
    gap: np.ndarray
    """(p, size): second moments of the second trajectory minus those of the first."""
    labels: np.ndarray
    weights: np.ndarray
    """(size,): 0 for padding, else as how many answers it counts, mostly 1."""
    mode: np.ndarray
    strength: float
    nu: int
    wide: tuple[Wide, ...] = ()
    """Choices among more than two; ``gap`` then has a row more for each threshold."""
    thresholds: Thresholds = NO_THRESHOLDS
    spread: float = np.inf
    """Standard deviation of the thresholds before any answer."""

    @property
    def data(self) -> Data:
        """What is minimised, without the prior."""
        return Data(self.gap, self.labels, self.weights, self.wide)

    @property
    def log_unit(self) -> float:
        """log det W in the problem's units minus that in the user's."""
        return 2 * float(np.log(self.unit).sum())

    def costs(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Q (..., nx, nx) and R (..., nu, nu) in the user's units from w (..., p)."""
        W = np.asarray(self.entries.matrix(w)) / self.unit / self.unit[:, None]
        nq, C = len(self.unit) - self.nu, self.outputs
        Q, R = W[..., :nq, :nq], W[..., nq:, nq:]
        return (Q if C is None else C.T @ Q @ C), R

    def moments(self, trajectories: Trajectory) -> np.ndarray:
        """Return the derivatives (p, ...) of σ(T) with respect to w."""
        return _moments(trajectories, self.entries, self.unit, self.outputs)


def _moments(
    trajectories: Trajectory, entries: Entries, unit: np.ndarray, outputs: np.ndarray | None
) -> np.ndarray:
    if outputs is not None:
        plain = trajectories.deviation()
        trajectories = Trajectory(np.asarray(plain.x) @ outputs.T, plain.u)
    rows, columns, _ = entries
    with np.errstate(over="ignore"):
        moments = _block_diagonal(*(np.asarray(S) for S in second_moments(trajectories)))
    if not np.isfinite(moments).all():
        raise ValueError("comparisons must have finite second moments, got an overflow")
    count = np.where(rows == columns, 1.0, 2.0)
    return np.moveaxis(moments[..., rows, columns] * (count / (unit[rows] * unit[columns])), -1, 0)


def _block_diagonal(Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return blkdiag(Q, R) (..., d, d)."""
    n, d = Q.shape[-1], Q.shape[-1] + R.shape[-1]
    W = np.zeros((*Q.shape[:-2], d, d))
    W[..., :n, :n], W[..., n:, n:] = Q, R
    return W


def build(
    comparisons: Comparisons,
    priors: Sequence[WishartPrior],
    entries: Entries,
    outputs: np.ndarray | None,
    size: int,
    counts: np.ndarray | None = None,
) -> list[Problem]:
    """Prepare one problem for each prior, all in the units of the first.

    Padded to ``size`` comparisons with some of weight 0; the others weigh ``counts`` (n,) or 1.
    """
    n = len(comparisons)
    modes = [_block_diagonal(prior.Q, prior.R) for prior in priors]
    unit = 1 / np.sqrt(np.diag(modes[0]))
    pool = np.ascontiguousarray(_moments(comparisons.trajectories, entries, unit, outputs))
    gap = np.zeros((entries.rows.size, size))
    np.take(pool, comparisons.second, axis=1, out=gap[:, :n])
    gap[:, :n] -= pool.take(comparisons.first, axis=1)
    labels, weights = np.zeros(size), np.zeros(size)
    labels[:n], weights[:n] = comparisons.labels, 1.0 if counts is None else counts
    data = entries, unit, outputs, gap, labels, weights
    return [
        Problem(*data, W0 * unit * unit[:, None], float(prior.strength), len(prior.R))
        for W0, prior in zip(modes, priors, strict=True)
    ]


def build_answers(
    answers: Answers, prior: WishartPrior, entries: Entries, outputs: np.ndarray | None
) -> Problem:
    """Prepare the problem of answers of every kind, with their thresholds as further unknowns.

    These are Gaussian about 0 before any answer, weakly: their standard deviation is ten times
    the log-odds that the prior's mode expects (and 10 more), so that no unit of σ matters.
    """
    W0 = _block_diagonal(prior.Q, prior.R)
    unit = 1 / np.sqrt(np.diag(W0))
    pool = applied(
        lambda part: np.moveaxis(_moments(part, entries, unit, outputs), 0, -1),
        answers.trajectories,
    ).T
    thresholds = Thresholds.of(answers)
    pairs, wide = gaps(answers, thresholds, pool, padded_size)
    mode = W0 * unit * unit[:, None]
    w = np.concatenate([mode[entries.rows, entries.columns], np.zeros(thresholds.total)])
    expected = Data(*pairs, wide).logits(w)
    count = sum(
        float(z[..., weights > 0].size)
        for z, weights in zip(expected, (pairs[2], *(part.weights for part in wide)), strict=True)
    )
    size = np.sqrt(sum(float(np.vdot(z, z)) for z in expected) / count)
    return Problem(
        *(entries, unit, outputs, *pairs, mode, float(prior.strength), len(prior.R)),
        *(wide, thresholds, 10.0 * (1 + size)),
    )


def answer_weights(value: Any, n: int) -> np.ndarray:
    """Return as how many answers each one counts (n,), or raise a ValueError."""
    weights = np.ones(n) if value is None else np.asarray(finite_array("weights", value))
    if weights.shape != (n,):
        raise ValueError(f"weights must have shape ({n},), one an answer, got {weights.shape}")
    if weights.min() < 0 or not weights.any():
        raise ValueError(f"weights must be not negative and not all 0, got {weights}")
    return weights


def check(
    data_sets: Sequence[Comparisons | Answers],
    priors: Sequence[WishartPrior],
    structure: Structure,
    outputs: ArrayLike | None,
) -> tuple[np.ndarray | None, Entries]:
    """Return C and the free entries; raise a ValueError unless everything fits together."""
    pools = [batches(data.trajectories)[0] for data in data_sets]
    sizes = [(T.x.shape[-1], T.u.shape[-1]) for T in pools]
    nx, nu = sizes[0]
    C = None
    if outputs is not None:
        C = np.asarray(finite_array("outputs", outputs, ndim=2))
        if C.shape[1] != nx:
            raise ValueError(f"outputs must have {nx} columns, one a state, got shape {C.shape}")
    nq, what = (nx, "states") if C is None else (C.shape[0], "outputs")
    for got in sizes:
        if got != (nx, nu):
            raise ValueError(
                f"comparisons must all have {nx} states and {nu} inputs, got {got[0]} and {got[1]}"
            )
    for prior in priors:
        if prior.Q.shape != (nq, nq) or prior.R.shape != (nu, nu):
            raise ValueError(
                f"prior must weigh {nq} {what} and {nu} inputs, "
                f"got Q {prior.Q.shape} and R {prior.R.shape}"
            )
        rows, columns = free_entries(structure, prior)
    return C, Entries.of(rows, columns)


def identity(value: Any) -> Any:
    """Return the value: the sum over devices where there is one only."""
    return value


def loss(z: Any, labels: Any, weights: Any) -> Any:
    """Return Σ cross-entropy."""
    # log(1 + e) instead of log1p(e): below 1e-16 nothing is left in the sum anyway, and faster.
    return weights @ (jnp.maximum(z, 0) + jnp.log(1 + jnp.exp(-jnp.abs(z))) - labels * z)


def data_derivatives(
    gap: Any, z: Any, labels: Any, weights: Any, total: Callable[[Any], Any] = identity
) -> tuple[Any, Any]:
    """Return gradient (p,) and Hessian (p, p) of Σ cross-entropy(gapᵀw) where gapᵀw = z.

    One pass over the data; many comparisons go through the cache block by block.
    """
    p, size = gap.shape
    P = jax.nn.sigmoid(z)
    slope, curvature = weights * (P - labels), weights * P * (1 - P)

    def block(gap: Any, slope: Any, curvature: Any) -> Any:
        return jnp.concatenate([gap * curvature, slope[None]]) @ gap.T

    def add(k: Any, stacked: Any) -> Any:
        parts = [
            jax.lax.dynamic_slice_in_dim(a, k * BLOCK, BLOCK, -1) for a in (gap, slope, curvature)
        ]
        return stacked + block(*parts)

    if size <= BLOCK:
        stacked = block(gap, slope, curvature)
    else:
        stacked = jax.lax.fori_loop(0, size // BLOCK, add, jnp.zeros((p + 1, p)))
    stacked = total(stacked)
    return stacked[-1], stacked[:-1]


class Data(NamedTuple):
    """All choices: among two (gap, labels, weights), and among more."""

    gap: Any
    labels: Any
    weights: Any
    wide: tuple[Wide, ...] = ()

    def logits(self, w: Any) -> tuple[Any, ...]:
        """Return the log-odds (size,) of the first of two, and (K − 1, size) of the others."""
        rest = [(w @ c.gap.reshape(len(w), -1)).reshape(c.gap.shape[1:]) for c in self.wide]
        return (w @ self.gap, *rest)

    def loss(self, z: tuple[Any, ...]) -> Any:
        """Return Σ −log P."""
        value = loss(z[0], self.labels, self.weights)
        for choices, part in zip(self.wide, z[1:], strict=True):
            value += choices.weights @ minus_log(choices, part)
        return value

    def mean_square(self, z: tuple[Any, ...], total: Callable[[Any], Any]) -> Any:
        """Return the weighted mean of the squared log-odds."""
        squares, count = self.weights @ z[0] ** 2, jnp.sum(self.weights)
        for choices, part in zip(self.wide, z[1:], strict=True):
            squares += jnp.sum(part**2, axis=0) @ choices.weights
            count += jnp.sum(choices.possible, axis=0) @ choices.weights
        return total(squares) / jnp.maximum(total(count), 1.0)

    def gradient(self, z: tuple[Any, ...]) -> Any:
        """Return the gradient (p,) of the loss alone."""
        slope = self.gap @ (self.weights * (jax.nn.sigmoid(z[0]) - self.labels))
        more = [wide_derivatives(*pair)[0] for pair in zip(self.wide, z[1:], strict=True)]
        return sum(more, slope)

    def derivatives(self, z: tuple[Any, ...], total: Callable[[Any], Any]) -> tuple[Any, Any]:
        """Return gradient (p,) and Hessian (p, p) of the loss."""
        gradient, hessian = data_derivatives(self.gap, z[0], self.labels, self.weights, total)
        for choices, part in zip(self.wide, z[1:], strict=True):
            more = wide_derivatives(choices, part)
            gradient, hessian = gradient + more[0], hessian + more[1]
        return gradient, hessian


def _exponentials(choices: Wide, z: Any) -> tuple[Any, Any, Any]:
    """Return m, exp(z − m) and their sum, exp(−m) of the first alternative included."""
    open_z = jnp.where(choices.possible, z, -jnp.inf)
    m = jnp.maximum(jnp.max(open_z, axis=0), 0.0)
    e = jnp.exp(open_z - m)
    return m, e, jnp.exp(-m) + jnp.sum(e, axis=0)


def minus_log(choices: Wide, z: Any) -> Any:
    """Return −log P (size,) of what is chosen, from the gaps z (K − 1, size) of utilities."""
    m, _, total = _exponentials(choices, z)
    return m + jnp.log(total) - jnp.sum(choices.labels * z, axis=0)


def wide_derivatives(choices: Wide, z: Any) -> tuple[Any, Any]:
    """Return gradient and Hessian of Σ −log P, in one pass as `data_derivatives`."""
    p, K, size = choices.gap.shape
    _, e, sums = _exponentials(choices, z)
    P = e / sums
    slope = choices.weights * (P - choices.labels)

    def block(gap: Any, slope: Any, P: Any, weights: Any) -> Any:
        flat = gap.reshape(p, -1)
        mean = jnp.sum(gap * P, axis=1)
        pull = slope.reshape(1, -1) @ flat.T
        curvature = (gap * (P * weights)).reshape(p, -1) @ flat.T - (mean * weights) @ mean.T
        return jnp.concatenate([curvature, pull])

    arrays = choices.gap, slope, P, choices.weights
    length = max(1, BLOCK // K)
    if size <= length:
        stacked = block(*arrays)
    else:

        def add(k: Any, stacked: Any) -> Any:
            parts = [jax.lax.dynamic_slice_in_dim(a, k * length, length, -1) for a in arrays]
            return stacked + block(*parts)

        stacked = jax.lax.fori_loop(0, size // length, add, jnp.zeros((p + 1, p)))
    return stacked[-1], stacked[:-1]
