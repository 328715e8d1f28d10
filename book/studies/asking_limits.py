"""When to stop asking, what the answers are worth afterwards, and when choosing questions fails."""

from __future__ import annotations

from typing import Any

import numpy as np

from prefmpc._pytree import stacked
from prefmpc._random import generator
from prefmpc.asking.interview import Interview
from prefmpc.asking.loops import lqr_loops
from prefmpc.evaluation import accuracy
from prefmpc.learning.priors import WishartPrior, bryson
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.loops import closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import Preference, logistic
from prefmpc.preferences.pools import random_states
from prefmpc.preferences.trajectories import max_input, phi, settling_time
from prefmpc.systems.linear import oscillating_masses
from studies.asking import (
    FORCE_MAX,
    REACH,
    STEPS,
    Person,
    answer_until,
    draw_person,
    paper_pool,
    rule,
)
from studies.onesided import ONE_SIDED, one_sided, option_pairs, person_loops
from studies.quadratic import (
    QUADRATIC_HORIZON,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    stacked_loops,
    the_person,
)
from studies.settling import (
    EPSILON,
    SETTLING_HORIZON,
    SETTLING_STEPS,
    SETTLING_VARIANTS,
    settling_preference,
)

# ---- when to stop ----

FROM_PRIOR = 8
STOPPING_PEOPLE = (
    *("from the prior",) * FROM_PRIOR,
    "paper, sure",
    "random, sure",
    "random, unsure",
)
"""Who is asked in one draw: several people from the prior of the interview, and others."""

STOPPING_COUNTS = (5, 10, 20, 40)
CAP = 80
MEASURES = ("MPC", "LQR")
"""Whose regret: of the MPC over 30 steps, as everywhere in the book, or of the saturated LQR over
the 20 steps that are shown, which is what an interview makes its statement about."""

TESTS = ("asked so far", "asked next", "random pairs, same x(0)", "random pairs of a pool")
"""What the model after 20 answers is tested on; "asked next" are the 20 questions after those."""


def prior_person(rng: np.random.Generator, spread: float = 2.0, sharpness: float = 2.0) -> Person:
    """Draw somebody from the prior of an `Interview`: weights, and how sharp the answers are."""
    scale = np.exp(spread * rng.standard_normal(8) + sharpness * rng.standard_normal())
    Q, R = rule().Q * scale[:6], rule().R * scale[6:]
    return Person(Q, R, logistic(lambda T: phi(T, Q, R), 1.0), "diagonal")


def stopping_case(
    *,
    key: Any,
    people: tuple[int, ...] = tuple(range(len(STOPPING_PEOPLE))),
    cap: int = CAP,
    loops: int = 50,
) -> dict[str, np.ndarray]:
    """Ask some of `STOPPING_PEOPLE` (by number) until the interview says that it is enough.

    Returns
    -------
    dict
        "asked" (people,): after how many answers the regret was stated to be below 2 % with
        probability 0.9 for the first time, inf if not within ``cap``; "stated" (people, 5): the
        bound of 90 % that was stated after each of `STOPPING_COUNTS` and when stopped (NaN if
        not); "regret" (people, 5, `MEASURES`): what it was in truth; "accuracy" (people, `TESTS`).
    """
    seed = int(generator(key).integers(2**63))
    x0 = random_states(RADIUS, key=np.random.default_rng([seed, 0]), shape=(loops,))
    size = len(STOPPING_COUNTS) + 1
    asked, stated = np.full(len(people), np.inf), np.full((len(people), size), np.nan)
    regret = np.full((len(people), size, len(MEASURES)), np.nan)
    share = np.zeros((len(people), len(TESTS)))
    for i, number in enumerate(people):
        rng = np.random.default_rng([seed, 1, number])
        who = STOPPING_PEOPLE[number]
        person = draw_person(who, rng) if ", " in who else prior_person(rng)
        interview = Interview(oscillating_masses(), rule(), x0=RADIUS, key=int(rng.integers(2**63)))
        models: list[Any] = [None] * size
        for n in range(1, cap + 1):
            answer_until(interview, person.answers, n, rng)
            if not np.isfinite(asked[i]) and interview.regret.stop():
                asked[i] = n
                stated[i, -1], models[-1] = interview.regret.bound(), interview.model
            if n in STOPPING_COUNTS:
                place = STOPPING_COUNTS.index(n)
                stated[i, place], models[place] = interview.regret.bound(), interview.model
            if n >= max(STOPPING_COUNTS) and np.isfinite(asked[i]):
                break
        regret[i] = true_regret(person, models, x0)
        share[i] = tested(interview, models[STOPPING_COUNTS.index(20)], person, rng)
    return {"asked": asked, "stated": stated, "regret": regret, "accuracy": share}


