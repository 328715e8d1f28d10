"""Symmetric positive (semi)definite matrices: the check of weights, and units for them."""

from __future__ import annotations

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array

SYMMETRIC = 1e-9
"""So far a matrix may be from its transpose: rounding, in units in which its diagonal is 1."""

UNDERFLOW = 1e-290
"""On a diagonal this is 0: products of such weights are no numbers any more."""

INDEFINITE = 1e-10
"""So far below 0 an eigenvalue of a semidefinite matrix may be: rounding, in the same units."""


def psd_matrix(
    name: str, value: ArrayLike, *, definite: bool = False, stack: bool = True
) -> np.ndarray:
    """Return a (stack of) symmetric positive (semi)definite matrices, or raise a ValueError.

    Each matrix is judged by itself, and in units in which its diagonal is 1: neither a large
    matrix beside it nor a signal in a small unit hides what is wrong with it.

    Parameters
    ----------
    value : array (..., n, n)
    definite : demand strict positive definiteness.
    stack : whether there may be more than one.
    """
    matrix = np.asarray(finite_array(name, value))
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2] or matrix.shape[-1] == 0:
        raise ValueError(f"{name} must be a square matrix (..., n, n), got shape {matrix.shape}")
    if not stack and matrix.ndim != 2:
        raise ValueError(f"{name} must be one matrix, got shape {matrix.shape}")
    diagonal = np.abs(np.diagonal(matrix, axis1=-2, axis2=-1))
    size = np.sqrt(np.maximum(diagonal, UNDERFLOW))
    lengths = size[..., :, None] * size[..., None, :]
    transposed = np.swapaxes(matrix, -1, -2)
    if (np.abs(matrix - transposed) > SYMMETRIC * np.maximum(lengths, np.abs(matrix))).any():
        raise ValueError(f"{name} must be symmetric, got a matrix that differs from its transpose")
    lost = (diagonal < UNDERFLOW)[..., None] & (np.abs(matrix) <= lengths)
    matrix = np.where(lost | np.swapaxes(lost, -1, -2), 0.0, matrix / 2 + transposed / 2)
    # An entry above 1 beside a diagonal of 1 is indefinite, however large.
    scaled = np.clip(matrix, -2 * lengths, 2 * lengths) / lengths
    smallest = float(np.linalg.eigvalsh(scaled).min(initial=np.inf))
    least = np.finfo(float).eps * matrix.shape[-1] if definite else -INDEFINITE
    if not smallest >= least:
        kind = "definite" if definite else "semidefinite"
        raise ValueError(
            f"{name} must be positive {kind}, got a smallest eigenvalue of {smallest:.3g} "
            "(scaled to 1, 0 or -1 on its diagonal)"
        )
    return matrix


def unit_diagonal(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return D⁻¹MD⁻¹ with a diagonal of ones for M (..., n, n) ⪰ 0, and the diagonal of D.

    A diagonal entry 0 stays 0.
    """
    size = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    size = np.where(size > 0, size, 1.0)
    return matrix / size[..., :, None] / size[..., None, :], size
