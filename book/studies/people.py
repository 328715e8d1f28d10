"""Several people, and people who change: what learning from all of their answers is worth.

The plant and the measure are those of `studies.asking`: the extra φ₃₀ of the MPC with the learned σ
over that of the MPC that knows the person's weights. Questions are random pairs of responses with
the same x(0), so that nothing but the control differs.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from prefmpc._random import generator
from prefmpc.learning.camps import find_camps
from prefmpc.learning.change import forgetting, has_changed
from prefmpc.learning.people import fit_hierarchy, fit_raters
from prefmpc.learning.people_posterior import people_posterior
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import oscillating_masses
from studies.asking import STEPS, rule
from studies.quadratic import QUADRATIC_HORIZON, RADIUS, stacked_loops

STARTS, COPIES = 12, 8
"""A pool: so many x(0), each with so many controllers."""

ERROR = 0.1
"""Share of the pool's questions that a person answers wrongly."""

RATERS, RELIABLE, EACH = 6, 4, 30
"""People who are asked, those of them who do not flip coins, and answers of each."""

RATED = ("all as one person", "all, each rated", "reliable ones, each rated", "reliable as one")

CROWD, CROWD_EACH, APART, NEWCOMERS = 10, 40, 0.5, 4
FEW = (0, 5, 20)
"""Answers of a newcomer."""
POOLED = ("alone", "partial pooling", "one σ for all")

CAMPS = ("one camp", "opposed camps", "two random people", "one camp, people a little apart")
CAMP_PEOPLE, CAMP_EACH = 10, 20
CAMP_COLUMNS = ("camps", "rightly assigned")

CALIBRATED = ("sharpness of one", "weights of the common σ", "lapse rate of one")
METHODS = ("Laplace", "samples")
REPEATS = 5
"""Populations of a draw that are drawn from the prior."""

CHANGES = ("nothing changes", "weights change halfway")
REMEMBERED = ("all alike", "forgetting", "late half only")
LONG, HALF_LIFE, SIMULATIONS = 80, 20.0, 19


