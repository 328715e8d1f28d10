"""Answers of several people, in the form that the fits of their log weights want."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import instance, require_x64
from prefmpc.learning._problem import answer_weights, build, check
from prefmpc.learning.priors import WishartPrior
from prefmpc.preferences.comparisons import Comparisons


@dataclasses.dataclass(frozen=True, eq=False)
class Answers:
    """Answers in the order of their people: what the fit sees of a data set.

    Attributes
    ----------
    gap : array (n, p)
        Diagonal second moments of the second trajectory minus those of the first, in units in
        which the prior's mode weighs each with 1.
    labels, weights : array (n,)
    start : int array (m,)
        Where each person's answers begin.
    names : array (m,)
    mode : array (p,)
        The diagonal of the prior's mode, in the user's units.
    nu : int
        How many of the p weights are those of inputs.
    """

    gap: np.ndarray
    labels: np.ndarray
    weights: np.ndarray
    start: np.ndarray
    names: np.ndarray
    mode: np.ndarray
    nu: int

    @classmethod
    def of(
        cls, comparisons: Comparisons, prior: WishartPrior, weights: np.ndarray, who: np.ndarray
    ) -> Answers:
        """Sort the answers by who gave them."""
        _, entries = check([comparisons], [prior], "diagonal", None)
        problem = build(comparisons, [prior], entries, None, len(comparisons))[0]
        order = np.argsort(who, kind="stable")
        names, start = np.unique(who[order], return_index=True)
        mode = np.concatenate([np.diag(prior.Q), np.diag(prior.R)])
        gap = np.ascontiguousarray(problem.gap.T[order])
        return cls(gap, comparisons.labels[order], weights[order], start, names, mode, problem.nu)

    @cached_property
    def person(self) -> np.ndarray:
        """Whose each answer is (n,)."""
        counts = np.diff(np.append(self.start, len(self.labels)))
        return np.repeat(np.arange(len(self.start)), counts)

    def total(self, values: np.ndarray) -> np.ndarray:
        """Return sums over each person's answers (m, ...) of values (n, ...)."""
        return np.add.reduceat(values, self.start, axis=0)

    def of_person(self, which: Any) -> Answers:
        """Return the answers of some people, by a boolean or whole-number index."""
        chosen = np.sort(np.arange(len(self.start))[which])
        person = self.person
        kept = np.isin(person, chosen)
        start = np.searchsorted(person[kept], chosen)
        parts = self.gap[kept], self.labels[kept], self.weights[kept]
        return Answers(*parts, start, self.names[chosen], self.mode, self.nu)


def answers_of(
    comparisons: Comparisons,
    prior: WishartPrior,
    weights: ArrayLike | None = None,
    who: np.ndarray | None = None,
) -> Answers:
    """Return what the fits see, by people; a ValueError if something does not fit."""
    require_x64()
    instance("comparisons", comparisons, Comparisons)
    instance("prior", prior, WishartPrior)
    who = comparisons.who if who is None else who
    if who is None:
        raise ValueError("comparisons must say who answered: Comparisons(..., who=[...])")
    counts = answer_weights(weights, len(comparisons))
    diagonal = WishartPrior(np.diag(np.diag(prior.Q)), np.diag(np.diag(prior.R)))
    return Answers.of(comparisons, diagonal, counts, who)


def costs(answers: Answers, log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Q (..., nx, nx) and R (..., nu, nu) in the user's units."""
    w = np.exp(log_weights) * answers.mode
    parts = np.split(w, [w.shape[-1] - answers.nu], axis=-1)
    Q, R = (part[..., None] * np.eye(part.shape[-1]) for part in parts)
    return Q, R
