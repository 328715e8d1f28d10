"""Validation of what users pass in. Every message names the argument, the wish and the gift."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

LARGEST_INT = 2**31 - 1
"""Of whole numbers: compiled loops count with 32 bits."""

IN_JAX = (
    ". Write it in jax.numpy: jnp.sin for np.sin or math.sin, jnp.stack for np.array, "
    "jnp.where for if, x.at[i].set(...) for x[i] = ..."
)


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


def real_array(name: str, value: Any, *, booleans: bool = False) -> Any:
    """Return ``value`` as a float64 array, or raise a ValueError if it is not made of real numbers.

    NumPy alone would read "1" and b"1" as numbers, forget masks and take None for NaN.
    ``booleans``: take True for 1 and False for 0. NumPy stays NumPy, JAX stays JAX.
    """
    kinds = "fiub" if booleans else "fiu"
    if isinstance(value, jax.Array):
        plain = not jnp.issubdtype(value.dtype, jax.dtypes.extended)
        if not plain or np.dtype(value.dtype).kind not in kinds + "V":  # V: bfloat16 and the like
            raise ValueError(f"{name} must be an array of real numbers, got {value.dtype}")
        return value if value.dtype == jnp.float64 else value.astype(jnp.float64)
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    parts = value if isinstance(value, (list, tuple)) else (value,)
    if any(isinstance(part, np.ma.MaskedArray) and np.ma.is_masked(part) for part in parts):
        raise ValueError(f"{name} must have all its entries, got a masked array that lacks some")
    try:
        array = np.asarray(value)
        good = array.dtype.kind in kinds
        if array.dtype.kind == "O" and array.size:  # whole numbers beyond 64 bits, fractions, …
            entries = [getattr(entry, "item", lambda e=entry: e)() for entry in array.ravel()]
            good = all(
                isinstance(e, (Real, Decimal)) and (booleans or not isinstance(e, bool))
                for e in entries
            )
        if good:
            return array.astype(np.float64, copy=False)
    except Exception as error:  # whatever the object's own conversion raises
        raise ValueError(f"{name} must be an array of real numbers: {error}") from None
    got = type(value).__name__ if array.ndim == 0 else f"an array of {array.dtype}"
    raise ValueError(f"{name} must be an array of real numbers, got {got}")


def finite_array(
    name: str,
    value: Any,
    ndim: int | None = None,
    *,
    allow_inf: bool = False,
    booleans: bool = False,
) -> Any:
    """Return ``value`` as a float64 array; raise a ValueError if it cannot be one or has NaN.

    ``ndim`` is the exact number of dimensions wanted (None: any). For ``booleans`` and the kind
    of array see `real_array`. Tracers pass through: only their shape can be checked.
    """
    require_x64()
    array = real_array(name, value, booleans=booleans)
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


def single(name: str, value: Any, advice: str = "") -> None:
    """Raise a ValueError if ``value`` is a stack of many."""
    if shape := getattr(value, "batch_shape", ()):
        raise ValueError(f"{name} must be a single model, got a stack {shape}{advice}")


def function(name: str, value: Any, arguments: int) -> None:
    """Raise a ValueError unless ``value`` can be called with so many arguments."""
    if not callable(value) or isinstance(value, type):
        raise ValueError(f"{name} must be a function, got {value!r}")
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):  # some built-in functions have none
        return
    try:
        signature.bind(*[None] * arguments)
    except TypeError as error:
        raise ValueError(
            f"{name} must be a function of {arguments} argument(s), got {value!r}: {error}"
        ) from None


@contextlib.contextmanager
def traced(name: str, kinds: type[Exception] = jax.errors.JAXTypeError) -> Iterator[None]:
    """Turn what a user's function raises when JAX traces it into a ValueError that names it.

    By default that alone which comes of tracing: NumPy or ``if`` in the place of `jax.numpy`.
    """
    try:
        yield
    except kinds as error:
        causes = error, error.__cause__, error.__context__
        untraceable = any(isinstance(cause, jax.errors.JAXTypeError) for cause in causes)
        said = str(error).partition("\n")[0].rstrip(".") + (IN_JAX if untraceable else "")
        raise ValueError(f"{name} must work on JAX arrays, but raised: {said}") from error


def choice(name: str, value: Any, options: Sequence[Any]) -> None:
    """Raise a ValueError unless ``value`` is one of the ``options``: texts, or None."""
    if not (value is None or isinstance(value, str)) or value not in options:
        quoted = ["None" if option is None else f'"{option}"' for option in options]
        wish = " or ".join(quoted) if len(options) == 2 else f"one of {tuple(options)}"
        raise ValueError(f"{name} must be {wish}, got {value!r}")


def flag(name: str, value: Any) -> bool:
    """Return ``value`` as a bool, or raise a ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def sequence(name: str, value: Any, wanted: str = "a sequence") -> list[Any]:
    """Return the entries of a list, tuple, array or any other iterable that is no text."""
    if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, Iterable):
        raise ValueError(f"{name} must be {wanted}, got {type(value).__name__}")
    try:
        return list(value)
    except TypeError as error:  # an array without dimensions
        raise ValueError(f"{name} must be {wanted}: {error}") from None