class Someone:
    """A person with diagonal weights, wrong about `ERROR` of the questions of a pool.

    Parameters
    ----------
    logs : array (8,)
        Log weights about Bryson's rule.
    pool : Trajectory
    """

    def __init__(self, logs: np.ndarray, pool: Trajectory) -> None:
        self.logs = logs
        w = np.exp(logs) * np.concatenate([np.diag(rule().Q), np.diag(rule().R)])
        self.Q, self.R = np.diag(w[:6]), np.diag(w[6:])
        self.model = QuadraticCost(self.Q, self.R)
        self.cost = np.asarray(phi(pool, self.Q, self.R))
        grouped = self.cost.reshape(STARTS, COPIES)
        i, j = np.triu_indices(COPIES, 1)
        gap = np.abs(grouped[:, i] - grouped[:, j]).ravel()
        low, high = 1e-9 * gap.max(), 1e3 * gap.max()
        for _ in range(60):
            self.scale = float(np.sqrt(low * high))
            wrong = (0.5 * (1 - np.tanh(gap / self.scale / 2))).mean()
            low, high = (self.scale, high) if wrong < ERROR else (low, self.scale)

    def P(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return P(first is preferred) of pairs of the pool."""
        return 0.5 * (1 - np.tanh((self.cost[first] - self.cost[second]) / self.scale / 2))


def people_pool(rng: np.random.Generator) -> Trajectory:
    """Return loops of random controllers, `COPIES` from each of `STARTS` states in a row."""
    x0 = np.repeat(random_states(RADIUS, key=rng, shape=(STARTS,)), COPIES, axis=0)
    return lqr_pool(oscillating_masses(), STARTS * COPIES, QUADRATIC_HORIZON, key=rng, x0=x0)


def questions(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return random pairs of a pool that share their x(0)."""
    first = rng.integers(0, STARTS * COPIES, n)
    step = rng.integers(1, COPIES, n)
    return first, first // COPIES * COPIES + (first % COPIES + step) % COPIES


def together(
    pool: Trajectory, people: list[Any], each: int, rng: np.random.Generator
) -> Comparisons:
    """Ask everybody ``each`` questions of their own; None flips coins."""
    first, second = questions(each * len(people), rng)
    who = np.repeat(np.arange(len(people)), each)
    P = np.full(first.size, 0.5)
    for k, person in enumerate(people):
        if person is not None:
            P[who == k] = person.P(first[who == k], second[who == k])
    return Comparisons(pool, first, second, (rng.uniform(size=P.size) < P).astype(float), who)


def alone(data: Comparisons) -> Comparisons:
    """Return the answers as if one person had given them."""
    parts = data.trajectories, data.first, data.second, data.labels
    return Comparisons(*parts, np.zeros(len(data), int))


def raters(pool: Trajectory, rng: np.random.Generator) -> tuple[Someone, list[QuadraticCost]]:
    """Learn as `RATED` says from people of whom one in three flips coins."""
    person = Someone(rng.standard_normal(8), pool)
    everybody = [person] * RELIABLE + [None] * (RATERS - RELIABLE)
    data = together(pool, everybody, EACH, rng)
    some = data.subset(np.arange(RELIABLE * EACH))
    return person, [
        fit_raters(alone(data), rule(), lapse=0.0).model,
        fit_raters(data, rule()).model,
        fit_raters(some, rule()).model,
        fit_raters(alone(some), rule(), lapse=0.0).model,
    ]


def newcomers(
    pool: Trajectory, rng: np.random.Generator
) -> tuple[list[Someone], list[QuadraticCost], float]:
    """Learn as `POOLED` says what people want who come after a crowd; and how far it is apart."""
    centre = rng.standard_normal(8)
    logs = centre + APART * rng.standard_normal((CROWD + NEWCOMERS, 8))
    people = [Someone(each, pool) for each in logs]
    crowd = together(pool, list(people[:CROWD]), CROWD_EACH, rng)
    known = fit_hierarchy(crowd, rule())
    common = fit_raters(crowd, rule())
    models = []
    for person in people[CROWD:]:
        data = together(pool, [person], max(FEW), rng)
        for n in FEW:
            if not n:
                models += [QuadraticCost(rule().Q, rule().R), known.model, common.model]
                continue
            said = data.subset(np.arange(n))
            models += [fit_raters(said, rule()).model, known.newcomer(said).model]
            models.append(common.newcomer(said).model)
    return people[CROWD:], models, known.apart


def camps(pool: Trajectory, rng: np.random.Generator) -> np.ndarray:
    """Return `CAMP_COLUMNS` for each of `CAMPS`."""
    sides = np.repeat([1.0, -1.0], [6, 2])  # quick, or sparing
    some = [rng.standard_normal(8) for _ in range(2)]
    noise = [0.5 * rng.standard_normal(8) for _ in range(2)]
    centres = {
        "one camp": [some[0], some[0]],
        "opposed camps": [sides + noise[0], noise[1] - sides],
        "two random people": some,
        "one camp, people a little apart": [some[0], some[0]],
    }
    out = np.zeros((len(CAMPS), len(CAMP_COLUMNS)))
    for i, name in enumerate(CAMPS):
        truth = np.arange(CAMP_PEOPLE) % 2
        apart = 0.3 * rng.standard_normal((CAMP_PEOPLE, 8)) * (name == CAMPS[3])
        people = [
            Someone(centres[name][k] + each, pool) for k, each in zip(truth, apart, strict=True)
        ]
        data = together(pool, list(people), CAMP_EACH, rng)
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            found = find_camps(data, rule(), key=int(rng.integers(2**31)))
        right = max(np.mean(found.camp == truth), np.mean(found.camp == 1 - truth))
        divided = centres[name][0] is not centres[name][1]
        out[i] = found.count, right if divided else np.nan
    return out


def calibration(pool: Trajectory, rng: np.random.Generator) -> np.ndarray:
    """Return the coverage (`REPEATS`, `METHODS`, `CALIBRATED`) of 90 % intervals."""
    sizes = {"spread": 1.0, "sharpness": 1.0, "sharper": 1.0}
    mode = np.concatenate([np.diag(rule().Q), np.diag(rule().R)])
    out = np.zeros((REPEATS, len(METHODS), len(CALIBRATED)))
    for i in range(REPEATS):
        logs = rng.standard_normal(8)
        sharpness = np.exp(rng.standard_normal() + rng.standard_normal(RATERS))
        rates = 1 / (1 + np.exp(-(np.log(0.05 / 0.95) + 1.5 * rng.standard_normal(RATERS))))
        w = np.exp(logs - logs.mean())
        first, second = questions(RATERS * EACH, rng)
        who = np.repeat(np.arange(RATERS), EACH)
        Q, R = np.diag(w[:6] * mode[:6]), np.diag(w[6:] * mode[6:])
        cost = np.asarray(phi(pool, Q, R))
        z = sharpness[who] * (cost[second] - cost[first])
        P = rates[who] / 2 + (1 - rates[who]) * 0.5 * (1 + np.tanh(z / 2))
        data = Comparisons(pool, first, second, (rng.uniform(size=P.size) < P).astype(float), who)
        found = fit_raters(data, rule(), **sizes)
        drawn = people_posterior(found, draws=512, key=int(rng.integers(2**31)))
        truths = sharpness[:1], w, rates[:1]
        intervals = [
            (found.sharpness(), found.relative(), found.lapses()),
            [drawn.interval(part) for part in (drawn.sharpness, drawn.relative, drawn.lapse)],
        ]
        for j, k in np.ndindex(out.shape[1:]):
            (_, low, high), t = intervals[j][k], truths[k]
            out[i, j, k] = np.mean((low[: t.size] <= t) & (t <= high[: t.size]))
    return out


def change(
    pool: Trajectory, rng: np.random.Generator
) -> tuple[list[Someone], list[QuadraticCost], np.ndarray]:
    """Learn as `REMEMBERED` says from one who changes, or not, and return the tests' p-values."""
    before, after = (Someone(rng.standard_normal(8), pool) for _ in range(2))
    models, p_values = [], []
    for early in (after, before):
        parts = [together(pool, [who], LONG // 2, rng) for who in (early, after)]
        first, second, labels = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("first", "second", "labels")
        )
        data = Comparisons(pool, first, second, labels, np.zeros(LONG, int))
        models += [
            fit_raters(data, rule()).model,
            fit_raters(data, rule(), weights=forgetting(LONG, HALF_LIFE)).model,
            fit_raters(data.subset(np.arange(LONG // 2, LONG)), rule()).model,
        ]
        key = int(rng.integers(2**31))
        p_values.append(has_changed(data, rule(), simulations=SIMULATIONS, key=key).p_value)
    return [after, after], models, np.array(p_values)


def people_case(*, key: Any, loops: int = 50) -> dict[str, np.ndarray]:
    """Ask several people, and judge every way to learn from their answers.

    Returns
    -------
    dict
        Regrets "rated" (`RATED`), "pooled" (newcomers, `FEW`, `POOLED`) and "remembered"
        (`CHANGES`, `REMEMBERED`); "apart", as estimated from the crowd; "camps" (`CAMPS`,
        `CAMP_COLUMNS`); "covered" (repeats, `METHODS`,
        `CALIBRATED`) by intervals of 90 %; "p_value"
        (`CHANGES`).
    """
    streams = generator(key).spawn(6)
    pool = people_pool(streams[0])
    rater, rated = raters(pool, streams[1])
    new, pooled, apart = newcomers(pool, streams[2])
    changing, remembered, p_value = change(pool, streams[5])
    people = [rater, *new, *changing]
    owners = [rater] * len(rated) + [one for one in new for _ in range(len(FEW) * len(POOLED))]
    owners += [one for one in changing for _ in REMEMBERED]
    models = [one.model for one in people] + rated + pooled + remembered
    x0 = random_states(RADIUS, key=streams[0], shape=(loops,))
    runs = stacked_loops(oscillating_masses(), models, x0, horizon=QUADRATIC_HORIZON, steps=STEPS)
    best = {one: np.asarray(phi(runs[k], one.Q, one.R)).mean() for k, one in enumerate(people)}
    regret = np.array(
        [
            np.asarray(phi(runs[len(people) + k], one.Q, one.R)).mean() / best[one] - 1
            for k, one in enumerate(owners)
        ]
    )
    ends = np.cumsum([len(rated), len(pooled)])
    parts = np.split(regret, ends)
    return {
        "rated": parts[0],
        "pooled": parts[1].reshape(NEWCOMERS, len(FEW), len(POOLED)),
        "remembered": parts[2].reshape(len(CHANGES), len(REMEMBERED)),
        "apart": np.array(apart),
        "camps": camps(pool, streams[3]),
        "covered": calibration(pool, streams[4]),
        "p_value": p_value,
    }
