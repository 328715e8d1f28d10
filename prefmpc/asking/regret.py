"""How much worse the present controller may be than the best one, and whether that is enough."""

from __future__ import annotations

import dataclasses

import numpy as np

from prefmpc._checks import nonnegative, share
from prefmpc.asking.loops import STATES
from prefmpc.asking.options import Options
from prefmpc.asking.questions import Question

MARGIN = 1.645
"""A bound leaves room for so many standard errors of the share of samples below it (95 %)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Regret:
    """The regret of a controller over the posterior of what the person wants.

    Attributes
    ----------
    values : array (S,)
        For each sample of the posterior: its own cost σ of the controller's closed loops over
        that of the controller that knows the sample, minus 1; 0 where this one does better.
    """

    values: np.ndarray

    @property
    def mean(self) -> float:
        """The expected regret."""
        return float(self.values.mean())

    def quantile(self, q: float = 0.9) -> float:
        """Return the quantile q of the values."""
        return float(np.quantile(self.values, share("q", q)))

    def bound(self, q: float = 0.9) -> float:
        """Return what the regret is at most with probability q.

        It is a higher quantile of the values, by `MARGIN` standard errors of a share q among so
        many samples: somebody who asks after each answer whether it is enough would otherwise
        stop when the samples happen to look good.
        """
        error = np.sqrt(share("q", q) * (1 - q) / len(self.values))
        return float(np.quantile(self.values, min(q + MARGIN * error, 1.0)))

    def stop(self, level: float = 0.02, q: float = 0.9) -> bool:
        """Return whether the `bound` is at most ``level``."""
        return self.bound(q) <= nonnegative("level", level)

    def __str__(self) -> str:
        median, bound = 100 * self.quantile(0.5), 100 * self.bound()
        return f"{median:.2g} % (median), at most {bound:.2g} % with probability 0.9"


@dataclasses.dataclass(frozen=True)
class Consistency:
    """What repeated questions say of the person, whatever the model.

    Attributes
    ----------
    repeats : int
        Questions that were answered twice, the second time with the sides swapped.
    equal : float
        Share of them with the same answer; NaN if there are none. No model of σ can be right
        more often than such a person agrees with himself.
    first : float
        Share of the answers for the first side, halves included: sides are shuffled, so that
        more or less than a half is a habit of looking. NaN before the first answer.
    """

    repeats: int
    equal: float
    first: float


def regret_of(present: np.ndarray, samples: np.ndarray, options: Options) -> Regret:
    """Return the regret of the controller of weights w (p,) over samples (S, p) of the posterior.

    The x(0) are a function of the key alone, and the same for all.
    """
    features = options.features
    x0 = options.starts(STATES, options.rng(0, 2))
    runs = options.loops(features.model(np.concatenate([present[None], samples])), x0)
    phi = np.asarray(features(runs))  # (1 + S, m, p)
    reached = np.isfinite(phi[0]).all(axis=-1)
    if not reached.any():
        raise ValueError("x0 must hold a state from which the present controller reaches the end")
    costs = samples @ phi[:, reached].mean(axis=1).T  # (S, 1 + S)
    own = costs[:, 1:].diagonal()
    # Of a sample whose own loops failed the best of the others is what is known.
    best = np.where(np.isfinite(own), own, np.nanmin(costs, axis=1))
    return Regret(np.maximum(costs[:, 0] / best - 1, 0))


def consistency_of(questions: list[Question], labels: np.ndarray) -> Consistency:
    """Return what the repeated questions say; labels (n,) with NaN for skipped ones."""
    pairs = [(labels[i], 1 - labels[q.repeats]) for i, q in enumerate(questions) if q.repeated]
    pairs = [pair for pair in pairs if not np.isnan(pair).any()]
    known = labels[~np.isnan(labels)]
    return Consistency(
        repeats=len(pairs),
        equal=float(np.mean([1 - abs(a - b) for a, b in pairs])) if pairs else np.nan,
        first=float(known.mean()) if known.size else np.nan,
    )
