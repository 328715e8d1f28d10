"""One σ from several people: how sharp and how attentive each is, and how much they differ.

Log weights are Gaussian here, and Q and R diagonal. For given sharpnesses, without lapses and in
the weights themselves, the problem is the convex one of `fit_map`; with these estimated too it is
not convex, and "converged" says that decrement and curvature certify a local minimum.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any, Literal

import numpy as np
from jax.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.special import expit, ndtri

from prefmpc._checks import (
    instance,
    number,
    positive,
    share,
)
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._answers import Answers, answers_of, costs
from prefmpc.learning._people import Form, Mode, form, minimise
from prefmpc.learning.convex import Interval
from prefmpc.learning.priors import WishartPrior
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.comparisons import Comparisons

APART, APART_SPREAD = 0.5, 1.0
"""An estimated ``apart`` is log-normal beforehand: its median, and the spread of its logarithm."""

SMALLEST, LARGEST = 0.02, 4.0
"""Between these an ``apart`` is sought."""


@dataclasses.dataclass(frozen=True, eq=False)
class PeopleResult(Result):
    """What the answers of several people say of each of them, and of what they have in common.

    Attributes
    ----------
    names : array (m,)
        Of the people, sorted; all that is (m, ...) is in this order.
    Q, R : array (nx, nx), (nu, nu)
        The common σ; `model` refuses to hand out an unfinished one.
    apart : float
        Standard deviation of the ratios of a person's log weights about the common ones; 0: all
        want the same.
    lapse : array (m,)
        Share of coin flips among each person's answers.
    status : "converged", "no_minimum" or "not_finite"
        "converged": decrement and curvature certify a (local) maximum of the posterior density.
    objective : float
        −log posterior density, in coordinates that are standard Gaussian beforehand.
    log_evidence : float
        log P(answers) by Laplace's method, in nats (with weights that are not 1: of a likelihood
        to their power).
    decrement, curvature : float
        Half the squared Newton decrement, and the least eigenvalue of the exact Hessian where the
        prior's are 1.
    iterations : int
    seconds : float
    """

    NAME = "fit_raters or fit_hierarchy"

    names: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    apart: float
    lapse: np.ndarray
    status: Literal["converged", "no_minimum", "not_finite"]
    objective: float
    log_evidence: float
    decrement: float
    curvature: float
    iterations: int
    seconds: float
    answers: Answers = dataclasses.field(repr=False)
    form: Form = dataclasses.field(repr=False)
    mode: Mode = dataclasses.field(repr=False)

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return (
            f"{self.status} after {self.iterations} Newton steps, decrement {self.decrement:.1e}, "
            f"least curvature {self.curvature:.1e}"
        )

    @property
    def model(self) -> QuadraticCost:
        """The common σ, as sharp as people are on average (of logarithms)."""
        self.check()
        return QuadraticCost(self.Q, self.R)

    @property
    def models(self) -> QuadraticCost:
        """What each person wants, and how sharply: a stack of models (m,)."""
        self.check()
        return QuadraticCost(*costs(self.answers, self._log_weights()))

    def sharpness(self, level: float = 0.9) -> Interval:
        """Return how sharp each person's answers are, by Laplace's method.

        The geometric mean of the weights in units of the prior's mode, which is the scale of
        log-odds. Somebody who flips a coin has nearly none. With some tens of answers each, the
        intervals are too narrow and their middle too sharp: see `people_posterior`.

        Returns
        -------
        Interval
            Three arrays (m,): the posterior's median, and bounds with equal shares outside.
        """
        p = len(self.answers.mode)
        mean = np.append(np.full(p, 1 / p), 0.0)
        return Interval(*(part[:, 0] for part in self._interval(mean[None], level, np.exp)))

    def lapses(self, level: float = 0.9) -> Interval:
        """Return the lapse rate of each person: medians and bounds (m,), likewise."""
        p = len(self.answers.mode)
        last = np.eye(p + 1)[-1:]
        return Interval(*(part[:, 0] for part in self._interval(last, level, expit)))

    def relative(self, level: float = 0.9) -> Interval:
        """Return the common weights over their geometric mean, in units of the prior's mode.

        What is wanted, whatever the sharpness: the diagonals of Q and R in a row (nx + nu,).
        """
        p = len(self.answers.mode)
        centred = np.eye(p, p + 1)
        centred[:, :p] -= 1 / p
        return Interval(*(part[0] for part in self._interval(centred, level, np.exp, own=False)))

    def newcomer(self, comparisons: Comparisons) -> PeopleResult:
        """Return what one more person of the same population wants, from few answers.

        They are believed to be about the common σ as the people here are: by ``apart``, and by
        how unsure the common σ is. In the result, ``model`` is what this person wants.

        Parameters
        ----------
        comparisons : Comparisons
            Of one person, with the same plant; ``who`` is not needed.

        Raises
        ------
        ValueError
            If the answers are those of several people.
        """
        self.check()
        began = time.perf_counter()
        instance("comparisons", comparisons, Comparisons)
        n = len(comparisons)
        who = np.zeros(n, int) if comparisons.who is None else comparisons.who
        if len(np.unique(who)) > 1:
            raise ValueError(f"comparisons must be of one person, got {np.unique(who)}")
        p, nu = len(self.answers.mode), self.answers.nu
        Q, R = (np.diag(part) for part in np.split(self.answers.mode, [p - nu]))
        answers = answers_of(comparisons, WishartPrior(Q, R), who=who)
        weights = np.arange(p + 1)[:, None] < p
        old, own = self.form, self.form.own * weights  # without the lapse rate
        both = old.shared @ np.linalg.inv(self.mode.outer) @ old.shared.T + own @ own.T
        values, vectors = np.linalg.eigh(both)
        kept = values > 1e-12 * values[-1]
        lapse = old.own[:, old.own[-1] != 0]
        new = Form(
            old.centre + old.shared @ self.mode.u, vectors[:, kept] * values[kept] ** 0.5, lapse
        )
        result = _result(answers, new, minimise(answers, new), self.apart, began)
        warn_of_failure(result)
        return result

    def _log_weights(self) -> np.ndarray:
        """Return the natural coordinates (m, p) of all people."""
        phi = self.form.centre + self.form.shared @ self.mode.u + self.mode.x @ self.form.own.T
        return phi[:, :-1]

    def _interval(self, of: np.ndarray, level: float, link: Any, own: bool = True) -> Interval:
        """Return medians and bounds (m, k) of a function of ``of`` (k, p + 1) times everybody's
        log weights and logit lapse rate; without what is ``own``: of the common ones (1, k).
        """
        reach = ndtri((1 + share("level", level)) / 2)
        self.check()
        by_u, by_x = of @ self.form.shared, of @ self.form.own * own
        base = np.where(of != 0, of * self.form.centre, 0.0).sum(-1)  # no lapses: 0·(−∞)
        at = base + by_u @ self.mode.u + self.mode.x @ by_x.T
        std = np.sqrt(np.diagonal(self.mode.covariance(by_u, by_x), axis1=1, axis2=2))
        bounds = (link(at + side * reach * std)[: None if own else 1] for side in (0, -1, 1))
        return Interval(*bounds)


def fit_raters(
    comparisons: Comparisons,
    prior: WishartPrior,
    *,
    spread: float = 2.0,
    sharpness: float = 2.0,
    sharper: float = 1.0,
    lapse: float | Literal["estimate"] = "estimate",
    weights: ArrayLike | None = None,
) -> PeopleResult:
    """Learn one diagonal σ from people of whom some answer more surely, or more by chance.

    P(first preferred) = ε/2 + (1 − ε)·logistic(s·[σ(second) − σ(first)]) with a sharpness s and a
    lapse rate ε of each person. Both are estimated, so that an unreliable person counts less.
    Whether one σ serves all is what `find_camps` asks.

    Parameters
    ----------
    comparisons : Comparisons
        With ``who``.
    prior : WishartPrior
        Of it, the diagonal of the mode: where the common log weights are Gaussian about.
    spread, sharpness : float
        Standard deviation of the common log weights about it: of each ratio, and of what all
        weights have in common.
    sharper : float
        Standard deviation of the logarithm of a person's sharpness about the common one.
    lapse : float or "estimate"
        ε in [0, 1), or one for each person, by a logit with mean logit(0.05) and spread 1.5.
    weights : array (n,), optional
        As how many answers each one counts, at least 0; see `forgetting`.

    Returns
    -------
    PeopleResult

    Raises
    ------
    ValueError
        If an argument is out of range, or ``comparisons`` does not say who answered.
    """
    began = time.perf_counter()
    answers = answers_of(comparisons, prior, weights)
    wanted = form_of(answers, spread, sharpness, 0.0, sharper, lapse)
    result = _result(answers, wanted, minimise(answers, wanted), 0.0, began)
    warn_of_failure(result)
    return result


def fit_hierarchy(
    comparisons: Comparisons,
    prior: WishartPrior,
    *,
    apart: float | Literal["estimate"] = "estimate",
    spread: float = 2.0,
    sharpness: float = 2.0,
    sharper: float = 1.0,
    lapse: float | Literal["estimate"] = "estimate",
    weights: ArrayLike | None = None,
) -> PeopleResult:
    """Learn a diagonal σ of each person about a common one: who said little borrows from the rest.

    Parameters
    ----------
    apart : float or "estimate"
        Standard deviation of the ratios of a person's log weights about the common ones. By
        default the one that makes the answers most probable (by Laplace's method), with a
        log-normal prior of median 0.5 and spread 1.
    comparisons, prior, spread, sharpness, sharper, lapse, weights
        As in `fit_raters`.

    Returns
    -------
    PeopleResult
        Its `PeopleResult.newcomer` learns what one more person wants from few answers.

    Raises
    ------
    ValueError
        If an argument is out of range, or ``comparisons`` does not say who answered.
    """
    began = time.perf_counter()
    answers = answers_of(comparisons, prior, weights)

    def fitted(apart: float) -> tuple[Form, Mode]:
        wanted = form_of(answers, spread, sharpness, apart, sharper, lapse)
        return wanted, minimise(answers, wanted)

    def badness(log_apart: float) -> float:
        off = (log_apart - np.log(APART)) / APART_SPREAD
        return 0.5 * off**2 - fitted(np.exp(log_apart))[1].log_evidence

    if isinstance(apart, str) and apart == "estimate":
        bounds = np.log(SMALLEST), np.log(LARGEST)
        found = minimize_scalar(badness, bounds=bounds, method="bounded", options={"xatol": 0.02})
        apart = float(np.exp(found.x))
    apart = positive("apart", apart)
    result = _result(answers, *fitted(apart), apart, began)
    warn_of_failure(result)
    return result


def form_of(
    answers: Answers, spread: Any, sharpness: Any, apart: float, sharper: Any, lapse: Any
) -> Form:
    """Return the form of the people's prior; a ValueError if a number is out of range."""
    sizes = positive("spread", spread), positive("sharpness", sharpness)
    sharper = positive("sharper", sharper)
    rate = None
    if not (isinstance(lapse, str) and lapse == "estimate"):
        kind = 'a number or "estimate"'
        rate = number("lapse", lapse, kind, lambda v: 0 <= v < 1, "lie in [0, 1)")
    return form(len(answers.mode), *sizes, apart, sharper, rate)


def _result(answers: Answers, wanted: Form, mode: Mode, apart: float, began: float) -> PeopleResult:
    centre = wanted.centre + wanted.shared @ mode.u
    Q, R = costs(answers, centre[:-1])
    finite = all(np.isfinite(part).all() for part in (Q, R, mode.energy, mode.log_evidence))
    return PeopleResult(
        names=answers.names,
        Q=Q,
        R=R,
        apart=apart,
        lapse=expit(wanted.centre[-1] + mode.x @ wanted.own[-1]),
        status=("converged" if mode.certified else "no_minimum") if finite else "not_finite",
        objective=mode.energy,
        log_evidence=mode.log_evidence,
        decrement=mode.decrement,
        curvature=mode.curvature,
        iterations=mode.steps,
        seconds=time.perf_counter() - began,
        answers=answers,
        form=wanted,
        mode=mode,
    )
