"""Small dense quadratic programs, as Newton steps on nonlinear ones need them."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from prefmpc.mpc._limits import ON_LIMIT


def convex(H: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return H, or the like with positive curvature, and whether steps along ``active`` keep it."""
    values, vectors = np.linalg.eigh(H)
    largest = float(np.abs(values).max()) or 1.0
    floor = 1e-8 * largest
    if 0 < values[0] <= floor:  # a matter of units only?
        unit = 1 / np.sqrt(np.diag(H))
        if np.linalg.eigvalsh(H * unit * unit[:, None])[0] > 1e-8:
            return H, True
    if values[0] <= floor and len(active):
        # Curvature across active constraints changes no step that stays on them.
        normals = active / np.maximum(np.linalg.norm(active, axis=1), 1e-12)[:, None]
        H = H + 10 * largest * normals.T @ normals
        values, vectors = np.linalg.eigh(H)
    if values[0] > floor:
        return H, True
    return (vectors * np.maximum(np.abs(values), floor)) @ vectors.T, False


def quadratic_program(
    H: np.ndarray, q: np.ndarray, A: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return d with the least qᵀd + dᵀHd/2 under A d ≤ b, and multipliers; None if there is none.

    With H = LLᵀ this is the search for the point y = Lᵀd + L⁻¹q of a polyhedron nearest to the
    origin, whose multipliers are a nonnegative least-squares problem (Lawson and Hanson, Solving
    Least Squares Problems, chapter 23).
    """
    try:
        L = np.linalg.cholesky(H)
    except np.linalg.LinAlgError:
        return None
    free = solve_triangular(L, q, lower=True)
    G = solve_triangular(L, A.T, lower=True).T
    size = np.linalg.norm(G, axis=1)
    moves = np.linalg.norm(A, axis=1) > 1e-12  # the others hold or not, whatever d is
    if (b[~moves] < -ON_LIMIT).any():
        return None
    G, h = G[moves] / size[moves, None], b[moves] / size[moves]
    h = h + G @ free
    y, multipliers = np.zeros(len(q)), np.zeros(len(b))
    if (h < 0).any():  # else y = 0 will do
        unit = -float(h.min())
        target = np.eye(len(q) + 1)[-1]
        rows = np.concatenate([-G.T, -h[None] / unit])
        try:
            v, rest = nnls(rows, target, maxiter=30 * len(h))
        except RuntimeError:
            return None
        miss = target - rows @ v
        if rest < 1e-10 or miss[-1] <= 1e-14:
            return None
        y = -miss[:-1] / miss[-1] * unit
        multipliers[moves] = v / miss[-1] * unit / size[moves]
    return solve_triangular(L, y - free, lower=True, trans="T"), multipliers