def true_regret(person: Person, models: list[Any], x0: np.ndarray) -> np.ndarray:
    """Return the regret (models, `MEASURES`) from x0, NaN where the model is None.

    The MPC's is NaN as well if one of its problems was not solved.
    """
    system = oscillating_masses()
    known = QuadraticCost(person.Q, person.R)
    some = [known, *(known if model is None else model for model in models)]
    stack = stacked(some)
    mpc = closed_loops(system, stack, x0, horizon=QUADRATIC_HORIZON, steps=STEPS).trajectories
    values = [phi(runs, person.Q, person.R) for runs in (mpc, lqr_loops(system, stack, x0, 20))]
    value = np.stack([np.asarray(v).mean(axis=1) for v in values], axis=-1)
    missing = np.array([model is None for model in models])
    return np.where(missing[:, None], np.nan, value[1:] / value[0] - 1)


def tested(
    interview: Interview, model: Any, person: Person, rng: np.random.Generator
) -> np.ndarray:
    """Return the accuracies of a model on each of `TESTS`."""
    answered = interview.comparisons
    alike = option_pairs(300, key=rng, person=person.answers)
    pool = Comparisons.random(paper_pool(rng), person.answers, 300, key=rng)
    sets = [answered.subset(np.arange(20)), answered.subset(np.arange(20, 40))]
    sets += [fresh.sampled(key=rng) for fresh in (alike, pool)]
    return np.array([accuracy(model, data) for data in sets])


# ---- when choosing fails ----

LIMIT_COUNTS = (5, 10, 20, 40)
WAYS = ("information", "random")
"""How pairs of closed loops from one x(0) are chosen."""

PRIORS = {
    "Bryson's rule": (REACH, 2.0),
    "speeds too dear": (RADIUS, 2.0),
    "speeds too dear, and sure of it": (RADIUS, 0.5),
}
"""The largest deviations for Bryson's rule, and the spread of what is believed at first about it;
the person is the paper's.

The second takes the speeds at the start for the largest ones: it weighs speeds 100 times as much
as the first.
"""

LAPSE = 0.2
ASSUMED: dict[str, float | str] = {"none": 0.0, "given": LAPSE, "estimated": "estimate"}
"""What the interview is told about a person who tosses a coin on one question in five."""


def lapsing(preference: Preference, rate: float = LAPSE) -> Preference:
    """Return somebody who tosses a coin on a share ``rate`` of the questions."""
    return lambda first, second: rate / 2 + (1 - rate) * np.asarray(preference(first, second))


