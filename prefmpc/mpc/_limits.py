"""Limits that no input can help to keep: what they say of x_0, and what counts as on a limit."""

from __future__ import annotations

from typing import Any

import numpy as np

ON_LIMIT = 1e-6
"""How far beyond a limit a state may be to count as on it, relative to `row_sizes`."""

MOVES = 1e-12
"""An input moves a row if it does so by more than rounding."""


def unmoved(A: np.ndarray, B: np.ndarray, Hx: np.ndarray, Hu: Any, stages: int) -> np.ndarray:
    """Say which rows H_x x_k + H_u u_k no input moves at stage k = 0 … stages − 1.

    Returns a bool array (stages, rows). Hu is None for rows of the state alone.
    """
    blind = np.ones(len(Hx), bool) if Hu is None else ~np.asarray(Hu).any(axis=1)
    out = np.empty((stages, len(Hx)), bool)
    row, size = Hx, np.abs(Hx)
    for k in range(stages):
        out[k] = blind
        if k < len(A):  # by Cayley and Hamilton a row that nx steps have not moved never moves
            blind = blind & ~(np.abs(row @ B) > MOVES * (size @ np.abs(B))).any(axis=1)
            row, size = row @ A, size @ np.abs(A)
    return out


def row_sizes(A: Any, B: Any, u_size: Any, x0: Any, Hx: Any, h: Any) -> Any:
    """Return the size (..., rows) that rows of the state have near x0 (..., nx).

    The limit itself or, where that is zero, what the row can be one step before or after: in any
    unit of states and inputs the same share of it. ``u_size`` (nu,) are the inputs' largest sizes.
    """
    xp = np if isinstance(x0, np.ndarray) and isinstance(A, np.ndarray) else _jax_numpy()
    step = xp.abs(x0) @ xp.abs(A).swapaxes(-1, -2) + xp.abs(B) @ u_size
    reach = xp.maximum(xp.abs(x0), step) @ xp.abs(Hx).swapaxes(-1, -2)
    return xp.maximum(xp.abs(h), reach)


def input_size(u_min: Any, u_max: Any) -> Any:
    """Return the largest size (nu,) of each input, 0 where it has no limit."""
    xp = np if isinstance(u_min, np.ndarray) else _jax_numpy()
    both = xp.stack([xp.abs(u_min), xp.abs(u_max)])
    return xp.where(xp.isfinite(both), both, 0.0).max(0)


def _jax_numpy() -> Any:
    import jax.numpy as jnp

    return jnp
