"""How far people agree with each other and with themselves, and whether what they want changes."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import betaincinv, expit

from prefmpc._checks import instance, positive, positive_int, share
from prefmpc._random import generator
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._answers import Answers, answers_of
from prefmpc.learning._people import Form, Mode, minimise
from prefmpc.learning.people import form_of
from prefmpc.learning.priors import WishartPrior
from prefmpc.preferences.comparisons import Comparisons


class Shared(NamedTuple):
    """How often two answers to one question are equal.

    Attributes
    ----------
    share : float
        NaN if no question was answered twice.
    lower, upper : float
    questions : int
        So many questions tell.
    ceiling, ceiling_lower, ceiling_upper : float
        No model, whatever it knows of the questions, agrees with more of the answers than that.
    """

    share: float
    lower: float
    upper: float
    questions: int
    ceiling: float
    ceiling_lower: float
    ceiling_upper: float


class Agreement(NamedTuple):
    """Equal answers to one question: of two people, and of one person who was asked twice."""

    between: Shared
    within: Shared


def agreement(comparisons: Comparisons, *, level: float = 0.9) -> Agreement:
    """Return how often people agree with each other, and with themselves.

    Two comparisons are one question if the same two trajectories were shown, on whichever sides.
    Two answers a and b, as P(first preferred), are equal with probability a·b + (1 − a)(1 − b).

    If a share A of answers is equal, no model agrees with more than (1 + √(2A − 1)) / 2 of them:
    with q the probability of an answer, A is the mean of q² + (1 − q)², that of a model's success
    at most the mean of max(q, 1 − q) (Jensen). Within: a model of each person; between: one σ
    for all.

    Parameters
    ----------
    comparisons : Comparisons
        Without ``who``, all answers are one person's.
    level : float
        Of the intervals, which are Jeffreys' with as many draws as there are questions: they are
        for other questions to the same people. Where all (or none) are equal, one bound is 1 (0).

    Returns
    -------
    Agreement
    """
    instance("comparisons", comparisons, Comparisons)
    level = share("level", level)
    question, labels = _questions(comparisons)
    who = comparisons.who
    person = np.zeros(len(labels), int) if who is None else np.unique(who, return_inverse=True)[1]
    # Sums over all pairs of two answers to one question: those of squares make pairs of one.
    both = question * (person.max() + 1) + person
    same = _equal_pairs(both, labels)
    all_ = _equal_pairs(question, labels)
    of_question = np.unique(both, return_index=True)[1]
    inside = np.zeros((2, question.max() + 1))
    for total, part in zip(inside, same, strict=True):
        np.add.at(total, question[of_question], part)
    return Agreement(_shared(all_ - inside, level), _shared(same, level))


def _questions(comparisons: Comparisons) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each one's question, and labels turned to one order of the sides."""
    T = comparisons.trajectories
    flat = np.concatenate([np.reshape(part, (len(T), -1)) for part in (T.x, T.u)], axis=1)
    shown = np.unique(flat, axis=0, return_inverse=True)[1].reshape(-1)
    first, second = shown[comparisons.first], shown[comparisons.second]
    turned = first > second
    pair = np.where(turned, second, first) * len(T) + np.where(turned, first, second)
    labels = np.where(turned, 1 - comparisons.labels, comparisons.labels)
    return np.unique(pair, return_inverse=True)[1], labels