def instances(name: str, value: Any, wanted: type) -> list[Any]:
    """Return a sequence of at least one ``wanted`` as a list, or raise a ValueError."""
    wish = f"a sequence of at least one {wanted.__name__}"
    entries = sequence(name, value, wish)
    if not entries:
        raise ValueError(f"{name} must be {wish}, got none")
    for entry in entries:
        instance(name, entry, wanted)
    return entries


def leading_shape(name: str, value: Any) -> tuple[int, ...]:
    """Return ``value`` as a tuple of whole numbers of at least 1, or raise a ValueError."""
    if not isinstance(value, tuple):
        raise ValueError(f"{name} must be a tuple of whole numbers, got {value!r}")
    return tuple(positive_int(f"{name}[{i}]", size) for i, size in enumerate(value))


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


def broadcasts(name: str, batch: tuple[int, ...], models: tuple[int, ...]) -> None:
    """Raise a ValueError unless a leading shape fits that of a stack of models."""
    pairs = zip(models[::-1], batch[::-1], strict=False)
    if not all(a == b or 1 in (a, b) for a, b in pairs):
        raise ValueError(f"{name} must have a leading shape that fits {models}, got {batch}")


def indices(name: str, value: Any) -> np.ndarray:
    """Return ``value`` as an array of whole numbers or of booleans, or raise a ValueError."""
    real_array(name, value, booleans=True)
    index = np.asarray(value)
    if index.dtype == object:  # of Python's own numbers
        index = np.array(index.tolist())
    if index.dtype.kind not in "iub" and index.size:
        raise ValueError(f"{name} must hold whole numbers, got {index.dtype} {index.shape}")
    return index if index.dtype == bool else index.astype(int)


def is_whole(value: Any) -> bool:
    """Whether ``value`` is a whole number: no bool, and no span of time, which NumPy counts in."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))


def positive_int(name: str, value: Any) -> int:
    """Return ``value`` as an int of at least 1, or raise a ValueError."""
    if not is_whole(value) or value < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
    if value > LARGEST_INT:
        raise ValueError(f"{name} must be at most {LARGEST_INT}, got {value}")
    return int(value)


def number(
    name: str,
    value: Any,
    kind: str = "a number",
    holds: Callable[[float], bool] = lambda _: True,
    wish: str | None = None,
) -> float:
    """Return ``value`` as a float for which ``holds``, or raise a ValueError.

    The message names the ``kind`` of a value that is no number, and the ``wish`` (default: to be
    of that kind) for a number that does not hold.
    """
    out = None
    if not is_traced(value):
        with contextlib.suppress(ValueError):
            out = float(real_array(name, value).reshape(()))
    if out is None or not holds(out):
        wanted = wish if wish is not None and out is not None else f"be {kind}"
        raise ValueError(f"{name} must {wanted}, got {value!r}")
    return out


def nonnegative(name: str, value: Any, *, allow_inf: bool = False) -> float:
    """Return ``value`` as a float of at least 0, or raise a ValueError."""
    return number(
        name,
        value,
        "a number of at least 0",
        lambda v: v >= 0 and (allow_inf or v < np.inf),
        "be at least 0" if allow_inf else "be finite and at least 0",
    )


def positive(name: str, value: Any, *, allow_inf: bool = False) -> float:
    """Return ``value`` as a float above 0, or raise a ValueError."""
    out = number(name, value, "a positive number", lambda v: not v <= 0, "be positive")
    if not (out < np.inf or (allow_inf and out == np.inf)):
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return out


def share(name: str, value: Any) -> float:
    """Return ``value`` as a float between 0 and 1, both excluded, or raise a ValueError."""
    return number(name, value, holds=lambda v: 0 < v < 1, wish="lie in (0, 1)")


def sample_time(dt: Any) -> float:
    """Return ``dt`` as a float, or raise a ValueError unless it is positive and finite."""
    return number("dt", dt, "a positive number of seconds", lambda v: 0 < v < np.inf)


def positive_vector(name: str, value: Any) -> np.ndarray:
    """Return ``value`` as an array (n,) of positive numbers, or raise a ValueError."""
    vector = np.asarray(finite_array(name, value, ndim=1))
    if vector.size == 0 or (vector <= 0).any():
        raise ValueError(f"{name} must hold positive numbers, got {vector}")
    return vector


def bounds_pair(
    names: tuple[str, str], lower: ArrayLike | None, upper: ArrayLike | None, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of shape (size,), ±inf where None; refuse crossed ones.

    Equal bounds hold a signal where it is.
    """
    bounds = []
    for name, bound, none in zip(names, (lower, upper), (-np.inf, np.inf), strict=True):
        given = none if bound is None else bound
        array = np.asarray(finite_array(name, given, allow_inf=True))
        if array.shape not in ((), (size,)):
            raise ValueError(f"{name} must be a number or have shape ({size},), got {array.shape}")
        bounds.append(np.broadcast_to(array, (size,)).copy())
    low, high = bounds
    if (low == np.inf).any() or (high == -np.inf).any():
        raise ValueError(
            f"{names[0]} must be below infinity and {names[1]} above minus infinity, "
            f"got {low} and {high}"
        )
    if (low > high).any():
        i = int(np.argmax(low > high))
        raise ValueError(
            f"{names[0]} must lie below {names[1]} or at it, "
            f"got {low[i]:g} and {high[i]:g} at index {i}"
        )
    return low, high
