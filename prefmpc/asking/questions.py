"""Questions: pairs of trajectories, the candidates for the next one, and batches of them."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.special import entr, expit

from prefmpc.preferences.trajectories import Trajectory

PATTERNS = 64
"""At most so many answers to the earlier questions of a batch are told apart."""


@dataclasses.dataclass(frozen=True, eq=False)
class Question:
    """Two trajectories, of which a person says which one is better.

    Attributes
    ----------
    first, second : Trajectory
        Single ones.
    gain : float
        How much an answer is expected to tell about the weights, in nats (ln 2 at most):
        H(mean P) − mean H(P) over the posterior, H the entropy of a yes or no.
    sure : float
        How sure the person is expected to be, in [0.5, 1]: the mean of max(P, 1 − P).
    probability : float
        What the model bets on: the mean of P(first is preferred).
    number : int
        How many questions were answered or skipped before, those of the same batch included.
    repeats : int or None
        The number of the question that is asked again here with its sides swapped.
    """

    first: Trajectory
    second: Trajectory
    gain: float
    sure: float
    probability: float
    number: int
    repeats: int | None = None

    @property
    def repeated(self) -> bool:
        """Whether the same was asked before."""
        return self.repeats is not None


class Candidates(NamedTuple):
    """Pairs to choose from, as the posterior sees them; a criterion gives each a score.

    S samples of the posterior, M trajectories, n pairs.
    """

    trajectories: Trajectory
    """Leading shape (M,)."""
    features: np.ndarray
    """(M, p)"""
    start: np.ndarray
    """(M,): trajectories with equal numbers start in the same x(0)."""
    source: np.ndarray
    """(M,): whose closed loop it is, of the C controllers; −1 for a recording."""
    first: np.ndarray
    second: np.ndarray
    """(n,): which trajectories make a pair."""
    costs: np.ndarray
    """(S, M): σ of each trajectory."""
    P: np.ndarray
    """(S, n): probability that the first is preferred."""
    rng: np.random.Generator


def pairs_of(start: np.ndarray, rng: np.random.Generator, most: int) -> np.ndarray:
    """Return pairs (2, n) of trajectories with the same x(0), at most so many; a random subset.

    Of trajectories that all start elsewhere: pairs of any.
    """
    one, other = np.triu_indices(len(start), 1)
    alike = start[one] == start[other]
    if alike.any():
        one, other = one[alike], other[alike]
    if len(one) > most:
        chosen = np.sort(rng.choice(len(one), most, replace=False))
        one, other = one[chosen], other[chosen]
    return np.stack([one, other])


def probability(z: np.ndarray, lapse: np.ndarray) -> np.ndarray:
    """Return P(first preferred) (S, n) from log-odds z (S, n) and lapse rates (S,)."""
    return lapse[:, None] / 2 + (1 - lapse[:, None]) * expit(z)


def entropy(P: np.ndarray) -> np.ndarray:
    """Return the entropy of a yes or no, in nats."""
    return entr(P) + entr(1 - P)


def information(P: np.ndarray) -> np.ndarray:
    """Return the information gain (n,) of answers with probabilities P (S, n), in nats."""
    return np.maximum(entropy(P.mean(axis=0)) - entropy(P).mean(axis=0), 0.0)


def informative_batch(P: np.ndarray, allowed: np.ndarray, size: int) -> list[int]:
    """Return ``size`` of n pairs, each with the largest gain given the answers to those before.

    The joint distribution of the answers is summed over all patterns of answers, or, if there
    are too many, over the most probable ones.

    Parameters
    ----------
    P : array (S, n)
    allowed : bool array (n,)
    """
    allowed, own = allowed.copy(), entropy(P).mean(axis=0)
    patterns, chosen = np.ones((1, len(P))), []
    for _ in range(min(size, int(allowed.sum()))):
        weight = patterns.mean(axis=1)
        mean = (patterns @ P) / (patterns.sum(axis=1, keepdims=True) + 1e-300)
        gain = np.where(allowed, weight @ entropy(np.clip(mean, 0, 1)) - own, -np.inf)
        best = int(np.argmax(gain))
        chosen.append(best)
        allowed[best] = False
        patterns = np.concatenate([patterns * P[:, best], patterns * (1 - P[:, best])])
        if len(patterns) > PATTERNS:
            patterns = patterns[np.argsort(-patterns.sum(axis=1), kind="stable")[:PATTERNS]]
            patterns = patterns / patterns.sum(axis=0).mean()
    return chosen
