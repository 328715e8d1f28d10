"""Limits that no input can help to keep: what they say of x_0, and what counts as on a limit."""

from __future__ import annotations

from typing import Any

import numpy as np

from prefmpc._checks import array_module

ON_LIMIT = 1e-6
"""How far beyond a limit a state may be to count as on it, relative to `row_sizes`."""

MOVES = 1e-12
"""An input moves a row if it does so by more than rounding."""


def unmoved(A: Any, B: Any, Hx: Any, Hu: Any, stages: int) -> Any:
    """Say which rows H_x x_k + H_u u_k no input moves at stage k = 0 … stages − 1.

    Returns a bool array (stages, rows). Hu is None for rows of the state alone.
    """
    xp = array_module(A, Hx)
    blind = xp.ones(len(Hx), bool) if Hu is None else ~(Hu != 0).any(axis=1)
    out, row, size = [blind], Hx, xp.abs(Hx)
    # By Cayley and Hamilton a row that nx steps have not moved never moves.
    for _ in range(min(stages - 1, len(A))):
        blind = blind & ~(xp.abs(row @ B) > MOVES * (size @ xp.abs(B))).any(axis=1)
        out.append(blind)
        row, size = row @ A, size @ xp.abs(A)
    return xp.stack(out + [blind] * (stages - len(out)))


def per_unit(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same rows H z ≤ h with a largest entry of 1 each."""
    sizes = np.abs(H).max(axis=1, initial=0.0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    return H / sizes[:, None], h / sizes


def row_sizes(A: Any, B: Any, u_size: Any, x0: Any, Hx: Any, h: Any) -> Any:
    """Return the size (..., rows) that rows of the state have near x0 (..., nx).

    The limit itself or, where that is zero, what the row can be one step before or after: in any
    unit of states and inputs the same share of it. ``u_size`` (nu,) are the inputs' largest sizes.
    """
    xp = array_module(A, x0)
    step = xp.abs(x0) @ xp.abs(A).swapaxes(-1, -2) + xp.abs(B) @ u_size
    reach = xp.maximum(xp.abs(x0), step) @ xp.abs(Hx).swapaxes(-1, -2)
    return xp.maximum(xp.abs(h), reach)


def input_size(u_min: Any, u_max: Any) -> Any:
    """Return the largest size (nu,) of each input, 0 where it has no limit."""
    xp = array_module(u_min)
    bounds = xp.stack([xp.abs(u_min), xp.abs(u_max)])
    return xp.where(xp.isfinite(bounds), bounds, 0.0).max(0)