def _equal_pairs(group: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return for each group how many of its pairs of answers are equal, and how many there are."""
    n, a, b = (np.bincount(np.unique(group, return_inverse=True)[1], w) for w in (
        np.ones_like(labels), labels, labels**2
    ))  # fmt: skip
    ones, zeros = (a**2 - b) / 2, ((n - a) ** 2 - (n - 2 * a + b)) / 2
    return np.stack([ones + zeros, n * (n - 1) / 2])


def _shared(pairs: np.ndarray, level: float) -> Shared:
    equal, count = pairs[:, pairs[1] > 0.5]
    n = count.size
    if not n:
        return Shared(np.nan, np.nan, np.nan, 0, np.nan, np.nan, np.nan)
    A = float(equal.sum() / count.sum())
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    lower, upper = betaincinv(n * A + 0.5, n * (1 - A) + 0.5, tails).tolist()
    lower, upper = (0.0 if A == 0 else lower), (1.0 if A == 1 else upper)
    ceilings = (0.5 + 0.5 * np.sqrt(np.maximum(2 * np.array([A, lower, upper]) - 1, 0))).tolist()
    return Shared(A, lower, upper, n, *ceilings)


def forgetting(n: int, half_life: float) -> np.ndarray:
    """Return weights (n,) of answers in the order of time: half after each ``half_life`` answers.

    The last one counts 1. For ``weights`` of `fit_map`, which stays convex, and of `fit_raters`
    and `fit_hierarchy`. To answers of several people apply it to each.

    Parameters
    ----------
    n : int
    half_life : float
        In answers.
    """
    n, half_life = positive_int("n", n), positive("half_life", half_life)
    return np.asarray(0.5 ** (np.arange(n - 1, -1, -1) / half_life))


@dataclasses.dataclass(frozen=True, eq=False)
class ChangeTest(Result):
    """Whether the early and the late answers are those of one σ.

    Attributes
    ----------
    p_value : float
        So probable is a statistic at least as large if nothing changed: counted among
        ``simulated``, the observed one included.
    statistic : float
        Twice the gain in log posterior density with two σ instead of one.
    simulated : array (simulations,)
        The same, of answers that one σ gave to the same questions.
    status : "converged" or "no_minimum"
        "converged": both fits to the answers, and nine in ten of those to simulated ones, are
        certified (local) maxima.
    """

    NAME = "has_changed"

    p_value: float
    statistic: float
    simulated: np.ndarray
    status: Literal["converged", "no_minimum"]

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return f"{self.status}, p = {self.p_value:.3f} by {self.simulated.size} simulations"


def has_changed(
    comparisons: Comparisons,
    prior: WishartPrior,
    *,
    split: float = 0.5,
    simulations: int = 99,
    key: Any = 0,
    spread: float = 2.0,
    sharpness: float = 2.0,
    sharper: float = 1.0,
    lapse: float | Literal["estimate"] = "estimate",
) -> ChangeTest:
    """Test whether what is wanted changed over the answers, which are in the order of time.

    A likelihood ratio: the answers before and after ``split`` with one σ each, or with one for
    both. Sharpness and lapse rate of each person are free in both parts, so that somebody who
    gets tired has not changed. The statistic has no law that we know (there is a prior, and
    answers are few): it is compared with that of answers that the fitted single σ gives to the
    same questions, a parametric bootstrap. The fitted one is a little too sharp, so that the test
    is a little too eager: of 80 answers of people who had not changed, p was at most 0.1 in about
    14 of 100 cases.

    Parameters
    ----------
    comparisons : Comparisons
        In the order of time. Without ``who``, all answers are one person's.
    split : float
        Share of each person's answers that come before, in (0, 1).
    simulations : int
    key : JAX random key or int
    prior, spread, sharpness, sharper, lapse
        As in `fit_raters`.

    Returns
    -------
    ChangeTest

    Raises
    ------
    ValueError
        If an argument is out of range, or a part has no answer.
    """
    instance("comparisons", comparisons, Comparisons)
    split, simulations = share("split", split), positive_int("simulations", simulations)
    n = len(comparisons)
    who = np.zeros(n, int) if comparisons.who is None else comparisons.who
    late = np.zeros(n, bool)
    for name in np.unique(who):
        mine = np.flatnonzero(who == name)
        late[mine[round(split * mine.size) :]] = True
    if late.all() or not late.any():
        raise ValueError(f"comparisons must have answers before and after the split, got {n}")
    person = np.unique(who, return_inverse=True)[1]
    answers = answers_of(comparisons, prior, who=2 * person + late)
    form = form_of(answers, spread, sharpness, 0.0, sharper, lapse)
    rng = generator(key)
    one, two = _fits(answers, form)
    phi = form.centre + form.shared @ one.u + one.x @ form.own.T
    z = (answers.gap * np.exp(phi[:, :-1])[answers.person]).sum(-1)
    rate = expit(phi[:, -1])[answers.person]
    P = rate / 2 + (1 - rate) * expit(z)
    statistic, simulated, certified = _statistic(one, two), [], []
    for _ in range(simulations):
        labels = (rng.uniform(size=n) < P).astype(float)
        fits = _fits(dataclasses.replace(answers, labels=labels), form)
        simulated.append(_statistic(*fits))
        certified.append(all(mode.certified for mode in (fits[0], *fits[1])))
    good = all(mode.certified for mode in (one, *two)) and np.mean(certified) >= 0.9
    larger = 1 + np.sum(np.array(simulated) >= statistic)
    result = ChangeTest(
        p_value=float(larger / (1 + simulations)),
        statistic=statistic,
        simulated=np.array(simulated),
        status="converged" if good else "no_minimum",
    )
    warn_of_failure(result)
    return result


def _fits(answers: Answers, form: Form) -> tuple[Mode, list[Mode]]:
    """Return the fit with one σ, and those of the early and of the late answers."""
    late = answers.names % 2 == 1
    return minimise(answers, form), [
        minimise(answers.of_person(part), form) for part in (~late, late)
    ]


def _statistic(one: Mode, two: list[Mode]) -> float:
    return 2 * float(one.energy - sum(mode.energy for mode in two))