def limits_case(
    *, key: Any, counts: tuple[int, ...] = LIMIT_COUNTS, loops: int = 50
) -> dict[str, np.ndarray]:
    """Ask the paper's person with a wrong prior, one who lapses, and the one-sided one.

    Returns
    -------
    dict
        "prior" (`PRIORS`, `WAYS`, counts) and "lapse" (`ASSUMED`, `WAYS`, counts): regret, inf
        if an MPC problem was not solved;
        "rate" (counts,): the estimated lapse rate with chosen pairs; "onesided" (`WAYS`, counts):
        mean cost of the one-sided person over that of the MPC that knows them, minus 1.
    """
    seed = int(generator(key).integers(2**63))
    x0 = random_states(RADIUS, key=np.random.default_rng([seed, 0]), shape=(loops,))
    rates: list[float] = []

    def learn(answers: Preference, prior: WishartPrior, choose: str, **options: Any) -> list[Any]:
        rng = np.random.default_rng([seed, 1])
        options |= {"x0": RADIUS, "key": int(rng.integers(2**63)), "choose": choose}
        interview = Interview(oscillating_masses(), prior, **options)
        models = []
        for count in counts:
            answer_until(interview, answers, count, rng)
            models.append(interview.model)
            if options.get("lapse") == "estimate" and choose == WAYS[0]:
                rates.append(interview.certificate.lapse)
        return models

    person, careless = the_person(), lapsing(the_person())
    models: list[Any] = [QuadraticCost(QUADRATIC_Q, QUADRATIC_R)]
    for reach, spread in PRIORS.values():
        for way in WAYS:
            models += learn(person, bryson(reach, FORCE_MAX), way, spread=spread)
    for lapse in ASSUMED.values():
        for way in WAYS:
            models += learn(careless, rule(), way, lapse=lapse)
    one_side = [model for way in WAYS for model in learn(ONE_SIDED, rule(), way)]
    stack = stacked([*models, *one_side])
    runs = closed_loops(
        oscillating_masses(), stack, x0, horizon=QUADRATIC_HORIZON, steps=STEPS
    ).trajectories
    value = np.asarray(phi(runs[: len(models)], QUADRATIC_Q, QUADRATIC_R)).mean(axis=1)
    value = np.where(np.isnan(value), np.inf, value)
    best = one_sided(person_loops(oscillating_masses(), x0, STEPS)).mean()
    wrong, lapsed = np.split(value[1:] / value[0] - 1, [len(PRIORS) * len(WAYS) * len(counts)])
    return {
        "prior": wrong.reshape(len(PRIORS), len(WAYS), -1),
        "lapse": lapsed.reshape(len(ASSUMED), len(WAYS), -1),
        "rate": np.array(rates),
        "onesided": (one_sided(runs[len(models) :]).mean(axis=1) / best - 1).reshape(2, -1),
    }


# ---- the person of case study 2 ----

SETTLED_COUNTS = (20, 40, 100)
SETTLED_COLUMNS = ("median κ", "max κ", "mean max|u|", "skipped")


def settled_case(
    *,
    key: Any,
    ways: tuple[str, ...] = WAYS,
    counts: tuple[int, ...] = SETTLED_COUNTS,
    loops: int = 200,
) -> dict[str, np.ndarray]:
    """Ask the person who wants the output to settle soon, with and without Πᵤ.

    The plant has no input limits, and trajectories have 15 steps, as in case study 2. Without Πᵤ
    pairs that settle at the same time are skipped; ``counts`` are of questions, those among them.

    Returns
    -------
    dict
        "table" (variants, ways, counts, `SETTLED_COLUMNS`): of closed loops of 30 steps with
        N = 15, and how many questions were skipped.
    """
    seed = int(generator(key).integers(2**63))
    system = oscillating_masses(u_max=np.inf)
    x0 = random_states(RADIUS, key=np.random.default_rng([seed, 0]), shape=(loops,))
    models: list[Any] = []
    skipped: list[int] = []
    for variant in SETTLING_VARIANTS:
        for way in ways:
            interview = Interview(
                system,
                rule(),
                x0=RADIUS,
                key=seed,
                steps=SETTLING_HORIZON,
                choose=way,  # type: ignore[arg-type]
            )
            for count in counts:
                interview.answer_with(settling_preference(variant), count - len(interview))
                models.append(interview.model)
                skipped.append(int(np.isnan(interview.labels).sum()))
    N, steps = SETTLING_HORIZON, SETTLING_STEPS
    runs = stacked_loops(system, models, x0, horizon=N, steps=steps)
    kappa, force = settling_time(runs, EPSILON), max_input(runs)
    columns = [np.median(kappa, axis=1), kappa.max(axis=1), force.mean(axis=1), skipped]
    shape = len(SETTLING_VARIANTS), len(ways), len(counts), len(columns)
    return {"table": np.stack(columns, axis=-1).reshape(shape)}
