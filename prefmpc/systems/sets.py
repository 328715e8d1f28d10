"""Constraint sets: polyhedra, ellipsoids and cones.

A set with finitely many faces is a constructor of `Polyhedron`, like `Polyhedron.box`.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import bounds_pair, finite_array, nonnegative, positive, shaped
from prefmpc._matrices import psd_matrix
from prefmpc._pytree import set_fields


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Polyhedron:
    """The set {z : H z ≤ h}.

    As the constraint set Z of eq. (7d) of arXiv 2511.22502 z is the stacked vector (x, u); as the
    terminal set X_N of eq. (7e) it is x alone.

    Parameters
    ----------
    H : array (m, n)
        One row a half-space, in the units of 1 / z times the unit of h.
    h : array (m,)
        Rows whose limit is +inf bound nothing and are left out.

    Raises
    ------
    ValueError
        If H holds NaN or infinite values or h NaN or −inf, or their shapes do not fit.
    """

    H: np.ndarray
    h: np.ndarray

    def __init__(self, H: ArrayLike, h: ArrayLike) -> None:
        H = np.asarray(finite_array("H", H, ndim=2))
        h = np.asarray(finite_array("h", h, ndim=1, allow_inf=True))
        if H.shape[0] != h.shape[0]:
            raise ValueError(
                f"H and h must have the same number of rows, got {H.shape} and {h.shape}"
            )
        if H.shape[1] == 0:
            raise ValueError(f"H must have at least one column, got shape {H.shape}")
        if (h == -np.inf).any():
            raise ValueError(f"h must be above minus infinity, got {h}")
        bounds = np.isfinite(h)
        set_fields(self, H=H[bounds], h=h[bounds])

    @property
    def dim(self) -> int:
        """Number of entries of z."""
        return int(self.H.shape[1])

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> Polyhedron:
        """Return {z : lower ≤ z ≤ upper} for arrays (n,), one of which may be a number.

        Infinite entries leave that side open, equal ones hold an entry of z where it is.
        """
        low, high = (
            np.asarray(finite_array(name, value, allow_inf=True))
            for name, value in {"lower": lower, "upper": upper}.items()
        )
        size = low.size if low.ndim else high.size
        low, high = bounds_pair(("lower", "upper"), low, high, size)
        eye = np.eye(size)
        return cls(np.concatenate([eye, -eye]), np.concatenate([high, -low]))

    def contains(self, z: ArrayLike, tol: float = 1e-9) -> np.ndarray:
        """Say for each z (..., n) whether H z ≤ h; a bool array (...).

        ``tol`` is relative to the larger of abs(h) and abs(H)·abs(z), whatever the units.
        """
        z, tol = _points(z, self.dim), nonnegative("tol", tol)
        size = np.maximum(np.abs(self.h), np.abs(z) @ np.abs(self.H).T)
        return np.asarray((z @ self.H.T <= self.h + tol * size).all(axis=-1))


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Ellipsoid:
    """The set {z : zᵀ P z ≤ level}, about the origin.

    Parameters
    ----------
    P : array (n, n)
        Symmetric positive definite.
    level : float
        Positive; infinite for the whole space.

    Raises
    ------
    ValueError
        If P is not positive definite or ``level`` is not positive.
    """

    P: np.ndarray
    level: float

    def __init__(self, P: ArrayLike, level: float = 1.0) -> None:
        matrix = psd_matrix("P", P, definite=True, stack=False)
        set_fields(self, P=matrix, level=positive("level", level, allow_inf=True))

    @property
    def dim(self) -> int:
        """Number of entries of z."""
        return len(self.P)

    def contains(self, z: ArrayLike, tol: float = 1e-9) -> np.ndarray:
        """Say for each z (..., n) whether zᵀPz ≤ level·(1 + tol); a bool array (...)."""
        z, tol = _points(z, self.dim), nonnegative("tol", tol)
        return np.asarray(np.einsum("...i,ij,...j", z, self.P, z) <= self.level * (1 + tol))


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class SecondOrderCone:
    """The set {z : ‖F z + g‖₂ ≤ cᵀz + d}, for instance a limit on the length of a vector.

    Parameters
    ----------
    F : array (m, n)
    g : array (m,), optional
    c : array (n,), optional
        Default: zeros, which leaves ‖F z‖₂ ≤ d.
    d : float

    Raises
    ------
    ValueError
        If something holds NaN or infinite values, or the shapes do not fit.
    """

    F: np.ndarray
    g: np.ndarray
    c: np.ndarray
    d: float

    def __init__(
        self, F: ArrayLike, d: float, *, g: ArrayLike | None = None, c: ArrayLike | None = None
    ) -> None:
        matrix = np.asarray(finite_array("F", F, ndim=2))
        m, n = matrix.shape
        if not m or not n:
            raise ValueError(f"F must have at least one row and one column, got {matrix.shape}")
        vectors = {}
        for name, value, size in (("g", g, m), ("c", c, n)):
            vectors[name] = np.asarray(
                finite_array(name, np.zeros(size) if value is None else value)
            )
            if vectors[name].shape != (size,):
                raise ValueError(f"{name} must have shape ({size},), got {vectors[name].shape}")
        set_fields(self, F=matrix, d=float(finite_array("d", d, ndim=0)), **vectors)

    @property
    def dim(self) -> int:
        """Number of entries of z."""
        return int(self.F.shape[1])

    def contains(self, z: ArrayLike, tol: float = 1e-9) -> np.ndarray:
        """Say for each z (..., n) whether ‖F z + g‖₂ ≤ cᵀz + d; a bool array (...).

        ``tol`` is relative to the sizes of the terms, whatever the units.
        """
        z, tol = _points(z, self.dim), nonnegative("tol", tol)
        terms = np.abs(z) @ np.abs(self.F).T + np.abs(self.g)
        size = np.maximum(np.linalg.norm(terms, axis=-1), np.abs(z) @ np.abs(self.c) + abs(self.d))
        length = np.linalg.norm(z @ self.F.T + self.g, axis=-1)
        return np.asarray(length <= z @ self.c + self.d + tol * size)


def _points(z: ArrayLike, dim: int) -> np.ndarray:
    return np.asarray(shaped("z", finite_array("z", z), (dim,)))
