"""Preferences Π over pairs of trajectories: simulated people, and tools to put them together.

A preference is any function of two batches of trajectories that returns P(first is preferred) for
each pair: 1 the first, 0 the second, 0.5 no difference, NaN no answer (such a pair is left out of
a data set).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import function, nonnegative, psd_matrix
from prefmpc.trajectories import Trajectory, max_input, phi, settling_time

Preference = Callable[[Trajectory, Trajectory], Any]
"""Π: two batches of trajectories → P(first is preferred) ∈ [0, 1], one number for each pair."""

Criterion = Callable[[Trajectory], Any]
"""A number for each trajectory of a batch (...), smaller is better; infinite is worst."""


class QuadraticPreference:
    """Π_φ: prefers the trajectory with the smaller φ_N(T; Q, R); equal ones give 1.

    Implements eq. (9) of arXiv 2511.22502.

    Parameters
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        Symmetric positive semidefinite, else a ValueError.
    """

    def __init__(self, Q: ArrayLike, R: ArrayLike) -> None:
        self.Q = psd_matrix("Q", Q)
        self.R = psd_matrix("R", R)

    def __call__(self, first: Trajectory, second: Trajectory) -> np.ndarray:
        """Return 1.0 where φ(first) ≤ φ(second), else 0.0; shape (...)."""
        better = phi(first, self.Q, self.R) <= phi(second, self.Q, self.R)
        return np.asarray(better, dtype=np.float64)


class SettlingTimePreference:
    """Π_κ: prefers the trajectory whose output settles first, ‖y‖₂ ≤ ε from then on.

    Implements the preference of section III-B of arXiv 2511.22502. A trajectory that never settles
    loses against every one that does.

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
        if tie_break not in ("max_input", None):
            raise ValueError(f'tie_break must be "max_input" or None, got {tie_break!r}')
        if ties not in ("half", "drop"):
            raise ValueError(f'ties must be "half" or "drop", got {ties!r}')
        self.tie_break, self.ties = tie_break, ties

    def __call__(self, first: Trajectory, second: Trajectory) -> np.ndarray:
        """Return P(first is preferred) ∈ {0, 0.5, 1}, or NaN for a dropped pair; shape (...)."""
        answer = _smaller(
            settling_time(first, self.epsilon), settling_time(second, self.epsilon), 0.0
        )
        if self.tie_break == "max_input":
            spared = np.asarray(max_input(first) <= max_input(second), dtype=np.float64)
            return np.where(answer == 0.5, spared, answer)
        return np.where(answer == 0.5, np.nan, answer) if self.ties == "drop" else answer


def by_criterion(criterion: Criterion, tolerance: float = 0.0) -> Preference:
    """Return the preference for the smaller ``criterion``; no difference within ``tolerance``.

    Parameters
    ----------
    criterion : function of a batch of trajectories (...) to numbers (...)
        Smaller is better, infinite is worst. For instance `settling_time` or `max_input`.
    tolerance : float
        Differences up to it are not noticed: the answer is 0.5.
    """
    function("criterion", criterion)
    tolerance = nonnegative("tolerance", tolerance)

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        return _smaller(_judge(criterion, first), _judge(criterion, second), tolerance)

    return preference


def lexicographic(*preferences: Preference) -> Preference:
    """Return the preference that asks one after another until one of them decides.

    "Settle first, then effort" is
    ``lexicographic(by_criterion(settling_time), by_criterion(max_input))``.
    The next one is asked about the pairs to which all before it answered 0.5 or NaN; if none
    decides, the last answer stands.
    """
    if not preferences:
        raise ValueError("preferences must hold at least one preference, got none")
    for i, preference in enumerate(preferences):
        function(f"preferences[{i}]", preference)

    def combined(first: Trajectory, second: Trajectory) -> np.ndarray:
        if not first.batch_shape:
            pair = (jax.tree.map(lambda leaf: leaf[None], side) for side in (first, second))
            return combined(*pair)[0]
        answer = np.array(preferences[0](first, second), dtype=np.float64)
        for preference in preferences[1:]:
            undecided = np.nonzero((answer == 0.5) | np.isnan(answer))
            if undecided[0].size:
                answer[undecided] = preference(first[undecided], second[undecided])
        return answer

    return combined


def erring(preference: Preference, rate: float) -> Preference:
    """Return the preference of somebody who gives the wrong answer with probability ``rate``.

    The result is a probability: P becomes (1 − rate)·P + rate·(1 − P). `Comparisons.sampled`
    turns probabilities into answers.
    """
    function("preference", preference)
    if not nonnegative("rate", rate) <= 1:
        raise ValueError(f"rate must lie in [0, 1], got {rate}")

    def noisy(first: Trajectory, second: Trajectory) -> np.ndarray:
        answer = np.asarray(preference(first, second), dtype=np.float64)
        return (1 - rate) * answer + rate * (1 - answer)

    return noisy


def logistic(criterion: Criterion, scale: float) -> Preference:
    """Return the preference of somebody who is unsure where two trajectories are nearly as good.

    P = 1 / (1 + exp((criterion(first) − criterion(second)) / scale)), the response model of
    eq. (4) of arXiv 2511.22502 (Bradley and Terry): at a difference of ``scale`` the better one
    is chosen with 73 %.
    """
    function("criterion", criterion)
    if not nonnegative("scale", scale) > 0:
        raise ValueError(f"scale must be positive, got {scale}")

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        a, b = _judge(criterion, first), _judge(criterion, second)
        with np.errstate(invalid="ignore", over="ignore"):
            gap = np.where(a == b, 0.0, (a - b) / scale)
        return 0.5 * (1 - np.tanh(gap / 2))

    return preference


def one_by_one(ask: Callable[[Trajectory, Trajectory], float]) -> Preference:
    """Turn a function that judges one pair at a time into a preference over batches.

    For anything that cannot be vectorised: a lookup, a simulation, a question to a person.
    """
    function("ask", ask)

    def preference(first: Trajectory, second: Trajectory) -> np.ndarray:
        answers = [ask(first[i], second[i]) for i in range(len(first))]
        try:
            return np.asarray([float(answer) for answer in answers])
        except (TypeError, ValueError) as error:
            raise ValueError(f"ask must return a number for each pair: {error}") from None

    return preference


def _smaller(a: Any, b: Any, tolerance: float) -> np.ndarray:
    """1 where a is smaller, 0 where b is, 0.5 within the tolerance; two infinite ones are equal."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where(a < b - tolerance, 1.0, np.where(a > b + tolerance, 0.0, 0.5))


def _judge(criterion: Criterion, trajectory: Trajectory) -> np.ndarray:
    values = np.asarray(criterion(trajectory), dtype=np.float64)
    if values.shape != trajectory.batch_shape or np.isnan(values).any():
        raise ValueError(
            f"criterion must return one number a trajectory {trajectory.batch_shape}, "
            f"got shape {values.shape}" + (" with NaN" if np.isnan(values).any() else "")
        )
    return values
