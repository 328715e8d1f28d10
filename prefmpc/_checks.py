"""Validation of what users pass in. Every message names the argument, the wish and the gift."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike


def require_x64() -> None:
    """Raise a ValueError unless JAX computes in float64, which all of prefmpc relies on."""
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise ValueError(
            "prefmpc computes in float64, but JAX has x64 switched off: call "
            'jax.config.update("jax_enable_x64", True) before any other use of JAX'
        )


def is_traced(value: Any) -> bool:
    """Whether ``value`` is a JAX tracer, whose entries cannot be looked at."""
    return isinstance(value, jax.core.Tracer)


def array_module(*arrays: Any) -> Any:
    """Return `numpy` if all ``arrays`` are NumPy's, else `jax.numpy`.

    Data stay in NumPy until a compiled program takes them: outside of one, JAX compiles every
    single operation for every shape, which takes longer than all that is then computed.
    """
    return np if all(isinstance(array, (np.ndarray, np.generic)) for array in arrays) else jnp


def to_numpy(tree: Any) -> Any:
    """Return a pytree with NumPy leaves (tracers stay), for the same reason."""
    return jax.tree.map(lambda leaf: leaf if is_traced(leaf) else np.asarray(leaf), tree)


def finite_array(name: str, value: Any, ndim: int | None = None, *, allow_inf: bool = False) -> Any:
    """Return ``value`` as a float64 array; raise a ValueError if it cannot be one or has NaN.

    ``ndim`` is the exact number of dimensions wanted (None: any). NumPy stays NumPy, JAX stays
    JAX. Tracers pass through: only their shape can be checked.
    """
    require_x64()
    if np.iscomplexobj(value):
        raise ValueError(f"{name} must be an array of real numbers, got complex ones")
    if isinstance(value, jax.Array):
        array: Any = value if value.dtype == jnp.float64 else value.astype(jnp.float64)
    else:
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be an array of real numbers: {error}") from None
    if ndim is not None and array.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), got shape {array.shape}")
    if not is_traced(array):
        entries = np.asarray(array)
        bad = np.isnan(entries) if allow_inf else ~np.isfinite(entries)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            wish = "must not contain NaN" if allow_inf else "must be finite"
            raise ValueError(
                f"{name} {wish}, got {int(bad.sum())} bad value(s), the first at index {where}"
            )
    return array


def instance(name: str, value: Any, wanted: type) -> None:
    """Raise a ValueError unless ``value`` is an instance of ``wanted``."""
    if not isinstance(value, wanted):
        raise ValueError(f"{name} must be a {wanted.__name__}, got {type(value).__name__}")


def function(name: str, value: Any) -> None:
    """Raise a ValueError unless ``value`` can be called."""
    if not callable(value):
        raise ValueError(f"{name} must be a function, got {value!r}")


def shaped(name: str, array: Any, shape: tuple[int | None, ...], meaning: str = "") -> Any:
    """Check the trailing dimensions of ``array`` against ``shape`` (None: any size)."""
    got = array.shape[-len(shape) :] if shape else ()
    fits = array.ndim >= len(shape) and all(
        w is None or w == g for w, g in zip(shape, got, strict=True)
    )
    if not fits:
        wish = "(..., " + ", ".join("any" if w is None else str(w) for w in shape) + ")"
        note = f" ({meaning})" if meaning else ""
        raise ValueError(f"{name} must have shape {wish}{note}, got {array.shape}")
    return array


def positive_int(name: str, value: Any) -> int:
    """Return ``value`` as an int of at least 1, or raise a ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
    return int(value)


def nonnegative(name: str, value: Any) -> float:
    """Return ``value`` as a finite float of at least 0, or raise a ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f"{name} must be a number of at least 0, got {value!r}")
    if not np.isfinite(value) or value < 0:
        raise ValueError(f"{name} must be finite and at least 0, got {value!r}")
    return float(value)


def sample_time(dt: Any) -> float:
    """Return ``dt`` as a float, or raise a ValueError unless it is positive and finite."""
    if not np.isfinite(dt) or dt <= 0:
        raise ValueError(f"dt must be a positive number of seconds, got {dt!r}")
    return float(dt)


def positive_vector(name: str, value: Any) -> np.ndarray:
    """Return ``value`` as an array (n,) of positive numbers, or raise a ValueError."""
    vector = np.asarray(finite_array(name, value, ndim=1))
    if vector.size == 0 or (vector <= 0).any():
        raise ValueError(f"{name} must hold positive numbers, got {vector}")
    return vector


def psd_matrix(name: str, value: ArrayLike, *, definite: bool = False) -> np.ndarray:
    """Return a (stack of) symmetric positive (semi)definite matrices, or raise a ValueError.

    Parameters
    ----------
    value : array (..., n, n)
    definite : demand strict positive definiteness.
    """
    matrix = np.asarray(finite_array(name, value))
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2] or matrix.shape[-1] == 0:
        raise ValueError(f"{name} must be a square matrix (..., n, n), got shape {matrix.shape}")
    transposed = np.swapaxes(matrix, -1, -2)
    scale = float(np.abs(matrix).max(initial=0.0))
    if np.abs(matrix - transposed).max(initial=0.0) > 1e-9 * max(scale, 1e-300):
        raise ValueError(f"{name} must be symmetric, got a matrix that differs from its transpose")
    matrix = (matrix + transposed) / 2
    smallest = float(np.linalg.eigvalsh(matrix).min(initial=np.inf))
    if definite and smallest <= 0:
        raise ValueError(
            f"{name} must be positive definite, got a smallest eigenvalue of {smallest:.3g}"
        )
    if smallest < -1e-10 * scale:
        raise ValueError(
            f"{name} must be positive semidefinite, got a smallest eigenvalue of {smallest:.3g}"
        )
    return matrix


def bounds_pair(
    names: tuple[str, str], lower: ArrayLike | None, upper: ArrayLike | None, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of shape (size,), ±inf where None; refuse crossed ones."""
    low = np.full(size, -np.inf) if lower is None else finite_array(names[0], lower, allow_inf=True)
    high = np.full(size, np.inf) if upper is None else finite_array(names[1], upper, allow_inf=True)
    out = []
    for name, bound in zip(names, (np.asarray(low), np.asarray(high)), strict=True):
        if bound.shape not in ((), (size,)):
            raise ValueError(f"{name} must be a number or have shape ({size},), got {bound.shape}")
        out.append(np.broadcast_to(bound, (size,)).copy())
    low, high = out
    crossed = np.flatnonzero(~(low < high))
    if crossed.size:
        i = int(crossed[0])
        raise ValueError(
            f"{names[0]} must lie below {names[1]}, got {low[i]:g} and {high[i]:g} at index {i}"
        )
    return low, high
