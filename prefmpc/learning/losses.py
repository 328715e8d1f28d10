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

    def losses(self, model: Any) -> Any:
        """Return −log P (n,) of the answers, from log-odds: it neither overflows nor saturates."""
        return optax.sigmoid_binary_cross_entropy(logits(model, self), self.labels)

    def hits(self, model: Any) -> Any:
        """Return how much each answer says what the model does; equal costs count as "first"."""
        return jnp.where(logits(model, self) >= 0, self.labels, 1 - self.labels)

    def hold_out(self, index: np.ndarray) -> None:
        """Give answers weight 0."""
        self.weights[index] = 0.0

    def part(self, chosen: Any) -> PairData:
        """Return a mini-batch: only its own trajectories are scored.

        An index behind the last pair stands for none: a weight of 0, with some other pair's
        numbers.
        """
        labels = self.labels[chosen]
        weights = self.weights.at[chosen].get(mode="fill", fill_value=0.0)
        if self.sides is None:
            features = jax.tree.map(lambda leaf: leaf[chosen], self.features)
            return PairData(None, features, labels, weights)
        used = jnp.concatenate([side[chosen] for side in self.sides])
        features = jax.tree.map(lambda leaf: leaf[used], self.features)
        places = np.arange(2 * len(chosen)).reshape(2, -1)
        return PairData((places[0], places[1]), features, labels, weights)


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
        features = features_of(model, comparisons.trajectories)
        gap = jax.tree.map(lambda leaf: leaf[j] - leaf[i], features)
        return PairData(None, gap, labels, weights)
    used, sides = np.unique(np.stack([i, j]), return_inverse=True)
    if size > n:
        spare = padded_size(len(used), SMALLEST_POOL) - len(used)
        used = np.concatenate([used, np.full(spare, used[0])])
    first, second = sides.reshape(2, size)
    features = features_of(model, comparisons.trajectories[used])
    return PairData((first, second), features, labels, weights)


def features_of(model: Any, trajectories: Trajectory) -> Any:
    """Return the features of a batch as NumPy arrays, or raise a ValueError: they are infinite."""
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


def cross_entropy(model: Any, data: Any) -> Any:
    """Return the weighted mean of the losses, for pairs the sum of eq. (6) of arXiv 2511.22502."""
    return jnp.vdot(data.weights, data.losses(model)) / jnp.sum(data.weights)


def accuracy(model: Any, data: Any) -> Any:
    """Return the weighted share of the answers that the model gives."""
    return jnp.vdot(data.weights, data.hits(model)) / jnp.sum(data.weights)


def objective(model: Any, data: Any, l2: Any = 1e-6, l1: Any = 0.0) -> Any:
    """Return cross-entropy + l2·‖θ‖² + l1·‖θ‖₁: eq. (6) of arXiv 2511.22502, with ρ = ``l2``."""
    theta = jax.tree.leaves(model)
    ridge = sum(jnp.vdot(leaf, leaf) for leaf in theta)
    lasso = sum(jnp.sum(jnp.abs(leaf)) for leaf in theta)
    return cross_entropy(model, data) + l2 * ridge + l1 * lasso
