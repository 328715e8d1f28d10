"""What training from many starts has in common: the starts, and Adam within the bounds."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from prefmpc.models.quadratic import CostModel, QuadraticCost, check_model
from prefmpc.preferences.answers import Answers
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.recordings import batches


def check_starts(comparisons: Comparisons | Answers, initial: Any) -> CostModel:
    """Return the starts, stacked along one leading axis, or raise a ValueError."""
    if isinstance(initial, QuadraticCost) and not initial.batch_shape:
        initial = jax.tree.map(lambda leaf: leaf[None], initial)
    check_model("initial", initial, "a stack of σ models")
    # The weights of a single network may all have the same first dimension.
    if any(getattr(m, "batch_shape", None) == () for m in getattr(initial, "models", (initial,))):
        raise ValueError("initial must be stacked along one leading axis, got a single model")
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(initial)}
    if len(sizes) != 1 or not all(sizes):
        raise ValueError(f"initial must be stacked along one leading axis, got {sorted(sizes)}")
    one = jax.tree.map(lambda leaf: leaf[0], initial)
    try:
        for part in batches(comparisons.trajectories):
            one(part)
    except ValueError as error:
        raise ValueError(f"initial must fit the comparisons: {error}") from None
    return initial


def held_out_count(n: int, fraction: float) -> int:
    """Return how many of n pairs are kept out of training: at least one; 0 if that leaves none."""
    count = max(1, round(fraction * n))
    return count if count < n else 0


def finite_models(models: Any) -> np.ndarray:
    """Say which models of a stack (m,) have finite weights only, (m,)."""
    leaves = jax.tree.leaves(models)
    return np.all([np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) for leaf in leaves], axis=0)


def _adam(learning_rate: Any) -> Any:
    return optax.adam(learning_rate, b1=0.9, b2=0.999)


def begin_adam(start: Any, bounds: tuple[Any, Any]) -> tuple[Any, Any]:
    """Return the start within the bounds, and Adam's memory."""
    inside = jax.tree.map(jnp.clip, start, *bounds)
    return inside, _adam(0.0).init(inside)


def adam_step(
    model: Any, memory: Any, slope: Any, bounds: tuple[Any, Any], learning_rate: Any
) -> tuple[Any, Any]:
    """Take one step of Adam, projected onto the bounds; return the model and Adam's memory."""
    updates, memory = _adam(learning_rate).update(slope, memory)
    return jax.tree.map(jnp.clip, optax.apply_updates(model, updates), *bounds), memory


def projected_adam(
    loss: Any, start: Any, bounds: tuple[Any, Any], steps: int, learning_rate: Any
) -> Any:
    """Return the model after so many steps of Adam."""

    def step(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        return adam_step(*carry, jax.grad(loss)(carry[0]), bounds, learning_rate), None

    carry = begin_adam(start, bounds)
    (model, _), _ = jax.lax.scan(step, carry, None, length=steps)
    return model
