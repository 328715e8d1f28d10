"""The logistic loss of a σ model on compared pairs, ready for compiled programs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.trajectories import Trajectory

SMALLEST_SHAPE = 1024
"""Data sets are padded to this many pairs, or to the next power of two above it."""

SMALLEST_POOL = 128
"""The same for the number of trajectories, where σ is computed once for each of them."""


def padded_size(n: int, smallest: int = SMALLEST_SHAPE) -> int:
    """Return the shape that ``n`` pairs are padded to, so that few shapes need compiling."""
    return max(smallest, 1 << (n - 1).bit_length())


class PairData(NamedTuple):
    """Pairs ready for the loss: labels and weights with leading size n, and what σ needs.

    For a model that is linear in its features ``sides`` is None and ``features`` holds the
    difference, second minus first. For others ``features`` holds every trajectory once, so that σ
    is computed once for each, and ``sides`` says which two of them are compared.
    """

    sides: Any
    features: Any
    labels: Any
    weights: Any


def pair_data(model: Any, comparisons: Comparisons, size: int | None = None) -> PairData:
    """Compute the features of all pairs once, padded with pairs of weight 0 to ``size``."""
    n = len(comparisons)
    size = n if size is None else size
    padding = np.zeros(size - n, dtype=int)
    i = np.concatenate([comparisons.first, padding])
    j = np.concatenate([comparisons.second, padding])
    labels = np.concatenate([comparisons.labels, padding])
    weights = np.concatenate([np.ones(n), padding])
    if model.linear_in_features:
        features = _features(model, comparisons.trajectories)
        gap = jax.tree.map(lambda leaf: leaf[j] - leaf[i], features)
        return PairData(None, gap, labels, weights)
    used, sides = np.unique(np.stack([i, j]), return_inverse=True)
    if size > n:
        spare = padded_size(len(used), SMALLEST_POOL) - len(used)
        used = np.concatenate([used, np.full(spare, used[0])])
    first, second = sides.reshape(2, size)
    features = _features(model, comparisons.trajectories[used])
    return PairData((first, second), features, labels, weights)


def _features(model: Any, trajectories: Trajectory) -> Any:
    with np.errstate(over="ignore"):  # said in one sentence below
        features = jax.tree.map(np.asarray, model.features(trajectories))
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(features)):
        raise ValueError("trajectories must have finite features, got NaN or an overflow")
    return features


def logits(model: Any, data: PairData) -> Any:
    """Return σ(T_second) − σ(T_first) (n,): the log-odds that the first is preferred.

    Implements the exponent of eq. (4) of arXiv 2511.22502.
    """
    score = model.score(data.features)
    if data.sides is None:
        return score
    first, second = data.sides
    return score[second] - score[first]


def cross_entropy(model: Any, data: PairData) -> Any:
    """Return the weighted mean of the logistic loss, the sum of eq. (6) of arXiv 2511.22502.

    Computed from the log-odds, so that it neither overflows nor saturates.
    """
    losses = optax.sigmoid_binary_cross_entropy(logits(model, data), data.labels)
    return jnp.vdot(data.weights, losses) / jnp.sum(data.weights)


def objective(model: Any, data: PairData, l2: Any = 1e-6, l1: Any = 0.0) -> Any:
    """Return cross-entropy + l2·‖θ‖² + l1·‖θ‖₁: eq. (6) of arXiv 2511.22502, with ρ = ``l2``."""
    theta = jax.tree.leaves(model)
    ridge = sum(jnp.vdot(leaf, leaf) for leaf in theta)
    lasso = sum(jnp.sum(jnp.abs(leaf)) for leaf in theta)
    return cross_entropy(model, data) + l2 * ridge + l1 * lasso
