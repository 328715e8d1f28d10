"""The next questions, as a function of the key and of the answers so far."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from prefmpc._checks import real_array
from prefmpc._pytree import stacked
from prefmpc.asking.answers import Answer
from prefmpc.asking.belief import Belief, Laplace
from prefmpc.asking.criteria import CRITERIA
from prefmpc.asking.loops import CONTROLLERS, STATES
from prefmpc.asking.options import Options
from prefmpc.asking.questions import (
    Candidates,
    Question,
    information,
    informative_batch,
    probability,
)
from prefmpc.asking.sources import Shown, check_pool, loops_shown, pool_shown
from prefmpc.preferences.trajectories import Trajectory

RECENT = 4
"""A question is repeated when at least so many others came in between."""


class State(NamedTuple):
    """The belief after some answers."""

    laplace: Laplace
    w: np.ndarray
    """(S, p): samples of the weights."""
    lapse: np.ndarray
    """(S,)"""
    mean: np.ndarray
    """(p,): the weights to use now."""


def state_after(answers: list[Answer], options: Options, belief: Belief) -> State:
    """Return the belief after the answers: what was skipped has no likelihood."""
    known = [a for a in answers if not np.isnan(a.label)]
    gap, labels = gaps(known, belief), np.array([a.label for a in known])
    laplace = belief.fit(gap, labels)
    if not laplace.success:
        raise RuntimeError(
            f"no local maximum of the posterior was found: decrement {laplace.decrement:.1e}, "
            f"least curvature {laplace.curvature:.1e}"
        )
    rng = options.rng(len(answers), 0)
    eta, lapse = belief.draws(laplace, gap, labels, options.samples, rng)
    chart = belief.chart
    return State(laplace, chart.weights(eta), lapse, chart.mean_weights(eta))


def gaps(answers: list[Answer], belief: Belief) -> np.ndarray:
    """Return features of the second trajectories minus those of the first (n, p)."""
    if not answers:
        return np.zeros((0, belief.p))
    questions = [a.question for a in answers]
    first, second = stacked([q.first for q in questions]), stacked([q.second for q in questions])
    return belief.features(second) - belief.features(first)


def make(
    answers: list[Answer], size: int, state: State, options: Options, belief: Belief
) -> list[Question]:
    """Return the next ``size`` questions, to be asked without learning in between."""
    n = len(answers)
    rng = options.rng(n, 1)
    again = _to_repeat(answers, n, size, options, rng)
    fresh = _fresh(answers, size - len(again), state, options, belief, rng)
    out = []
    for number in range(n, n + size):
        if number in again:
            out.append(_repeated(answers, number, again[number], state, belief))
        elif fresh:
            out.append(_numbered(fresh.pop(0), number))
    if len(out) < size and not out:
        raise ValueError("pool must hold a pair that was not asked about yet, all of them were")
    return out


def _to_repeat(
    answers: list[Answer], n: int, size: int, options: Options, rng: np.random.Generator
) -> dict[int, int]:
    """Return which of the next questions repeat which of the answered ones."""
    every = options.repeat_every
    if not every:
        return {}
    done = {a.question.repeats for a in answers}
    free = [
        i
        for i, a in enumerate(answers[: max(n - RECENT, 0)])
        if not np.isnan(a.label) and not a.question.repeated and i not in done
    ]
    due = [number for number in range(n, n + size) if number % every == every - 1]
    count = min(len(due), len(free))
    chosen = rng.permutation(len(free))[:count]
    return {number: free[i] for number, i in zip(due, chosen, strict=False)}


def _repeated(
    answers: list[Answer], number: int, original: int, state: State, belief: Belief
) -> Question:
    old = answers[original]
    z = state.w @ -gaps([old], belief).T
    question = _question(
        old.question.second, old.question.first, probability(z, state.lapse)[:, 0], number
    )
    return _numbered(question, number, original)


def _question(first: Trajectory, second: Trajectory, P: np.ndarray, number: int) -> Question:
    return Question(
        first=first,
        second=second,
        gain=float(information(P[:, None])[0]),
        sure=float(np.maximum(P, 1 - P).mean()),
        probability=float(P.mean()),
        number=number,
    )


def _numbered(question: Question, number: int, repeats: int | None = None) -> Question:
    values = {**vars(question), "number": number, "repeats": repeats}
    return Question(**values)


def _fresh(
    answers: list[Answer],
    size: int,
    state: State,
    options: Options,
    belief: Belief,
    rng: np.random.Generator,
) -> list[Question]:
    """Return new questions, the best first."""
    if size == 0:
        return []
    candidates, allowed = _candidates(answers, state, options, belief, rng)
    if options.choose == "information":
        chosen = informative_batch(candidates.P, allowed, size)
    else:
        chosen = _best(candidates, allowed, size, options)
    swap = rng.uniform(size=len(chosen)) < 0.5
    out = []
    for pair, other_way in zip(chosen, swap, strict=True):
        sides = candidates.first[pair], candidates.second[pair]
        P = candidates.P[:, pair]
        if other_way:
            sides, P = sides[::-1], 1 - P
        first, second = (candidates.trajectories[int(i)] for i in sides)
        out.append(_question(first, second, P, 0))
    return out


def _candidates(
    answers: list[Answer],
    state: State,
    options: Options,
    belief: Belief,
    rng: np.random.Generator,
) -> tuple[Candidates, np.ndarray]:
    """Return the candidates, and which of the pairs (n,) may be asked."""
    shown = _shown(state, options, belief, rng)
    features = belief.features(shown.trajectories)
    first, second = shown.pairs
    costs = state.w @ features.T
    P = probability(costs[:, second] - costs[:, first], state.lapse)
    gap = features[second] - features[first]
    allowed = (np.abs(gap) > 1e-9 * np.abs(features[first])).any(axis=1)
    if options.pool is not None and answers:
        size = np.abs(gap).max(axis=0)
        for old in gaps(answers, belief):
            for sign in (1, -1):
                allowed &= (np.abs(gap - sign * old) > 1e-12 * size).any(axis=1)
    parts = shown.trajectories, features, shown.start, shown.source, first, second
    return Candidates(*parts, costs, P, rng), allowed


def _shown(state: State, options: Options, belief: Belief, rng: np.random.Generator) -> Shown:
    if options.pool is not None:
        pool = check_pool(options.pool(rng)) if callable(options.pool) else options.pool
        return pool_shown(pool, rng)
    x0 = options.starts(STATES, rng)
    models = belief.features.model(state.w[:CONTROLLERS])
    return loops_shown(options.loops, models, x0, rng)


def _best(candidates: Candidates, allowed: np.ndarray, size: int, options: Options) -> list[int]:
    """Return the allowed pairs with the largest scores; no trajectory twice in one batch."""
    criterion: Any = options.choose if callable(options.choose) else CRITERIA[options.choose]
    scores = np.array(real_array("what choose returns", criterion(candidates)))
    if scores.shape != allowed.shape or np.isnan(scores).any():
        raise ValueError(
            f"choose must return one number for each pair {allowed.shape}, got {scores.shape}"
        )
    chosen: list[int] = []
    allowed = allowed.copy()
    while len(chosen) < size and allowed.any():
        best = int(np.argmax(np.where(allowed, scores, -np.inf)))
        chosen.append(best)
        for side in (candidates.first[best], candidates.second[best]):
            allowed &= (candidates.first != side) & (candidates.second != side)
    return chosen
