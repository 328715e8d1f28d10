"""Units in which a plant and a quadratic cost have numbers of order one, whatever the user's."""

from __future__ import annotations

import math

import numpy as np

# The cost-to-go of so many steps says how much a state matters; for a unit that is enough.
STEPS = 20

FARTHEST = 1e6
"""No unit of a state is so many times larger than what a unit of what drives it does in a step."""


def cost_units(
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    *,
    final: np.ndarray | None = None,
    steps: int = STEPS,
) -> tuple[np.ndarray, np.ndarray]:
    """Return units (nx,) of the states and (nu,) of the inputs in which each costs about 1.

    The diagonals of the cost-to-go P of some steps and of R + BᵀPB are 1 in these units. They
    change with the user's units exactly as the signals do, and with σ as 1/√σ. A state that does
    not matter for the cost gets a unit from the states that it depends on or that depend on it.
    """
    P = Q if final is None else final
    S = R + B.T @ P @ B
    for _ in range(min(steps, max(STEPS, len(A)))):
        own = _inverse_roots(np.diag(S))
        # Solved in units of its own; an input without any weight stays at zero.
        inner = own[:, None] * S * own + np.diag(np.where(own > 0, 1e-14, 1.0))
        K = own[:, None] * np.linalg.solve(inner, own[:, None] * (B.T @ P @ A))
        closed = A - B @ K
        P = Q + K.T @ R @ K + closed.T @ P @ closed
        P = (P + P.T) / 2
        S = R + B.T @ P @ B
    states, inputs = _inverse_roots(np.diag(P)), _inverse_roots(np.diag(S))
    driven = np.maximum(
        (np.abs(A - np.diag(np.diag(A))) * states).max(axis=1), (np.abs(B) * inputs).max(axis=1)
    )
    # A weight that is rounding would give a unit in which the state itself is rounding.
    states = np.where(driven > 0, np.minimum(states, FARTHEST * driven), states)
    return completed_units(A, B, states, inputs)


def power_of_two(size: float) -> float:
    """Return the power of 2 next above, so that division by it is exact; 1 for no size at all."""
    return math.ldexp(1.0, math.frexp(size)[1]) if 1e-290 < size < 1e290 else 1.0


def _inverse_roots(values: np.ndarray) -> np.ndarray:
    """Return 1/√v, and 0 where that is none."""
    usable = np.isfinite(values) & (values > 0)
    return np.where(usable, 1 / np.sqrt(np.where(usable, values, 1.0)), 0.0)


def completed_units(
    A: np.ndarray, B: np.ndarray, states: np.ndarray, inputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Give a unit to what has none yet (0): from what drives it, else from what it drives."""
    sizes = np.concatenate([states, inputs])
    n = len(states)
    gain = np.zeros((len(sizes), len(sizes)))
    gain[:n] = np.abs(np.concatenate([A, B], axis=1))
    np.fill_diagonal(gain, 0.0)
    for _ in range(len(sizes)):
        driven = (gain * sizes).max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            driving = np.where((gain > 0) & (sizes > 0)[:, None], sizes[:, None] / gain, np.inf)
        back = driving.min(axis=0)
        guess = np.where(driven > 0, driven, np.where(np.isfinite(back), back, 0.0))
        if not ((sizes == 0) & (guess > 0)).any():
            break
        sizes = np.where(sizes > 0, sizes, guess)
    sizes = np.where(sizes > 0, sizes, 1.0)
    return sizes[:n], sizes[n:]


def matters(A: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Say which states the cost xᵀQx sees, at once or later through others; a bool array (nx,)."""
    seen = np.diag(Q) > 0
    for _ in range(len(A)):
        seen = seen | ((A != 0) & seen[:, None]).any(axis=0)
    return seen


def free_response(A: np.ndarray, x0: np.ndarray, steps: int) -> np.ndarray:
    """Return x_0 … x_steps, shape (steps + 1, ...), without inputs."""
    out = [x0]
    for _ in range(steps):
        out.append(A @ out[-1])
    return np.stack(out)
