"""The desk at which an interview is held: messages of a front end come in, replies go out."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from prefmpc._checks import is_whole
from prefmpc.asking.interview import Interview
from prefmpc.asking.log import to_json
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.trajectories import Trajectory, failed

TRIAL = 3
"""The purpose of the random numbers of a blind test; see `Options.rng`."""

LONGEST = 400
"""At most so many characters of an error are sent: it may quote what came."""

LARGEST = 1e300
"""In the place of an infinite number, which JSON does not have."""


class Desk:
    """What a front end may ask of an interview.

    A message is {id, call, …}; its reply is {reply: id, result} or {reply: id, error}. The calls
    are those of the page's own interviewer. Whoever answers or takes back says how many answers
    he knows of: an answer that comes twice, or to a question that is no longer open, changes
    nothing.

    Parameters
    ----------
    interview : Interview
    weights : list of (name, unit)
        Of the states and inputs.
    level, certain : float
        Enough is known when the regret is at most ``level`` with probability ``certain``.
    most : int
    """

    def __init__(
        self,
        interview: Interview,
        weights: list[dict[str, str]],
        level: float,
        certain: float,
        most: int,
    ) -> None:
        self.interview, self._weights = interview, weights
        self._limits = {"level": level, "certain": certain, "most": most}
        self._calls = {
            "next": self._next,
            "answer": self._answer,
            "undo": self._undo,
            "progress": lambda message: self._progress(),
            "trial": self._trial,
            "log": lambda message: self.interview._text().decode(),
        }

    def reply(self, message: Any) -> dict[str, Any] | None:
        """Return the reply to a message, None if it is none: it comes from a browser."""
        name = message.get("id") if isinstance(message, dict) else None
        if not isinstance(name, str) or not 0 < len(name) <= 64:
            return None
        try:
            call = message.get("call")
            if not isinstance(call, str) or call not in self._calls:
                raise ValueError(f"call must be one of {tuple(self._calls)}, got {call!r:.50}")
            return {"reply": name, "result": self._calls[call](message)}
        except Exception as error:  # whatever it is, the person is told
            said = (
                str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            )
            return {"reply": name, "error": said[:LONGEST]}

    def _next(self, message: dict[str, Any]) -> Any:
        question = self.interview.next()
        return to_json(vars(question))

    def _answer(self, message: dict[str, Any]) -> Any:
        value = message.get("value")
        if not isinstance(value, str | int | float):
            raise ValueError(f"value must be an answer, got {value!r:.50}")
        if _known(message) == len(self.interview):
            self.interview.answer(value)
        return self._progress()

    def _undo(self, message: dict[str, Any]) -> Any:
        if _known(message) == len(self.interview):
            self.interview.undo()
        return self._progress()

    def _progress(self) -> dict[str, Any]:
        interview, consistency = self.interview, self.interview.consistency
        regret = interview.regret
        bound, median = regret.bound(self._limits["certain"]), regret.quantile(0.5)
        repeats = consistency.repeats
        return {
            "count": len(interview),
            "bound": min(bound, LARGEST),
            "median": min(median, LARGEST),
            "enough": bool(bound <= self._limits["level"]),
            **self._limits,
            "weights": _shares(interview, self._weights),
            "consistency": {
                "repeats": repeats,
                "equal": round(repeats * consistency.equal, 9) if repeats else 0,
            },
        }

    def _trial(self, message: dict[str, Any]) -> Any:
        """Return pairs of closed loops, one of the present σ and one of the prior's centre."""
        count: Any = message.get("count")
        if not is_whole(count) or not 1 <= count <= 100:
            raise ValueError(f"count must be a whole number from 1 to 100, got {count!r:.50}")
        options, n = self.interview._options, len(self.interview)
        weights = np.stack([self.interview._state(n).mean, options.features.chart.diagonal * 1.0])
        rng = options.rng(n, TRIAL)
        runs = options.loops(options.features.model(weights), options.starts(count, rng))
        pairs = []
        for i in np.flatnonzero(~failed(runs).any(axis=0)):
            learned = "first" if rng.uniform() < 0.5 else "second"
            sides = (0, 1) if learned == "first" else (1, 0)
            first, second = (to_json(_one(runs, side, int(i))) for side in sides)
            pairs.append({"first": first, "second": second, "learned": learned})
        if not pairs:
            raise ValueError("no closed loop of the blind test came to its end")
        return pairs


def _known(message: dict[str, Any]) -> int:
    number: Any = message.get("number")
    if not is_whole(number):
        raise ValueError(f"number must be a whole number, got {number!r:.50}")
    return int(number)


def _one(runs: Trajectory, side: int, i: int) -> Trajectory:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[side, i], runs)


def _shares(interview: Interview, names: list[dict[str, str]]) -> list[dict[str, Any]]:
    """Return each weight of a quadratic σ beside the prior's, with an interval of 90 %.

    Relative to the common factor of all, which no controller depends on.
    """
    model, prior = interview.model, interview._options.prior
    if not isinstance(model, QuadraticCost):
        return []
    weights, centre = _diagonals(model), _diagonals(prior)
    own, everyone = _relative(weights / centre), _relative(_diagonals(interview.posterior) / centre)
    low, high = np.exp(np.quantile(everyone, (0.05, 0.95), axis=0))
    return [
        {
            **name,
            "weight": float(weights[i]),
            "ratio": float(np.exp(own[i])),
            "low": float(low[i]),
            "high": float(high[i]),
        }
        for i, name in enumerate(names)
    ]


def _diagonals(model: Any) -> np.ndarray:
    parts = [np.diagonal(np.asarray(M), axis1=-2, axis2=-1) for M in (model.Q, model.R)]
    return np.concatenate(parts, axis=-1)


def _relative(weights: np.ndarray) -> np.ndarray:
    logs = np.log(weights)
    return logs - logs.mean(axis=-1, keepdims=True)
