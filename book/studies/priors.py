"""What a prior is worth: regret against the number of answers, and calibrated probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import wishart

from prefmpc._random import generator
from prefmpc.learning.convex import MapResult, fit_map, fit_maps
from prefmpc.learning.priors import Structure, WishartPrior, bryson
from prefmpc.learning.selection import choose_prior
from prefmpc.learning.training import fit
from prefmpc.learning.uncertainty import Posterior, posterior
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import Preference, QuadraticPreference, logistic
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import oscillating_masses
from studies.measures import unsure_scale
from studies.quadratic import (
    QUADRATIC_HORIZON,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    SIZES,
    quadratic_data,
    stacked_loops,
)

LEARNERS = (
    "recipe, best of 20",
    "knows nothing, full",
    "knows nothing, diagonal",
    "Bryson, full",
    "Bryson, diagonal",
    "Bryson, diagonal, by evidence",
    "Bryson, diagonal, by cross-validation",
    "Bryson's rule alone",
)
"""Ways to learn that `priors_case` compares; the last one asks nobody."""

PEOPLE = ("sure", "unsure", "coupled")
"""Π of case study 1; the same with logistic answers, one in ten of them wrong; and somebody sure
who also dislikes distances between neighbouring masses, so that Q is not diagonal."""

FORCE_MAX = np.array([1.0, 1.0])
"""In newtons, what the plant's bounds say, and with `RADIUS` all that Bryson's prior is made of."""

SCALES = (0.01, 0.1, 1.0, 10.0, 100.0)
STRENGTHS = (0.1, 1.0, 10.0)
_NEIGHBOURS = np.array([[1.0, -1, 0, 0, 0, 0], [0, 1, -1, 0, 0, 0]])
COUPLED_Q = QUADRATIC_Q + 100.0 * _NEIGHBOURS.T @ _NEIGHBOURS


def candidates() -> list[WishartPrior]:
    """Return Bryson's prior with each of `SCALES` and `STRENGTHS`."""
    return [
        bryson(RADIUS, FORCE_MAX, scale=scale, strength=strength)
        for scale in SCALES
        for strength in STRENGTHS
    ]


def priors_case(
    *,
    key: Any,
    people: tuple[str, ...] = PEOPLE,
    sizes: tuple[int, ...] = SIZES,
    loops: int = 100,
) -> dict[str, np.ndarray]:
    """Learn in every way from one draw of case study 1, and control with what was learned.

    Parameters
    ----------
    people, sizes : some of `PEOPLE` and of `SIZES`
        What comes of them does not depend on the others.

    Returns
    -------
    dict
        "regret" (people, sizes, learners): mean φ₃₀ of the closed loops relative to that with the
        person's own weights; "chosen" (people, sizes, 2, 2): scale and strength that evidence and
        cross-validation chose.
    """
    streams = generator(key).spawn(3)
    system, pool, train, test = quadratic_data(key=streams[0])
    x0 = random_states(RADIUS, key=streams[1], shape=(loops,))
    noise = {(who, n): rng for (who, n), rng in zip(_cells(), streams[2].spawn(15), strict=True)}
    regret = np.zeros((len(people), len(sizes), len(LEARNERS)))
    chosen = np.zeros((len(people), len(sizes), 2, 2))
    for i, who in enumerate(people):
        Q = COUPLED_Q if who == "coupled" else QUADRATIC_Q
        models = [QuadraticCost(Q, QUADRATIC_R)]
        for j, n in enumerate(sizes):
            rng = noise[who, n]
            data, check = (_answered(d, who, unsure_scale(pool), rng) for d in (train[n], test))
            found, choices = _learn(data, check, rng)
            models += found
            for k, choice in enumerate(choices):
                scale, strength = divmod(choice, len(STRENGTHS))
                chosen[i, j, k] = SCALES[scale], STRENGTHS[strength]
        runs = stacked_loops(system, models, x0, horizon=QUADRATIC_HORIZON, steps=30)
        values = np.asarray(phi(runs, Q, QUADRATIC_R)).mean(axis=1)
        regret[i] = (values[1:] / values[0]).reshape(len(sizes), len(LEARNERS))
    return {"regret": regret, "chosen": chosen}


def _cells() -> list[tuple[str, int]]:
    return [(who, n) for who in PEOPLE for n in SIZES]


def _answered(data: Comparisons, who: str, scale: float, rng: Any) -> Comparisons:
    """Return the same pairs with the answers of somebody else."""
    if who == "sure":
        return data
    if who == "unsure":
        labels = logistic(lambda T: phi(T, QUADRATIC_Q, QUADRATIC_R), scale)(*data.pairs)
    else:
        labels = QuadraticPreference(COUPLED_Q, QUADRATIC_R)(*data.pairs)
    return Comparisons(data.trajectories, data.first, data.second, labels).sampled(key=rng)


