"""Preferences Π over pairs of trajectories: simulated people, and tools to put them together.

A preference is any function of two batches of trajectories that returns P(first is preferred) for
each pair: 1 the first, 0 the second, 0.5 no difference, NaN no answer (such a pair is left out of
a data set).

A trajectory that holds NaN or infinite values is that of a closed loop that failed. All preferences
made here like it less than every other one; between two of them there is no difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import choice, function, instance, nonnegative, positive, real_array
from prefmpc._matrices import psd_matrix
from prefmpc.preferences.trajectories import Trajectory, failed, max_input, phi, settling_time

Preference = Callable[[Trajectory, Trajectory], Any]
"""Π: two batches of trajectories → P(first is preferred) ∈ [0, 1], one number for each pair."""

Criterion = Callable[[Trajectory], Any]
"""A number for each trajectory of a batch (...), smaller is better; infinite is worst."""


class QuadraticPreference:
    """Π_φ: prefers the trajectory with the smaller φ_N(T; Q, R); equal ones give 1.

    Implements eq. (9) of arXiv 2511.22502. A trajectory that is not finite loses against every
    one that is; two such give 0.5.

    Parameters
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        Symmetric positive semidefinite, else a ValueError.
    """

    def __init__(self, Q: ArrayLike, R: ArrayLike) -> None:
        self.Q = psd_matrix("Q", Q, stack=False)
        self.R = psd_matrix("R", R, stack=False)

    def __call__(self, first: Trajectory, second: Trajectory) -> np.ndarray:
        """Return 1.0 where φ(first) ≤ φ(second), else 0.0; shape (...)."""
        check_sides(first, second)
        better = np.asarray(phi(first, self.Q, self.R) <= phi(second, self.Q, self.R))
        return failed_loses(better.astype(np.float64), first, second)


class SettlingTimePreference:
    """Π_κ: prefers the trajectory whose output settles first, ‖y‖₂ ≤ ε from then on.

    Implements the preference of section III-B of arXiv 2511.22502. A trajectory that never settles
    loses against every one that does, and one that is not finite against every one that is (two
    such give 0.5, or NaN with ``ties="drop"``).

    Parameters
    ----------
    epsilon : float
        ε, in the unit of the output.
    tie_break : {"max_input", None}
        "max_input": among equal settling times the smaller max‖u‖∞ wins, and equal ones give 1.
        (The paper's text; its formula has the arguments of Π_u swapped.) None: there is no winner.
    ties : {"half", "drop"}
        What to answer without a winner: 0.5, or NaN, so that the pair is left out of the data.
    """

    def __init__(
        self,
        epsilon: float = 0.1,
        tie_break: Literal["max_input"] | None = "max_input",
        ties: Literal["half", "drop"] = "half",
    ) -> None:
        self.epsilon = nonnegative("epsilon", epsilon)
        choice("tie_break", tie_break, ("max_input", None))
        choice("ties", ties, ("half", "drop"))
        self.tie_break, self.ties = tie_break, ties

    def __call__(self, first: Trajectory, second: Trajectory) -> np.ndarray:
        """Return P(first is preferred) ∈ {0, 0.5, 1}, or NaN for a dropped pair; shape (...)."""
        check_sides(first, second)
        answer = _smaller(
            settling_time(first, self.epsilon), settling_time(second, self.epsilon), 0.0
        )
        if self.tie_break == "max_input":
            spared = np.asarray(max_input(first) <= max_input(second), dtype=np.float64)
            answer = np.where(answer == 0.5, spared, answer)
        answer = failed_loses(answer, first, second)
        return np.where(answer == 0.5, np.nan, answer) if self.ties == "drop" else answer


def by_criterion(criterion: Criterion, tolerance: float = 0.0) -> Preference:
    """Return the preference for the smaller ``criterion``; no difference within ``tolerance``.

    Parameters
    ----------
    criterion : function of a batch of trajectories (...) to numbers (...)
        Smaller is better, infinite is worst. For instance `settling_time` or `max_input`. What it
        says of a trajectory that is not finite does not count: that one is worse than all others.
    tolerance : float
        Differences up to it are not noticed: the answer is 0.5.
    """
    function("criterion", criterion, 1)
    tolerance = nonnegative("tolerance", tolerance)

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        check_sides(first, second)
        answer = _smaller(_judge(criterion, first), _judge(criterion, second), tolerance)
        return failed_loses(answer, first, second)

    return preference


def lexicographic(*preferences: Preference) -> Preference:
    """Return the preference that asks one after another until one of them decides.

    "Settle first, then effort" is
    ``lexicographic(by_criterion(settling_time), by_criterion(max_input))``.
    The next one is asked about the pairs to which all before it answered 0.5 or NaN; if none
    decides, the last answer stands. A trajectory that is not finite loses whatever they say.
    """
    if not preferences:
        raise ValueError("preferences must hold at least one preference, got none")
    for i, preference in enumerate(preferences):
        function(f"preferences[{i}]", preference, 2)

    def combined(first: Trajectory, second: Trajectory) -> np.ndarray:
        check_sides(first, second)
        if not first.batch_shape:
            return combined(*(jax.tree.map(lambda leaf: leaf[None], T) for T in (first, second)))[0]
        answer = asked("preferences[0]", preferences[0], first, second).copy()
        for i, preference in enumerate(preferences[1:], 1):
            undecided = np.nonzero((answer == 0.5) | np.isnan(answer))
            if undecided[0].size:
                pair = first[undecided], second[undecided]
                answer[undecided] = asked(f"preferences[{i}]", preference, *pair)
        return failed_loses(answer, first, second)

    return combined


def erring(preference: Preference, rate: float) -> Preference:
    """Return the preference of somebody who gives the wrong answer with probability ``rate``.

    The result is a probability: P becomes (1 − rate)·P + rate·(1 − P). `Comparisons.sampled`
    turns probabilities into answers. The right answer between one trajectory that is finite and
    one that is not is the finite one.
    """
    function("preference", preference, 2)
    rate = nonnegative("rate", rate)
    if rate > 1:
        raise ValueError(f"rate must lie in [0, 1], got {rate}")

    def noisy(first: Trajectory, second: Trajectory) -> np.ndarray:
        check_sides(first, second)
        answer = failed_loses(asked("preference", preference, first, second), first, second)
        return (1 - rate) * answer + rate * (1 - answer)

    return noisy


def logistic(criterion: Criterion, scale: float) -> Preference:
    """Return the preference of somebody who is unsure where two trajectories are nearly as good.

    P = 1 / (1 + exp((criterion(first) − criterion(second)) / scale)), the response model of
    eq. (4) of arXiv 2511.22502 (Bradley and Terry): at a difference of ``scale`` the better one
    is chosen with 73 %. One that is not finite is never chosen, unless both are not: then P = 0.5.
    """
    function("criterion", criterion, 1)
    scale = positive("scale", scale)

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        check_sides(first, second)
        a, b = _judge(criterion, first), _judge(criterion, second)
        with np.errstate(invalid="ignore", over="ignore"):
            gap = np.where(a == b, 0.0, (a - b) / scale)
        return failed_loses(0.5 * (1 - np.tanh(gap / 2)), first, second)

    return preference


def one_by_one(ask: Callable[[Trajectory, Trajectory], float]) -> Preference:
    """Turn a function that judges one pair at a time into a preference over batches.

    For anything that cannot be vectorised: a lookup, a simulation, a question to a person. About
    a trajectory that is not finite nobody is asked: the other one is preferred.
    """
    function("ask", ask, 2)

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        check_sides(first, second)
        if len(first.batch_shape) != 1:
            raise ValueError(f"first must have one leading dimension, got {first.batch_shape}")
        answers = np.full(len(first), np.nan)
        for i in np.flatnonzero(~(failed(first) | failed(second))):
            answer = real_array("what ask returns", ask(first[i], second[i]), booleans=True)
            if answer.size != 1 or answer < 0 or answer > 1:
                raise ValueError(f"ask must return a number in [0, 1] for each pair, got {answer}")
            answers[i] = answer.item()
        return failed_loses(answers, first, second)

    return preference


def failed_loses(answers: np.ndarray, first: Trajectory, second: Trajectory) -> np.ndarray:
    """Return the answers (...) with those about failed closed loops put right.

    1 where only the second one failed, 0 where only the first did, 0.5 where both have.
    """
    bad, other = failed(first), failed(second)
    return np.where(bad | other, 0.5 * (1.0 - bad + other), answers)


def check_sides(first: Any, second: Any) -> None:
    """Raise a ValueError unless both are trajectories with the same leading shape."""
    for name, value in {"first": first, "second": second}.items():
        instance(name, value, Trajectory)
    if first.batch_shape != second.batch_shape:
        raise ValueError(
            f"second must have the leading shape of first, {first.batch_shape}, "
            f"got {second.batch_shape}"
        )


def asked(name: str, preference: Preference, first: Trajectory, second: Trajectory) -> np.ndarray:
    """Return the answers of a preference, one for each pair, or raise a ValueError."""
    given = real_array(f"what {name} returns", preference(first, second), booleans=True)
    answers = np.asarray(given)
    bad = (answers < 0) | (answers > 1)
    if answers.shape != first.batch_shape or bad.any():
        raise ValueError(
            f"{name} must return one answer in [0, 1] for each pair, shape {first.batch_shape}, "
            f"got shape {answers.shape}"
            + (f" with {answers[bad][0]:g}" if bad.any() else "")
            + "; a function of single pairs needs one_by_one(...)"
        )
    return answers


def _smaller(a: Any, b: Any, tolerance: float) -> np.ndarray:
    """1 where a is smaller, 0 where b is, 0.5 within the tolerance; two infinite ones are equal."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a < b - tolerance, 1.0, np.where(a > b + tolerance, 0.0, 0.5))


def _judge(criterion: Criterion, trajectories: Trajectory) -> np.ndarray:
    values = evaluated("criterion", criterion, trajectories)
    values = np.where(failed(trajectories), np.inf, values)
    if np.isnan(values).any():
        raise ValueError(
            f"criterion must return one number a trajectory, got shape {values.shape} with NaN"
        )
    return values


def evaluated(
    name: str, function: Criterion, trajectories: Trajectory, kind: str = "number"
) -> np.ndarray:
    """Return what a user's function says of each trajectory of a batch (...)."""
    values = np.asarray(real_array(f"what {name} returns", function(trajectories)))
    if values.shape != trajectories.batch_shape:
        raise ValueError(
            f"{name} must return one {kind} a trajectory {trajectories.batch_shape}, "
            f"got shape {values.shape}"
        )
    return values
