"""A σ that is linear in its weights: what it sees of a trajectory, and coordinates of the weights.

σ(T) = wᵀφ(T). The features φ are in units in which the prior's centre is w = (1, …, 1) for the
diagonal, so that nothing depends on the user's units.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from prefmpc.models.quadratic import CostModel, QuadraticCost
from prefmpc.models.separable import SeparableCost
from prefmpc.preferences.trajectories import Trajectory, second_moments


class Chart:
    """η (p,) ↦ w (p,), the lower triangle of W = L Lᵀ with L = diag(e^{η_ii/2})·T.

    T is unit lower triangular, its free entries are coordinates themselves. Every η gives a
    positive definite W, and before any coupling W_ii = e^{η_ii}: log weights. With diagonal
    entries alone this is w = e^η.

    Parameters
    ----------
    rows, columns : int array (p,)
        The free entries of L and of W.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray) -> None:
        self.rows, self.columns = rows, columns
        self.diagonal = rows == columns
        self.size = int(rows.max()) + 1
        place = np.full(self.size, -1)
        place[rows[self.diagonal]] = np.flatnonzero(self.diagonal)
        self.of_row = place[rows]
        """Which coordinate (p,) is the log weight of the row of each entry."""
        self._same_column = columns[:, None] == columns
        self._row_is_row = rows[:, None] == rows
        self._column_is_row = columns[:, None] == rows

    def entries(self, eta: np.ndarray) -> np.ndarray:
        """Return the free entries (..., p) of L."""
        return np.exp(eta[..., self.of_row] / 2) * np.where(self.diagonal, 1.0, eta)

    def factor(self, eta: np.ndarray) -> np.ndarray:
        """Return L (..., d, d)."""
        L = np.zeros((*eta.shape[:-1], self.size, self.size))
        L[..., self.rows, self.columns] = self.entries(eta)
        return L

    def weights(self, eta: np.ndarray) -> np.ndarray:
        """Return w (..., p)."""
        if self.diagonal.all():
            return np.exp(eta)
        L = self.factor(eta)
        return (L @ L.swapaxes(-1, -2))[..., self.rows, self.columns]

    def mean_weights(self, eta: np.ndarray) -> np.ndarray:
        """Return the mean (p,) of weights of equal sharpness, for samples η (m, p).

        Sharpness is the mean of the log weights; that of the mean is its own mean.
        """
        sharpness = eta[:, self.diagonal].mean(axis=1)
        relative = self.weights(eta) * np.exp(-sharpness)[:, None]
        return relative.mean(axis=0) * np.exp(sharpness.mean())

    def derivatives(self, eta: np.ndarray) -> tuple[np.ndarray, Any]:
        """Return ∂w/∂η (p, p), and the function g (p,) ↦ Σ_k g_k ∂²w_k/∂η² (p, p)."""
        if self.diagonal.all():
            w = np.exp(eta)
            return np.diag(w), lambda g: np.diag(g * w)
        p, number = eta.size, np.arange(eta.size)
        L, entries = self.factor(eta), self.entries(eta)
        scale = np.exp(eta[self.of_row] / 2)
        inner = np.zeros((p, p))  # ∂(entries of L)/∂η
        inner[number, number] = scale
        inner[number, self.of_row] = entries / 2
        outer = self._row_is_row * L[self.columns[:, None], self.columns]
        outer = outer + self._column_is_row * L[self.rows[:, None], self.columns]

        def second(g: np.ndarray) -> np.ndarray:
            G = np.zeros_like(L)
            np.add.at(G, (self.rows, self.columns), g / 2)
            np.add.at(G, (self.columns, self.rows), g / 2)
            out = inner.T @ (2 * G[self.rows[:, None], self.rows] * self._same_column) @ inner
            slope = 2 * (G @ L)[self.rows, self.columns]
            np.add.at(out, (self.of_row, self.of_row), slope * entries / 4)
            free = ~self.diagonal
            mixed = (slope * scale / 2)[free]
            np.add.at(out, (self.of_row[free], number[free]), mixed)
            np.add.at(out, (number[free], self.of_row[free]), mixed)
            return out

        return outer @ inner, second


class FeatureMap(Protocol):
    """What a belief needs of a kind of σ."""

    chart: Chart

    def __call__(self, trajectory: Trajectory) -> np.ndarray:
        """Return φ (..., p)."""

    def model(self, w: np.ndarray) -> CostModel:
        """Return σ, or a stack of them, for weights (p,) or (m, p)."""


class QuadraticFeatures:
    """φ of a quadratic σ, diagonal or full: second moments.

    Parameters
    ----------
    Q, R : array (nx, nx), (nu, nu)
        The centre of the prior, positive definite; diagonal if ``full`` is False.
    full : bool
        Whether the weights of two states, or of two inputs, may be coupled.
    """

    def __init__(self, Q: np.ndarray, R: np.ndarray, full: bool) -> None:
        self.roots = np.linalg.cholesky(Q), np.linalg.cholesky(R)
        pairs = [np.tril_indices(len(M)) if full else (np.arange(len(M)),) * 2 for M in (Q, R)]
        at = (0, len(Q))
        rows, columns = (
            np.concatenate([pair[i] + first for pair, first in zip(pairs, at, strict=True)])
            for i in (0, 1)
        )
        self.chart = Chart(rows, columns)
        self._pairs = pairs

    def __call__(self, trajectory: Trajectory) -> np.ndarray:
        """Return the second moments (..., p), off-diagonal ones doubled."""
        parts = []
        for S, C, (i, j) in zip(second_moments(trajectory), self.roots, self._pairs, strict=True):
            inner = C.T @ np.asarray(S) @ C
            parts.append(inner[..., i, j] * np.where(i == j, 1.0, 2.0))
        return np.concatenate(parts, axis=-1)

    def model(self, w: np.ndarray) -> QuadraticCost:
        """Return σ, or a stack of them."""
        n, rows, columns = len(self.roots[0]), self.chart.rows, self.chart.columns
        W = np.zeros((*w.shape[:-1], self.chart.size, self.chart.size))
        W[..., rows, columns] = W[..., columns, rows] = w
        blocks = W[..., :n, :n], W[..., n:, n:]
        return QuadraticCost(*(C @ M @ C.T for C, M in zip(self.roots, blocks, strict=True)))


class SeparableFeatures:
    """φ of a `SeparableCost`: sums over time of three shapes of every signal.

    Parameters
    ----------
    centre : SeparableCost
        A single one with positive weights: the centre of the prior.
    """

    def __init__(self, centre: SeparableCost) -> None:
        self.centre = centre
        number = np.arange(np.size(centre.c))
        self.chart = Chart(number, number)

    def __call__(self, trajectory: Trajectory) -> np.ndarray:
        """Return the features (..., p) times the centre's weights."""
        return np.asarray(self.centre.features(trajectory)) * np.ravel(self.centre.c)

    def model(self, w: np.ndarray) -> SeparableCost:
        """Return σ, or a stack of them."""
        c = w.reshape(*w.shape[:-1], *np.shape(self.centre.c)) * self.centre.c
        return SeparableCost(c, scale=np.array(self.centre.scale))