def _learn(data: Comparisons, test: Comparisons, rng: Any) -> tuple[list[QuadraticCost], list[int]]:
    """Return what each of `LEARNERS` learns, and which candidate the two criteria chose."""
    nothing, rule = WishartPrior(np.eye(6), np.eye(2)), bryson(RADIUS, FORCE_MAX)
    full = fit_maps(data, [nothing, rule])
    diagonal = fit_maps(data, [nothing, rule], structure="diagonal")
    choices = [
        choose_prior(data, candidates(), by=by, structure="diagonal")
        for by in ("evidence", "cross_validation")
    ]
    models = [
        fit(data, key=rng, selection="leaky_test_accuracy", test=test).model,
        full[0].model,
        diagonal[0].model,
        full[1].model,
        diagonal[1].model,
        *(choice.result.model for choice in choices),
        QuadraticCost(rule.Q, rule.R),
    ]
    return models, [choice.chosen for choice in choices]


LEVELS = (0.5, 0.8, 0.9, 0.95)
ASKED = (20, 100)
METHODS = ("samples", "Laplace")
PERSON_SCALE = 1e-3
"""Of the prior that people are drawn from; small, so that they often cannot say."""


CASES = ("drawn from the prior", "the person of case study 1")


def calibration_case(*, key: Any, pairs: int = 50) -> dict[str, np.ndarray]:
    """Ask two people, and compare what is then believed with what is true.

    The first is drawn from the prior that is used: Bryson's with scale `PERSON_SCALE`. The second
    has the weights of case study 1 and noise 2, and is believed to be like Bryson's rule,
    with diagonal weights, which is far off. Both answer by the logistic model. For new pairs,
    P(first is preferred) is known; is it in the interval?

    Returns
    -------
    dict
        "covered" (cases, methods, sizes, levels): share of the new pairs whose probability lies
        in the interval; "width" likewise: mean width of the intervals; "effective" (cases,
        sizes): independent draws that the samples are worth. By `CASES`, `METHODS`, `ASKED` and
        `LEVELS`. The second case has only pairs with a probability between 5 and 95 %.
    """
    streams = generator(key).spawn(6)
    prior = bryson(RADIUS, FORCE_MAX, scale=PERSON_SCALE)
    weights = [_draw(mode, prior.strength, streams[0]) for mode in (prior.Q, prior.R)]
    system = oscillating_masses()
    pool, fresh = (
        lqr_pool(system, 50, 10, key=k, radius=RADIUS, saturate=False) for k in streams[1:3]
    )
    drawn = logistic(QuadraticCost(*weights), 1.0)
    new = Comparisons.random(fresh, drawn, pairs, key=streams[3])
    first = _coverage(drawn, prior, "full", pool, new, streams[4])

    known = logistic(QuadraticCost(QUADRATIC_Q, QUADRATIC_R), 2.0)
    many = Comparisons.random(fresh, known, 20 * pairs, key=streams[5])
    open_ones = np.flatnonzero((many.labels > 0.05) & (many.labels < 0.95))[:pairs]
    rule = bryson(RADIUS, FORCE_MAX)
    second = _coverage(known, rule, "diagonal", pool, many.subset(open_ones), streams[5])
    return {name: np.stack([first[name], second[name]]) for name in first}


def _coverage(
    ask: Preference, prior: WishartPrior, structure: Structure, pool: Trajectory, new: Any, rng: Any
) -> dict[str, np.ndarray]:
    shape = (len(METHODS), len(ASKED), len(LEVELS))
    covered, width, effective = np.zeros(shape), np.zeros(shape), np.zeros(len(ASKED))
    for j, (n, stream) in enumerate(zip(ASKED, rng.spawn(len(ASKED)), strict=True)):
        answers = Comparisons.random(pool, ask, n, key=stream).sampled(key=stream)
        result = fit_map(answers, prior, structure=structure)
        draws = posterior(result)
        effective[j] = draws.effective
        for k, level in enumerate(LEVELS):
            beliefs: tuple[Posterior | MapResult, ...] = (draws, result)
            for i, belief in enumerate(beliefs):
                one, other = new.pairs
                _, low, high = belief.probability(one, other, level)
                covered[i, j, k] = np.mean((low <= new.labels) & (new.labels <= high))
                width[i, j, k] = np.mean(high - low)
    return {"covered": covered, "width": width, "effective": effective}


def _draw(mode: np.ndarray, strength: float, rng: Any) -> np.ndarray:
    """Draw a matrix from the Wishart law with this mode."""
    law = wishart(2 * strength + len(mode) + 1, mode / (2 * strength))
    return np.asarray(law.rvs(random_state=rng)).reshape(mode.shape)
