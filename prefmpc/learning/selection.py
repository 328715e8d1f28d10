"""Choosing how strong and how sharp a prior should be, from the answers themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import choice, instance, instances, positive_int, require_x64
from prefmpc._results import FitError
from prefmpc.learning._chart import Chart, laplaces
from prefmpc.learning._newton import solve
from prefmpc.learning._problem import build, check
from prefmpc.learning.convex import MapResult, fit_map
from prefmpc.learning.losses import padded_size
from prefmpc.learning.priors import Structure, WishartPrior
from prefmpc.preferences.comparisons import Comparisons

MODE_FOUND = 1e-6
"""So near to its mode, in nats relative to the evidence, is what Laplace's method looks at."""


@dataclasses.dataclass(frozen=True, eq=False)
class PriorChoice:
    """Candidate priors, how well each explains the answers, and the result with the best.

    Attributes
    ----------
    priors : tuple of WishartPrior
    scores : array (len(priors),)
        Larger is better. "evidence": log P(answers | prior) by Laplace's method, in nats.
        "cross_validation": mean log-likelihood of an answer that was left out, in nats; −log 2 is
        a guess.
    chosen : int
    by : "evidence" or "cross_validation"
    result : MapResult
        With the chosen prior and all answers.
    """

    priors: tuple[WishartPrior, ...]
    scores: np.ndarray
    chosen: int
    by: str
    result: MapResult

    @property
    def prior(self) -> WishartPrior:
        """The chosen prior."""
        return self.priors[self.chosen]


def choose_prior(
    comparisons: Comparisons,
    priors: Sequence[WishartPrior],
    *,
    by: Literal["evidence", "cross_validation"] = "evidence",
    folds: int = 5,
    structure: Structure = "full",
    outputs: ArrayLike | None = None,
) -> PriorChoice:
    """Choose among priors by the answers that we have, never by a test set.

    All problems are solved side by side in one compiled call.

    Parameters
    ----------
    comparisons : Comparisons
    priors : sequence of WishartPrior
        For instance `bryson` with several scales and strengths.
    by : {"evidence", "cross_validation"}
        The evidence judges a prior by how probable it makes *all* answers, the cross-validation
        by those left out: every ``folds``-th comparison, from each start in turn.
    structure, outputs
        As in `fit_map`.

    Returns
    -------
    PriorChoice

    Raises
    ------
    ValueError
        If an argument is out of range, or ``structure`` has no evidence (see `posterior`).
    FitError
        If a problem is not solved.
    """
    require_x64()
    instance("comparisons", comparisons, Comparisons)
    priors = instances("priors", priors, WishartPrior)
    choice("by", by, ("evidence", "cross_validation"))
    n = len(comparisons)
    folds = positive_int("folds", folds)
    if by == "cross_validation" and not 2 <= folds <= n:
        raise ValueError(f"folds must lie between 2 and the {n} comparisons, got {folds}")
    C, entries = check([comparisons], priors, structure, outputs)
    problems = build(comparisons, priors, entries, C, padded_size(n))
    scores = _evidence(problems) if by == "evidence" else _held_out(problems, n, folds)
    chosen = int(np.argmax(scores))
    result = fit_map(comparisons, priors[chosen], structure=structure, outputs=outputs)
    return PriorChoice(tuple(priors), scores, chosen, by, result)


def _evidence(problems: list[Any]) -> np.ndarray:
    Chart.of(problems[0])  # says what is wrong before anything is computed
    found = laplaces(problems, _minima(problems))
    bad = sum(
        not (
            np.isfinite(fit.log_evidence)
            and fit.decrement <= MODE_FOUND * (1 + abs(fit.log_evidence))
        )
        for fit in found
    )
    if bad:
        raise FitError(f"choose_prior: {bad} of {len(found)} evidences were not found")
    return np.array([fit.log_evidence for fit in found])


def _held_out(problems: list[Any], n: int, folds: int) -> np.ndarray:
    first = problems[0]
    fold = np.arange(first.weights.size) % folds
    masks = [first.weights * (fold != k) for k in range(folds)]
    parts = [dataclasses.replace(p, weights=mask) for p in problems for mask in masks]
    w = np.stack(_minima(parts)).reshape(len(problems), folds, -1)
    z = w @ first.gap[:, :n]
    logs = first.labels[:n] * z - np.logaddexp(0, z)
    left_out = fold[:n] == np.arange(folds)[:, None]
    return np.where(left_out, logs, 0.0).sum(axis=(1, 2)) / n


def _minima(problems: list[Any]) -> list[np.ndarray]:
    minima = solve(problems, 1e-8, 100)
    bad = sum(not minimum.converged(1e-8) for minimum in minima)
    if bad:
        raise FitError(f"choose_prior: {bad} of {len(minima)} problems were not solved")
    return [m.w for m in minima]
