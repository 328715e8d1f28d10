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


def refined(
    P: Any,
    q: np.ndarray,
    rows: Any,
    lower: np.ndarray,
    upper: np.ndarray,
    z: np.ndarray,
    y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Improve z and the multipliers y of min ½ zᵀPz + qᵀz over lower ≤ rows z ≤ upper.

    Limits that look active are taken as equations; those that turn out wrong are changed. Units
    must be such that z, y and the rows are of order one. The answer may be no better than what
    came in: the caller has to judge it.
    """
    rows = sp.csr_matrix(rows)
    same = lower == upper
    at = rows @ z
    high = ~same & (upper - at < y)
    low = ~same & ~high & (at - lower < -y)
    for _ in range(CHANGES):
        active = np.flatnonzero(same | high | low)
        target = np.where(low, lower, upper)[active]
        try:
            z, inner = _on_equations(P, q, rows[active], target, z, y[active])
        except RuntimeError:  # a singular matrix
            break
        y = np.zeros(len(y))
        y[active] = inner
        if not (np.isfinite(z).all() and np.isfinite(y).all()):
            break
        at = rows @ z
        slack = EXACT * max(1.0, float(np.abs(z).max(initial=0.0)))
        wrong = EXACT * float(np.abs(y).max(initial=0.0))
        over, under = ~same & (at > upper + slack), ~same & (at < lower - slack)
        leave = (high & (y < -wrong)) | (low & (y > wrong))
        if not (over | under | leave).any():
            break
        high, low = (high & ~leave) | over, (low & ~leave) | under
    return z, y


def _on_equations(
    P: Any, q: np.ndarray, rows: Any, target: np.ndarray, z: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum over rows z = target, by steps that a small proximal term makes safe."""
    n, m = len(z), len(target)
    near = sp.diags_array(np.concatenate([np.full(n, PROXIMAL), np.full(m, -PROXIMAL)]))
    exact = sp.block_array([[P, rows.T], [rows, None]], format="csc")
    # Without ``near`` there may be equations that say the same.
    factor = splu(sp.csc_matrix(exact + near))
    point, right = np.concatenate([z, y]), np.concatenate([-q, target])
    best, left = point, np.inf
    for _ in range(REFINEMENTS):
        rest = right - exact @ point
        size = float(np.abs(rest).max(initial=0.0))
        if not size < 0.5 * left:
            break
        best, left = point, size
        point = point + factor.solve(rest)
    return best[:n], best[n:]
