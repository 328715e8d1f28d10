"""Bounded nonlinear programs min f(z), c(z) ≤ 0, lower ≤ z ≤ upper, and the check of a point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import nnls

from prefmpc.mpc._limits import ON_LIMIT
from prefmpc.mpc._shooting import Slopes

ACTIVE = 1e-6
"""A constraint this close to its limit, relative to its size, may carry a multiplier."""

REMEMBERED = 4


@dataclasses.dataclass(frozen=True)
class Program:
    """Functions of z (n,), already compiled.

    All is in units in which the numbers here have a meaning; see `own_units`.

    Attributes
    ----------
    values : z → f, c (m,)
    slopes : z → ∇f (n,), ∂c/∂z (m, n), and the sizes of both
    curvature : z, multipliers (m,) → ∇²f + Σ_i multiplier_i ∇²c_i, (n, n)
    lower, upper : array (n,)
    rows : m
    """

    values: Callable[[Any], tuple[float, np.ndarray]]
    slopes: Callable[[Any], Slopes]
    curvature: Callable[[Any, Any], np.ndarray]
    lower: np.ndarray
    upper: np.ndarray
    rows: int

    def clipped(self, z: np.ndarray) -> np.ndarray:
        """Return z within its bounds."""
        return np.clip(z, self.lower, self.upper)


def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, which looks up its latest answers instead of computing them again.

    Who chooses where to start, the solvers and the check at the end ask about the same points.
    """
    answers: dict[tuple[bytes, ...], Any] = {}

    def ask(*arrays: np.ndarray) -> Any:
        point = tuple(array.tobytes() for array in arrays)
        if point not in answers:
            if len(answers) == REMEMBERED:
                del answers[next(iter(answers))]
            answers[point] = function(*arrays)
        return answers[point]

    return ask


@dataclasses.dataclass(frozen=True)
class Attempt:
    """Where a solver stopped: the point, whether for its iteration limit, and what was reached."""

    z: np.ndarray
    limited: bool
    iterations: int
    violation: float
    residual: float

    @property
    def feasible(self) -> bool:
        """Whether the point satisfies the constraints."""
        return bool(self.violation <= ON_LIMIT)

    def good(self, tol: float) -> bool:
        """Whether it also satisfies the conditions for a minimum."""
        return self.feasible and bool(self.residual <= tol)


def judged(program: Program, z: np.ndarray, limited: bool, iterations: int) -> Attempt:
    """Judge where a solver stopped without trusting what it says."""
    z = program.clipped(z)
    beyond = violation(program, z)
    residual = stationarity(program, z) if np.isfinite(beyond) else np.inf
    return Attempt(z, limited, iterations, beyond, residual)


def violation(program: Program, z: np.ndarray) -> float:
    """Return the largest violation of a constraint, relative to its size; ∞ if it is unknown."""
    f, c = program.values(z)
    if not (np.isfinite(f) and np.isfinite(c).all()):
        return np.inf
    if not (c > 0).any():
        return 0.0
    size = program.slopes(z).rows
    worst = float((np.maximum(c, 0.0) / np.where(size > 0, size, 1.0)).max())
    return worst if np.isfinite(worst) else np.inf


def stationarity(program: Program, z: np.ndarray) -> float:
    """Return how far ∇f is from what active constraints can balance, relative to its terms' size.

    The multipliers are the best nonnegative ones, from a least-squares problem of their own. ∞ if
    anything is unknown.
    """
    c = program.values(z)[1]
    gradient, jacobian, size, rows, _ = program.slopes(z)
    if not all(np.isfinite(part).all() for part in (gradient, jacobian, size, rows)):
        return np.inf
    eye = np.eye(z.size)
    width = np.minimum(program.upper - program.lower, 1.0)
    active = np.concatenate(
        [
            jacobian[c > -ACTIVE * rows],
            eye[program.upper - z <= ACTIVE * width],
            -eye[z - program.lower <= ACTIVE * width],
        ]
    )
    residual = gradient
    if active.size:
        length = np.maximum(np.linalg.norm(active, axis=1), 1e-12)
        normals = (active / length[:, None]).T
        try:
            multipliers, _ = nnls(normals, -gradient, maxiter=30 * len(active))
        except RuntimeError:
            return np.inf
        residual = gradient + normals @ multipliers
    # Each input for itself: in an unstable plant the first ones matter far more than the last.
    return float((np.abs(residual) / np.where(size > 0, size, 1.0)).max(initial=0.0))


def promising(program: Program, guesses: list[np.ndarray]) -> list[np.ndarray]:
    """Return the points to start from, the most promising first: small f, few limits broken."""
    if len(guesses) == 1:
        return guesses
    f, c = (np.array(part) for part in zip(*map(program.values, guesses), strict=True))
    broken = np.zeros(len(f))
    if (c > 0).any():
        size = program.slopes(guesses[0]).near
        broken = (np.maximum(c, 0) / np.where(size > 0, size, 1.0)).sum(axis=1)
    merit = f + 1e3 * np.abs(f[np.isfinite(f)]).max(initial=0.0) * broken
    order = np.lexsort((broken, np.where(np.isfinite(merit), merit, np.inf)))
    return [guesses[i] for i in order]
