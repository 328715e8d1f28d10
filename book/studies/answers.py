"""What an answer is worth: ties, strengths, rankings and stars beside plain pairs.

The person is not the learner's model: somebody perceives each cost with an error of their own, and
says "no difference" or "much better" where the perceived difference is small or large. So ties and
strengths follow the *cumulative* logit, and are learned with adjacent categories. Rankings are
Plackett and Luce's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from prefmpc._random import generator
from prefmpc.learning.convex import fit_map
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.answers import Answers
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import QuadraticPreference
from prefmpc.preferences.pools import random_states
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import oscillating_masses
from studies.asking import STEPS, Person, draw_person, paper_pool, rule
from studies.measures import unsure_scale
from studies.quadratic import QUADRATIC_HORIZON, RADIUS, stacked_loops

PEOPLE = ("random, sure", "random, unsure")
COUNTS = (12, 40, 120)
"""Answers about pairs; a quarter as many are rankings, or choices of the best of five."""

TIES, MUCH = 0.25, 0.7
"""Shares of the random pairs whose perceived difference is nothing to them, and not much."""

LEARNERS = (
    "forced choice",
    "ties dropped",
    "ties as halves",
    "ties",
    "strengths",
    "best of five",
    "ranking of five",
    "five stars",
)


def collected(person: Person, pool: Trajectory, count: int, rng: np.random.Generator) -> Any:
    """Return what one person says to ``count`` questions of every kind: data by learner."""
    cost = np.asarray(phi(pool, person.Q, person.R))
    scale = unsure_scale(pool, Q=person.Q, R=person.R)
    noise = 0.0 if isinstance(person.answers, QuadraticPreference) else 1.0
    z = cost / scale

    def heard(items: np.ndarray) -> np.ndarray:  # differences of these errors are logistic
        return z[items] - noise * rng.gumbel(size=items.shape)

    n = len(pool)
    first = rng.integers(0, n, count)
    pairs = np.stack([first, (first + rng.integers(1, n, count)) % n], axis=1)
    gap = np.diff(heard(pairs))[:, 0]  # positive: the first is better
    typical = np.abs(np.diff(heard(rng.integers(0, n, (4000, 2))))[:, 0])
    little, much = np.quantile(typical, [TIES, MUCH])
    strength = np.sign(gap) * ((np.abs(gap) > little) + 1.0 * (np.abs(gap) > much))
    sides = pool, pairs[:, 0], pairs[:, 1]
    ties = (np.sign(strength) + 1) / 2
    clear = np.flatnonzero(strength != 0)
    fives = np.array([rng.permutation(n)[:5] for _ in range(count // 4)])
    orders = np.take_along_axis(fives, np.argsort(heard(fives), axis=1), axis=1)
    shown = rng.integers(0, n, count)
    marks = np.quantile(heard(rng.integers(0, n, 4000)), [0.2, 0.4, 0.6, 0.8])
    stars = 5 - np.searchsorted(marks, heard(shown))
    return {
        "forced choice": Comparisons(*sides, (gap > 0).astype(float)),
        "ties dropped": Comparisons(*sides, ties).subset(clear),
        "ties as halves": Comparisons(*sides, ties),
        "ties": Answers.from_labels(*sides, np.sign(strength), coding="signs"),
        "strengths": Answers.from_labels(*sides, strength, coding="signs", grades=5),
        "best of five": Answers.from_choices(pool, fives, orders[:, 0]),
        "ranking of five": Answers.from_rankings(pool, orders),
        "five stars": Answers.from_ratings(pool, stars, stars=5, index=shown),
    }


def answers_case(
    *, key: Any, people: tuple[str, ...] = PEOPLE, counts: tuple[int, ...] = COUNTS, loops: int = 50
) -> dict[str, np.ndarray]:
    """Ask one draw of each of ``people`` in every way.

    Returns
    -------
    dict
        "regret" (people, learners, counts): mean φ₃₀ of ``loops`` closed loops over that of the
        MPC with the person's own weights, minus 1; "ties" (people, counts): the share of ties.
    """
    seed = int(generator(key).integers(2**63))
    x0 = random_states(RADIUS, key=np.random.default_rng([seed, 0]), shape=(loops,))
    regret = np.zeros((len(people), len(LEARNERS), len(counts)))
    shares = np.zeros((len(people), len(counts)))
    for i, who in enumerate(people):
        person = draw_person(who, np.random.default_rng([seed, 1]))
        pool = paper_pool(np.random.default_rng([seed, 2]))
        models = [QuadraticCost(person.Q, person.R)]
        for k, count in enumerate(counts):
            rng = np.random.default_rng([seed, 3, PEOPLE.index(who), count])
            data = collected(person, pool, count, rng)
            shares[i, k] = np.mean(data["ties"].answers == 0.5)
            fits = [fit_map(data[name], rule(), structure="diagonal") for name in LEARNERS]
            models += [fit.model for fit in fits]
        runs = stacked_loops(
            oscillating_masses(), models, x0, horizon=QUADRATIC_HORIZON, steps=STEPS
        )
        value = np.asarray(phi(runs, person.Q, person.R)).mean(axis=1)
        regret[i] = (value[1:] / value[0] - 1).reshape(len(counts), len(LEARNERS)).T
    return {"regret": regret, "ties": shares}
