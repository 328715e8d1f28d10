"""Random numbers from an explicit key, drawn by NumPy.

Data are made once and in many shapes; JAX would compile a program for each of them, which takes
longer than everything that is then done with the numbers.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._checks import is_whole


def generator(key: Any) -> np.random.Generator:
    """Return a generator that is a function of ``key`` alone: same key, same numbers.

    ``key`` is a JAX random key, a whole number, or a `numpy.random.Generator`, which is handed
    back (and moves on as numbers are drawn from it). Anything else raises a ValueError.
    """
    if isinstance(key, np.random.Generator):
        return key
    if is_whole(key) and key >= 0:
        return np.random.default_rng(key)
    if isinstance(key, jax.Array) and not isinstance(key, jax.core.Tracer):
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        words = np.asarray(jax.random.key_data(key) if typed else key)
        if words.dtype == np.uint32 and words.ndim == 1:
            return np.random.default_rng(words.tolist())
    got = key if is_whole(key) else f"{type(key).__name__}{getattr(key, 'shape', '')}"
    raise ValueError(
        "key must be a single JAX random key, for instance jax.random.key(0), or a whole number "
        f"of at least 0, got {got}"
    )
