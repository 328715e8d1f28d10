"""One computation on several devices, which may belong to several processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

WHOLE = PartitionSpec()


def shares(mesh: Any, axis: int = 0) -> PartitionSpec:
    """Say that an array is shared along ``axis`` among all devices of the mesh."""
    return PartitionSpec(*[None] * axis, mesh.axis_names)


def check_mesh(mesh: Any) -> Mesh:
    """Return ``mesh``, or raise a ValueError that says what was expected."""
    if not isinstance(mesh, Mesh):
        raise ValueError(f"mesh must be a jax.sharding.Mesh, got {type(mesh).__name__}")
    return mesh


def padded(array: Any, axis: int, parts: int) -> np.ndarray:
    """Return the array with its last entry along ``axis`` repeated until ``parts`` divide it."""
    array = np.asarray(array)
    missing = -array.shape[axis] % parts
    last = np.take(array, [-1], axis=axis)
    return np.concatenate([array, *[last] * missing], axis=axis)


def on_mesh(
    function: Callable[..., Any],
    mesh: Mesh,
    specs: Sequence[PartitionSpec],
    out: PartitionSpec,
    arguments: Sequence[Any],
) -> Any:
    """Run ``function`` on every device, each with its share of the arguments; NumPy comes back.

    Every process passes the same arguments and gets the whole result. ``function`` has to be the
    same object in every call, or it is compiled again.
    """
    placed = [
        jax.tree.map(lambda leaf, s=spec: jax.device_put(leaf, NamedSharding(mesh, s)), argument)
        for spec, argument in zip(specs, arguments, strict=True)
    ]
    result = _compiled(function, mesh, tuple(specs), out)(*placed)
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import process_allgather

        result = process_allgather(result, tiled=True)
    return jax.tree.map(np.asarray, result)


@lru_cache(maxsize=64)
def _compiled(
    function: Callable[..., Any],
    mesh: Mesh,
    specs: tuple[PartitionSpec, ...],
    out: PartitionSpec,
) -> Callable[..., Any]:
    return jax.jit(
        jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)
    )
