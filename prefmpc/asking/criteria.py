"""What makes a question worth asking: a criterion scores the candidates, larger is better."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from prefmpc.asking.questions import Candidates, information

Criterion = Callable[[Candidates], Any]


def information_gain(candidates: Candidates) -> np.ndarray:
    """H(mean P) − mean H(P): the model unsure, the person sure (Bıyık et al., 2019)."""
    return information(candidates.P)


def volume_removed(candidates: Candidates) -> np.ndarray:
    """The share of the posterior that the less welcome answer removes (Sadigh et al., 2017)."""
    mean = candidates.P.mean(axis=0)
    return np.minimum(mean, 1 - mean)


def eubo(candidates: Candidates) -> np.ndarray:
    """The expected utility of the better one, −E min(σ_first, σ_second) (Lin et al., 2022).

    Relative to the best from the same x(0): a start near the goal is no merit of a controller.
    """
    costs = candidates.costs
    least = np.full((len(costs), candidates.start.max() + 1), np.inf)
    np.minimum.at(least.T, candidates.start, costs.T)
    relative = costs / least[:, candidates.start]
    return -np.minimum(relative[:, candidates.first], relative[:, candidates.second]).mean(axis=0)


def regret_removed(candidates: Candidates) -> np.ndarray:
    """By how much an answer is expected to lower the regret of the best controller shown.

    With r_cs the regret of controller c for the posterior's sample s, now
    min_c mean_s r_cs is expected; afterwards E_answer min_c E[r_cs given the answer].
    """
    source, costs, P = candidates.source, candidates.costs, candidates.P
    if (source < 0).any():
        raise ValueError('choose must not be "regret" for a pool of recordings: they are no loops')
    member = (source == np.arange(source.max() + 1)[:, None]).astype(float)
    mean = costs @ (member / member.sum(axis=1, keepdims=True)).T  # (S, C)
    r = mean / mean.min(axis=1, keepdims=True) - 1
    now = r.mean(axis=0).min()
    after = sum((p.T @ r).min(axis=1) / len(P) for p in (P, 1 - P))
    return np.asarray(now - after)


def at_random(candidates: Candidates) -> np.ndarray:
    """A number out of a hat."""
    return candidates.rng.uniform(size=len(candidates.first))


CRITERIA: dict[str, Criterion] = {
    "information": information_gain,
    "regret": regret_removed,
    "volume": volume_removed,
    "eubo": eubo,
    "random": at_random,
}
