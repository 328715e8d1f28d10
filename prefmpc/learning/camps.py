"""Whether one σ serves everybody: a mixture of few, the number of them chosen by the evidence."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from scipy.special import gammaln, logsumexp, softmax

from prefmpc._checks import nonnegative, number, positive_int
from prefmpc._random import generator
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._answers import Answers, answers_of, costs
from prefmpc.learning._people import Form, Mode, minimise
from prefmpc.learning.people import form_of
from prefmpc.learning.priors import WishartPrior
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.comparisons import Comparisons

ROUNDS = 60
"""At most so many of expectation and maximisation from each start."""

STEPS = 10
"""Newton steps of a round at most: the next one starts where it ended."""

SETTLED = 1e-3
"""A search has ended when no probability of belonging to a camp moves further in a round."""


@dataclasses.dataclass(frozen=True, eq=False)
class Camps(Result):
    """Groups of people who want different things, as far as their answers tell.

    Attributes
    ----------
    names : array (m,)
        Of the people, sorted.
    camp : int array (m,)
        To which each most probably belongs, 0 … count − 1; the largest camp is 0.
    probability : array (m, count)
        Of belonging to each.
    Q, R : array (count, nx, nx), (count, nu, nu)
        What each camp wants.
    log_evidence : array (tried,)
        log P(answers) with 1, 2, … camps, in nats, by Laplace's method.
    status : "converged" or "max_iterations"
        "converged": where the best start with the chosen number ended, no probability moved any
        more, and decrement and curvature certify each camp's σ as a (local) maximum. Other starts
        may find a better one.
    moved : float
        How far a probability moved in the last round.
    rounds : int
    """

    NAME = "find_camps"

    names: np.ndarray
    camp: np.ndarray
    probability: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    log_evidence: np.ndarray
    status: Literal["converged", "max_iterations"]
    moved: float
    rounds: int

    @property
    def count(self) -> int:
        """How many camps there are."""
        return len(self.Q)

    @property
    def models(self) -> QuadraticCost:
        """What each camp wants: a stack (count,)."""
        self.check()
        return QuadraticCost(self.Q, self.R)

    def members(self, camp: int) -> np.ndarray:
        """Return the names of those who most probably belong to a camp."""
        return self.names[self.camp == camp]

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        sizes = ", ".join(str(np.sum(self.camp == k)) for k in range(self.count))
        return (
            f"{self.status} after {self.rounds} rounds, which moved probabilities by "
            f"{self.moved:.1e}; camps of {sizes}"
        )


class _Mixture(NamedTuple):
    modes: list[Mode]
    probability: Any
    log_evidence: float
    moved: float
    rounds: int

    @property
    def certified(self) -> bool:
        return self.moved <= SETTLED and all(mode.certified for mode in self.modes)


def find_camps(
    comparisons: Comparisons,
    prior: WishartPrior,
    *,
    most: int = 3,
    odds: float = 20.0,
    starts: int = 5,
    key: Any = 0,
    apart: float = 0.0,
    spread: float = 2.0,
    sharpness: float = 2.0,
    sharper: float = 1.0,
    lapse: float | Literal["estimate"] = "estimate",
    weights: ArrayLike | None = None,
) -> Camps:
    """Divide people into camps, each with one σ, if their answers speak for more than one.

    A mixture: each person belongs to one of K camps and has a sharpness and a lapse rate of their
    own, as in `fit_raters`. Expectation and maximisation from several starts, each of them at
    what K people want who were drawn at random. K grows as long as one more camp makes the
    answers ``odds`` times as probable. Warns where there is more than one camp: one σ for all
    would be a compromise that perhaps nobody wants.

    Parameters
    ----------
    comparisons : Comparisons
        With ``who``.
    most : int
        At most so many camps.
    odds : float
        At least 1: how much more probable answers must be to believe in one more camp.
    starts : int
    key : JAX random key or int
        Of the starts.
    apart : float
        Standard deviation of the ratios of log weights within a camp. 0: all want the same, and
        enough answers of people who differ a little will divide them.
    prior, spread, sharpness, sharper, lapse, weights
        As in `fit_raters`.

    Returns
    -------
    Camps

    Raises
    ------
    ValueError
        If an argument is out of range, or ``comparisons`` does not say who answered.
    """
    answers = answers_of(comparisons, prior, weights)
    apart = nonnegative("apart", apart)
    form = form_of(answers, spread, sharpness, apart, sharper, lapse)
    most, starts = positive_int("most", most), positive_int("starts", starts)
    odds = number("odds", odds, holds=lambda v: 1 <= v < np.inf, wish="be at least 1 and finite")
    rng = generator(key)
    found: list[_Mixture] = []
    for count in range(1, min(most, len(answers.start)) + 1):
        tries = [_search(answers, form, count, rng) for _ in range(starts if count > 1 else 1)]
        found.append(max(tries, key=lambda t: (t.certified, t.log_evidence)))
        if count > 1 and found[-1].log_evidence - found[-2].log_evidence <= np.log(odds):
            break
    evidence = np.array([mixture.log_evidence for mixture in found])
    chosen = int(np.sum(np.diff(evidence) > np.log(odds)))
    out = _result(answers, form, found[chosen], evidence)
    warn_of_failure(out)
    if out.count > 1:
        camps = " and ".join(str(out.members(k).tolist()) for k in range(out.count))
        gain = evidence[chosen] - evidence[0]
        warnings.warn(
            f"find_camps: one σ for all would hide {out.count} camps, {camps} "
            f"(log-evidence +{gain:.1f} nats)",
            UserWarning,
            stacklevel=2,
        )
    return out


def _search(answers: Answers, form: Form, count: int, rng: np.random.Generator) -> _Mixture:
    """Return where expectation and maximisation end from one random start."""
    m = len(answers.start)
    shares = np.full(count, 1 / count)
    seeds = rng.permutation(m)[:count]
    modes: list[Any] = [None] * count
    probability = np.ones((m, 1))
    if count > 1:
        us = [minimise(answers.of_person([seed]), form).u for seed in seeds]
        own = np.stack([_given(answers, form, u).own_evidence for u in us], axis=1)
        probability = softmax(own + np.log(shares), axis=1)
    moved, rounds = np.inf, 0
    while True:
        rounds += 1
        for k, mode in enumerate(modes):
            start = None if mode is None else (mode.u, mode.x)
            limit = 100 if mode is None else STEPS
            modes[k] = minimise(answers, form, start=start, counts=probability[:, k], limit=limit)
        if count == 1:
            return _Mixture(modes, probability, modes[0].log_evidence, 0.0, rounds)
        alone = [_given(answers, form, mode.u, mode.x) for mode in modes]
        modes = [mode._replace(x=each.x) for mode, each in zip(modes, alone, strict=True)]
        own = np.stack([each.own_evidence for each in alone], axis=1)
        shares = (probability.sum(axis=0) + 1) / (m + count)
        new = softmax(own + np.log(shares), axis=1)
        moved = float(np.abs(new - probability).max())
        probability = new
        if not moved > SETTLED or rounds == ROUNDS:
            break
    likelihood = logsumexp(own + np.log(shares), axis=1).sum()
    of_camps = sum(-0.5 * m.u @ m.u - 0.5 * np.linalg.slogdet(m.outer)[1] for m in modes)
    # Shares: uniform beforehand, each free one costs as much as in BIC. The camps have no order:
    # every division is count! modes of the posterior.
    of_shares = gammaln(count) - 0.5 * (count - 1) * np.log(m) + gammaln(count + 1)
    return _Mixture(modes, probability, float(likelihood + of_camps + of_shares), moved, rounds)


def _given(answers: Answers, form: Form, u: np.ndarray, x: np.ndarray | None = None) -> Mode:
    """Return everybody's mode and evidence where u is known."""
    known = Form(form.centre + form.shared @ u, np.zeros((len(form.centre), 0)), form.own)
    return minimise(answers, known, start=None if x is None else (np.zeros(0), x))


def _result(answers: Answers, form: Form, mixture: _Mixture, evidence: np.ndarray) -> Camps:
    order = np.argsort(-mixture.probability.sum(axis=0), kind="stable")
    probability = mixture.probability[:, order]
    centres = np.stack([form.centre + form.shared @ mixture.modes[k].u for k in order])
    Q, R = costs(answers, centres[:, :-1])
    return Camps(
        names=answers.names,
        camp=np.argmax(probability, axis=1),
        probability=probability,
        Q=Q,
        R=R,
        log_evidence=evidence,
        status="converged" if mixture.certified else "max_iterations",
        moved=mixture.moved,
        rounds=mixture.rounds,
    )
