"""Frozen dataclasses that are also JAX pytrees.

``jax.tree_util.register_dataclass`` rebuilds an object by calling its class, so that any check
in the constructor would run on tracers, on placeholders and on gradients, and fail there. The
registration below rebuilds without the constructor: user input is validated exactly once, where
it enters, and ``jit``, ``vmap``, ``grad`` and ``tree.map`` work on the same class.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Self, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def bypass_init(cls: type[T], **fields: Any) -> T:
    """Build an instance of the frozen dataclass ``cls`` without validation."""
    instance = object.__new__(cls)
    set_fields(instance, **fields)
    return instance


def stacked(trees: Sequence[T]) -> T:
    """Return trees of arrays that are alike as one, with a leading dimension."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def set_fields(instance: Any, **fields: Any) -> None:
    """Set the fields of a frozen dataclass, in its own constructor."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)


def register_pytree(cls: type[T], static: tuple[str, ...] = ()) -> type[T]:
    """Register the dataclass ``cls`` as a pytree; the fields in ``static`` are not leaves."""
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    leaves = [name for name in names if name not in static]
    keys = [jax.tree_util.GetAttrKey(name) for name in leaves]

    def flatten(instance: T) -> tuple[list[Any], tuple[Any, ...]]:
        metadata = tuple([getattr(instance, name) for name in static])
        return [getattr(instance, name) for name in leaves], metadata

    def flatten_with_keys(instance: T) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children, metadata = flatten(instance)
        return list(zip(keys, children, strict=True)), metadata

    def unflatten(metadata: tuple[Any, ...], children: Any) -> T:
        fields = dict(zip(leaves, children, strict=True))
        fields.update(zip(static, metadata, strict=True))
        return bypass_init(cls, **fields)

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def constant_like(tree: T, value: float) -> T:
    """Return the same tree with ``value`` for every number, for instance as a bound."""
    return jax.tree.map(lambda leaf: np.full(leaf.shape, value), tree)


class Stack:
    """A pytree that may be a stack of many: then all leaves have leading dimensions in common."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack; () for a single one."""
        raise NotImplementedError

    def __getitem__(self, index: Any) -> Self:
        """Index the leading dimensions of a stack."""
        if not self.batch_shape:
            raise IndexError(f"a single {type(self).__name__} has no batch dimension to index")
        size = self.batch_shape[0]
        # JAX would clamp such an index, and a ``for`` loop over a stack would never end.
        if isinstance(index, int) and not -size <= index < size:
            raise IndexError(f"index must lie in [{-size}, {size - 1}], got {index}")
        return jax.tree.map(lambda leaf: leaf[index], self)
