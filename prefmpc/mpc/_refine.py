"""The last digits of a quadratic program: from a solver's point to the exact vertex or face."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

CHANGES = 12
"""How often the set of active limits may change."""

REFINEMENTS = 8
PROXIMAL = 1e-11
EXACT = 1e-12
"""A limit is kept, or a multiplier has a sign, to within this share of their sizes."""


class Refiner:
    """Improve solutions of min ½ zᵀPz + qᵀz over lower ≤ rows z ≤ upper, for one P and rows.

    Limits that look active are taken as equations; those that turn out wrong are changed. Units
    must be such that z, the multipliers y and the rows are of order one.
    """

    def __init__(self, P: Any, rows: Any) -> None:
        m, n = rows.shape
        self._P, self._rows = sp.csr_matrix(P), sp.csr_matrix(rows)
        self._columns = sp.csr_matrix(self._rows.T)
        # The matrix of the optimality conditions, once; what is not active is masked out of it.
        rows = self._rows.tocoo()
        weights = self._P.tocoo()
        diagonal = np.arange(n + m)
        i = np.concatenate([weights.row, rows.row + n, rows.col, diagonal])
        j = np.concatenate([weights.col, rows.col, rows.row + n, diagonal])
        order = np.lexsort((i, j))
        self._shape, self._i = (n + m, n + m), i[order].astype(np.int32)
        self._starts = np.searchsorted(j[order], np.arange(n + m + 1)).astype(np.int32)
        nothing = np.zeros(n + m)
        self._data = np.concatenate([weights.data, rows.data, rows.data, nothing])[order]
        # Which limit an entry belongs to; the last one is always there.
        owner = np.full(len(i), m)
        owner[weights.nnz : weights.nnz + 2 * rows.nnz] = np.tile(rows.row, 2)
        self._owner = owner[order]
        self._diagonal = np.flatnonzero(order >= len(i) - (n + m))

    def __call__(
        self, q: np.ndarray, lower: np.ndarray, upper: np.ndarray, z: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return z and y, better as a rule; the caller has to judge them."""
        same, at = lower == upper, self._rows @ z
        high = ~same & (upper - at < y)
        low = ~same & ~high & (at - lower < -y)
        for _ in range(CHANGES):
            active = same | high | low
            target = np.where(active, np.where(low, lower, upper), 0.0)
            try:
                z, y = self._on_equations(q, active, target, z, np.where(active, y, 0.0))
            except RuntimeError:  # a singular matrix
                break
            if not (np.isfinite(z).all() and np.isfinite(y).all()):
                break
            at = self._rows @ z
            slack = EXACT * np.maximum(1.0, np.abs(at))
            wrong = EXACT * float(np.abs(y).max(initial=0.0))
            over, under = ~same & (at > upper + slack), ~same & (at < lower - slack)
            leave = (high & (y < -wrong)) | (low & (y > wrong))
            if not (over | under | leave).any():
                break
            high, low = (high & ~leave) | over, (low & ~leave) | under
        return z, y

    def _on_equations(
        self, q: np.ndarray, active: np.ndarray, target: np.ndarray, z: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the minimum on the active limits, by steps that a proximal term makes safe."""
        n = len(z)
        there = np.append(active, True)
        data = np.where(there[self._owner], self._data, 0.0)
        # Without the proximal term there may be equations that say the same.
        inner = np.where(active, -PROXIMAL, -1.0)
        data[self._diagonal] = np.concatenate([np.full(n, PROXIMAL), inner])
        entries = np.flatnonzero(data)
        starts = np.searchsorted(entries, self._starts).astype(np.int32)
        factor = splu(sp.csc_matrix((data[entries], self._i[entries], starts), shape=self._shape))
        best, left = (z, y), np.inf
        for _ in range(REFINEMENTS):
            rest = np.concatenate(
                [
                    -q - self._P @ z - self._columns @ y,
                    np.where(active, target - self._rows @ z, 0.0),
                ]
            )
            size = float(np.abs(rest).max(initial=0.0))
            if not size < 0.5 * left:
                break
            best, left = (z, y), size
            step = factor.solve(rest)
            z, y = z + step[:n], y + step[n:]
        return best
