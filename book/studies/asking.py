"""How many questions: strategies that choose them, raced over many simulated people.

A `Strategy` is a function; a new one is an entry of `STRATEGIES`. All are judged by the same
measure: the extra φ₃₀ of the MPC with the learned σ over that of the MPC that knows the person's
weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from prefmpc._pytree import stacked
from prefmpc._random import generator
from prefmpc.asking.interview import Interview
from prefmpc.learning.priors import WishartPrior, bryson
from prefmpc.models.quadratic import QuadraticCost
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
    stacked_loops,
)

COUNTS = (5, 10, 20, 40)
FEWER = (10, 15, 20, 25)
STEPS = 30
REACH = np.repeat([0.3, 0.5], 3)
"""Metres and metres per second that the responses reach, by and large."""

FORCE_MAX = np.array([1.0, 1.0])
"""N: what the plant's bounds say, and with `REACH` all that the prior is made of."""


@dataclasses.dataclass(frozen=True, eq=False)
class Person:
    """Who answers, and with what weights."""

    Q: np.ndarray
    R: np.ndarray
    answers: Preference
    structure: Any


def rule() -> WishartPrior:
    """Return Bryson's rule for the plant: the centre of what everybody believes at first."""
    return bryson(REACH, FORCE_MAX)


PEOPLE = tuple(
    f"{kind}, {mood}" for kind in ("paper", "random", "coupled") for mood in ("sure", "unsure")
)
"""Whose weights, and how they answer.

"paper": the weights of case study 1; "random": log weights about Bryson's rule with standard
deviation 1; "coupled": the same, with correlations between states and between inputs. "sure": who
never errs; "unsure": logistic, wrong about one in ten random pairs of the paper's pool.
"""


def draw_person(who: str, rng: np.random.Generator) -> Person:
    """Return one of `PEOPLE`; sure or not, the same numbers make the same weights."""
    kind, mood = who.split(", ")
    Q, R = QUADRATIC_Q, QUADRATIC_R
    scales = [np.exp(rng.standard_normal(len(M))) for M in (Q, R)]
    loose = [rng.standard_normal((len(M), 2 * len(M))) for M in (Q, R)]
    pool = paper_pool(rng)
    if kind != "paper":
        Q, R = (M * np.diag(s) for M, s in zip((rule().Q, rule().R), scales, strict=True))
    if kind == "coupled":
        Q, R = (_correlated(M, z) for M, z in zip((Q, R), loose, strict=True))
    person: Preference = QuadraticPreference(Q, R)
    if mood == "unsure":
        person = logistic(lambda T: phi(T, Q, R), unsure_scale(pool, Q=Q, R=R))
    return Person(Q, R, person, "full" if kind == "coupled" else "diagonal")


def _correlated(M: np.ndarray, loose: np.ndarray) -> np.ndarray:
    """Return a matrix with the diagonal of M and the correlations of random vectors (n, 2 n)."""
    unit = loose / np.linalg.norm(loose, axis=1, keepdims=True)
    size = np.sqrt(np.diag(M))
    return size[:, None] * size * (unit @ unit.T)


def paper_pool(rng: np.random.Generator) -> Trajectory:
    """Return 50 trajectories as the paper draws them, within the limits of the force."""
    return lqr_pool(oscillating_masses(), 50, QUADRATIC_HORIZON, key=rng, radius=RADIUS)


Strategy = Callable[[Person, tuple[int, ...], np.random.Generator], list[QuadraticCost]]
"""(person, after how many answers, random numbers) ↦ what was learned after each of them."""


def interviewed(
    person: Person,
    counts: tuple[int, ...],
    rng: np.random.Generator,
    *,
    pool: bool = False,
    **options: Any,
) -> list[QuadraticCost]:
    """Let an `Interview` choose the questions: a strategy once its options are given."""
    interview = Interview(
        oscillating_masses(),
        rule(),
        x0=RADIUS,
        key=int(rng.integers(2**63)),
        structure=person.structure,
        pool=paper_pool(rng) if pool else None,
        **options,
    )
    models: list[Any] = []
    for count in counts:
        answer_until(interview, person.answers, count, rng)
        models.append(interview.model)
    return models


def answer_until(
    interview: Interview, answers: Preference, count: int, rng: np.random.Generator
) -> None:
    """Let a person answer, by chance where they are not sure, until there are so many answers."""
    while len(interview) < count:
        question = interview.next()
        pair = stacked([question.first]), stacked([question.second])
        interview.answer(float(rng.uniform() < answers(*pair)[0]))


STRATEGIES: dict[str, Strategy] = {
    "random pairs of a pool": partial(interviewed, pool=True, choose="random"),
    "random pairs, same x(0)": partial(interviewed, choose="random"),
    "most informative pair of a pool": partial(interviewed, pool=True),
    "made on purpose": interviewed,
    "made on purpose, regret": partial(interviewed, choose="regret"),
    "made on purpose, volume": partial(interviewed, choose="volume"),
    "made on purpose, EUBO": partial(interviewed, choose="eubo"),
}


def asking_case(
    *,
    key: Any,
    people: tuple[str, ...] = PEOPLE,
    strategies: tuple[str, ...] = tuple(STRATEGIES),
    counts: tuple[int, ...] = COUNTS,
    loops: int = 50,
) -> dict[str, np.ndarray]:
    """Ask one draw of each of ``people`` with every strategy.

    Returns
    -------
    dict
        "regret" (people, strategies, counts): mean φ₃₀ of ``loops`` closed loops over that of the
        MPC with the person's own weights, minus 1. One person's regret with one strategy does not
        depend on what else is asked for.
    """
    seed = int(generator(key).integers(2**63))
    x0 = random_states(RADIUS, key=np.random.default_rng([seed, 0]), shape=(loops,))
    regret = np.zeros((len(people), len(strategies), len(counts)))
    for i, who in enumerate(people):
        person = draw_person(who, np.random.default_rng([seed, 1]))
        models = [QuadraticCost(person.Q, person.R)]
        for name in strategies:
            place = [PEOPLE.index(who), list(STRATEGIES).index(name)]
            rng = np.random.default_rng([seed, 2, *place])
            models += STRATEGIES[name](person, counts, rng)
        runs = stacked_loops(
            oscillating_masses(), models, x0, horizon=QUADRATIC_HORIZON, steps=STEPS
        )
        value = np.asarray(phi(runs, person.Q, person.R)).mean(axis=1)
        regret[i] = (value[1:] / value[0] - 1).reshape(regret.shape[1:])
    return {"regret": regret}
