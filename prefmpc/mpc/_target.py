"""The steady state of a linear plant that comes nearest to an output, by linear algebra."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from prefmpc._units import completed_units
from prefmpc.mpc._cone import TIGHT, ConeProgram
from prefmpc.mpc._limits import per_unit
from prefmpc.systems.sets import Polyhedron

EXACT = 1e-12
CONSISTENT = 1e-9


@dataclasses.dataclass(frozen=True)
class Target:
    """What to hold: M (x, u) = right with M = (A − I, B), C x as near to ``goal`` as possible.

    Attributes
    ----------
    A, B, C, right, goal
    sizes : array (nx + nu,)
        Units of x and u.
    rank : float
        Singular values below this share of the largest are zero.
    keep : array (nx,), optional
        Combinations of the states that every input leaves as they are have the value that they
        have for this x. None: they are free.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    right: np.ndarray
    goal: np.ndarray
    sizes: np.ndarray
    rank: float = EXACT
    keep: np.ndarray | None = None

    def solve(self, Z: Polyhedron | None) -> np.ndarray | None:
        """Return (x, u), or None if nothing can be held within Z (None: without limits).

        First comes the smallest ‖C x − goal‖, then the least norm in ``sizes``.
        """
        space = self._steady()
        if space is None:
            return None
        z, free = space
        n = len(self.A)
        C, sizes = self.C * self.sizes[:n], self.sizes
        reach = C @ free[:n]
        near, rest = _nearest(reach, self.goal - C @ z[:n], self.rank)
        best = z + free @ near
        if Z is None:
            return best * sizes
        H, h = per_unit(Z.H * sizes, Z.h)
        if (H @ best <= h + EXACT * np.maximum(np.abs(h), np.abs(H) @ np.abs(best))).all():
            return best * sizes
        w = _within(reach, near, rest, H @ free, h - H @ z)
        return None if w is None else (z + free @ w) * sizes

    def _steady(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the shortest steady state, and a basis of the differences of all, in ``sizes``."""
        n = len(self.A)
        dx = self.sizes[:n]
        M = np.concatenate([self.A - np.eye(n), self.B], axis=1) * self.sizes / dx[:, None]
        right = self.right / dx
        if self.keep is not None:
            fixed = kept(self.A, self.B, self.sizes, self.rank) * dx
            M = np.concatenate([M, np.pad(fixed, ((0, 0), (0, self.B.shape[1])))])
            right = np.concatenate([right, fixed @ (self.keep / dx)])
        z = np.linalg.lstsq(M, right, rcond=self.rank)[0]
        z += np.linalg.lstsq(M, right - M @ z, rcond=self.rank)[0]
        miss = np.abs(M @ z - right).max()
        if not miss <= CONSISTENT * max(float(np.abs(right).max()), float(np.abs(z).max())):
            return None
        _, values, across = np.linalg.svd(M)
        count = int((values > self.rank * values.max(initial=0.0)).sum())
        return z, across[count:].T


def kept(A: np.ndarray, B: np.ndarray, sizes: np.ndarray, rank: float = EXACT) -> np.ndarray:
    """Return the combinations (k, nx) of states that stay what they are, whatever the input."""
    dx = sizes[: len(A)]
    M = np.concatenate([A - np.eye(len(A)), B], axis=1) * sizes / dx[:, None]
    left, values, _ = np.linalg.svd(M)
    return left[:, values <= rank * values.max(initial=0.0)].T / dx


def input_sizes(A: Any, B: Any, C: Any, u_min: np.ndarray, u_max: np.ndarray) -> np.ndarray:
    """Return units (nx + nu,) of x and u: half the range of each input, and what that moves.

    An input without limits has the unit with which it moves the output as much as the others.
    """
    with np.errstate(invalid="ignore"):
        ranges = (u_max - u_min) / 2
    ranges = np.where(np.isfinite(ranges), ranges, 0.0)
    moves, effect, at = np.abs(B), np.abs(C @ B), B
    for _ in range(len(A)):
        at = A @ at
        moves, effect = np.maximum(moves, np.abs(at)), effect + np.abs(C @ at)
    strength = np.linalg.norm(effect, axis=0)
    common = (strength * ranges).max(initial=0.0)
    common = common if common > 0 else 1.0
    guess = np.where(strength > 0, common / np.where(strength > 0, strength, 1.0), 0.0)
    inputs = np.where(ranges > 0, ranges, guess)
    return np.concatenate(completed_units(A, B, (moves * inputs).max(axis=1), inputs))


def _nearest(reach: np.ndarray, goal: np.ndarray, rank: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest w with reach @ w nearest to goal, and a basis of what changes nothing.

    Outputs in small units count as much as others wherever the goal can be reached.
    """
    rows = np.linalg.norm(reach, axis=1)
    rows = np.where(rows > 0, rows, 1.0)
    _, values, across = np.linalg.svd(reach / rows[:, None])
    rest = across[int((values > rank * values.max(initial=0.0)).sum()) :].T
    w = np.linalg.lstsq(reach / rows[:, None], goal / rows, rcond=rank)[0]
    miss = np.abs(reach @ w - goal)
    if not (miss <= CONSISTENT * np.maximum(np.abs(goal), np.abs(reach) @ np.abs(w))).all():
        w = np.linalg.lstsq(reach, goal, rcond=rank)[0]
    return w, rest


def _within(
    reach: np.ndarray, near: np.ndarray, rest: np.ndarray, H: np.ndarray, h: np.ndarray
) -> np.ndarray | None:
    """Return w with H w ≤ h: reach @ w nearest to reach @ near, then the least ‖w‖."""
    # The coordinates of w that move the output, then those that do not.
    moving = np.linalg.svd(rest, full_matrices=True)[0][:, rest.shape[1] :]
    size = np.abs(reach @ moving).max(initial=0.0)
    slopes = reach @ moving / (size if size > 0 else 1.0)
    padded = np.concatenate([slopes, np.zeros((len(slopes), rest.shape[1]))], axis=1)
    basis = np.concatenate([moving, rest], axis=1)
    first = _program(padded.T @ padded, -padded.T @ (padded @ (basis.T @ near)), H @ basis, h)
    if first is None or not rest.shape[1]:
        return None if first is None else basis @ first
    start = moving @ first[: moving.shape[1]]
    second = _program(np.eye(rest.shape[1]), np.zeros(rest.shape[1]), H @ rest, h - H @ start)
    return basis @ first if second is None else start + rest @ second


def _program(P: np.ndarray, q: np.ndarray, H: np.ndarray, h: np.ndarray) -> np.ndarray | None:
    """Return the minimum of ½ wᵀPw + qᵀw over H w ≤ h; None if there is none."""
    sizes = np.abs(H).max(axis=1)
    free = sizes <= EXACT  # nothing moves these rows
    if (h[free] < -CONSISTENT * np.abs(h).max()).any():
        return None
    cones = [("nonnegative", int((~free).sum()))]
    program = ConeProgram(P, q, H[~free], h[~free], cones, TIGHT, good=0.0)
    answer = program.solve(h[~free])
    return answer.z if answer.status == "solved" else None
