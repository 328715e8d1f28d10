"""An interview: the plant, what is believed, what was answered, and the next question."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from prefmpc._checks import function, nonnegative, positive_int
from prefmpc._pytree import stacked
from prefmpc.asking.answers import Answer, comparisons_of, label_of, line_of
from prefmpc.asking.belief import Laplace
from prefmpc.asking.criteria import Criterion
from prefmpc.asking.files import Files
from prefmpc.asking.log import Log
from prefmpc.asking.loops import Controller
from prefmpc.asking.making import State, make, state_after
from prefmpc.asking.options import Options
from prefmpc.asking.questions import Question
from prefmpc.asking.regret import Consistency, Regret, consistency_of, regret_of
from prefmpc.asking.sources import Pool
from prefmpc.learning.convex import MapResult, fit_map
from prefmpc.learning.priors import WishartPrior
from prefmpc.models.quadratic import CostModel
from prefmpc.models.separable import SeparableCost
from prefmpc.mpc.steady import SteadyState
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import Preference, asked
from prefmpc.systems.linear import System
from prefmpc.systems.sets import Polyhedron

Choose = Literal["information", "regret", "volume", "eubo", "random"] | Criterion


class Interview(Files):
    """Ask a person for one of two responses at a time until their σ is known well enough.

    The next question is made on purpose: closed loops of a dozen σ that the answers leave
    possible, from a dozen x(0), and of all pairs that start alike the one whose answer tells
    most. Everything is a function of the key and of the answers so far.

    Parameters
    ----------
    system : System
        A `LinearSystem`, or any with a ``controller`` of your own.
    prior : WishartPrior or SeparableCost, optional
        Its mode (its weights) is the centre of what is believed: log weights are Gaussian about
        it. Default: Bryson's rule with what responses from x(0) reach, and the input limits.
    x0 : array (nx,), array (m, nx), or function
        Half-widths of a box, a list of states, or (generator, n) ↦ (n, nx).
    key : JAX key or int
    structure : "diagonal" or "full"
        Whether the weights of two signals may be coupled.
    spread, sharpness, coupling : float
        Standard deviations of each log weight; of what all have in common, in addition; and of
        the couplings, in units of the weights that they couple.
    steps : int
        Length of the closed loops that are shown.
    controller : "lqr", "mpc", or function
        Who makes the loops: saturated LQR, MPC with the constraints, or a function (stack of c σ,
        x0 (m, nx)) ↦ trajectories (c, m).
    reference : SteadyState or list of SteadyState, optional
        What the loops are to reach (see `steady_state`), and σ is about deviations from it; of
        several each question is about one.
    horizon : int
        N of the MPC.
    constraints : Polyhedron, optional
        Over (x, u), kept by the MPC.
    pool : Trajectory (n,), or function, optional
        Recordings to choose questions from instead; or a function generator ↦ Trajectory (n,).
    choose : str or function
        "information" gain, expected "regret" removed, "volume" removed, "eubo" or "random"; or a
        function of `Candidates` that returns a score for each pair.
    lapse : float or "estimate"
        Share of answers that are coin flips: P = ε/2 + (1 − ε)·logistic(σ(second) − σ(first)).
    repeat_every : int
        One in so many questions is an earlier one with its sides swapped; 0: none.
    samples : int
        Draws from the posterior.
    log : path, optional
        A new file, to which each answer is appended before the next question.

    Raises
    ------
    ValueError
        If an argument is out of range, the pool is empty, an x(0) lies outside the constraints,
        or the system cannot be stabilised.
    """

    def __init__(
        self,
        system: System,
        prior: WishartPrior | SeparableCost | None = None,
        *,
        x0: Any = None,
        key: Any,
        structure: Literal["diagonal", "full"] = "diagonal",
        spread: float = 2.0,
        sharpness: float = 2.0,
        coupling: float = 0.5,
        steps: int = 20,
        controller: Controller = "lqr",
        reference: SteadyState | Sequence[SteadyState] | None = None,
        horizon: int = 10,
        constraints: Polyhedron | None = None,
        pool: Pool | None = None,
        choose: Choose = "information",
        lapse: float | Literal["estimate"] = 0.0,
        repeat_every: int = 8,
        samples: int = 150,
        log: str | os.PathLike[str] | None = None,
    ) -> None:
        given = dict(locals())
        del given["self"], given["log"]
        self._options = Options(**given)
        self._belief = self._options.belief()
        self._answers: list[Answer] = []
        self._batch = (0, 1)
        self._cache: dict[tuple[str, int, int], Any] = {}
        self._log: Log | None = None
        if log is not None:
            self.save(log)
            self._log = Log(log, Path(log).stat().st_size)

    # Questions and answers

    def next(self) -> Question:
        """Return the question to ask now: the same one until it is answered or skipped."""
        return self._open()[0]

    def next_batch(self, size: int) -> list[Question]:
        """Return several questions to be answered in their order, without learning in between.

        Each has the largest gain given whatever the answers to those before it are. Of a batch
        that was begun the rest is returned.
        """
        size, n = positive_int("size", size), len(self)
        start, old = self._batch
        if not start < n < start + old:
            self._batch = (n, size)
        return self._open()

    def answer(self, value: Any) -> None:
        """Answer the question of `next`.

        Parameters
        ----------
        value : "first", "second", "skip", None, or a number in [0, 1]
            Which one is preferred; "skip" and None: cannot say, nothing is learned. A number is
            the probability that the first is preferred; 0.5: no difference.

        Raises
        ------
        ValueError
            If it is none of these.
        """
        label = label_of(value)
        answer = Answer(self.next(), label, self._batch)
        if self._log is not None:
            self._log.append(line_of(len(self), answer))
        self._answers.append(answer)

    def answer_with(self, preference: Preference, count: int) -> None:
        """Let a preference Π, a function of two batches of trajectories, answer so many questions.

        NaN is a skipped question.
        """
        function("preference", preference, 2)
        for _ in range(positive_int("count", count)):
            question = self.next()
            pair = stacked([question.first]), stacked([question.second])
            label = float(asked("preference", preference, *pair)[0])
            self.answer(None if np.isnan(label) else label)

    def undo(self) -> Question:
        """Take the last answer (or skip) back, and return its question, which is open again."""
        if not self._answers:
            raise ValueError("undo needs an answer to take back, there is none")
        if self._log is not None:
            self._log.append({"undo": len(self) - 1})
        self._batch = self._answers.pop().batch
        self._cache.clear()
        return self.next()

    def __len__(self) -> int:
        """How many questions were answered or skipped."""
        return len(self._answers)

    # What is known

    @property
    def system(self) -> System:
        """The plant."""
        return self._options.system

    @property
    def questions(self) -> list[Question]:
        """All questions so far, with those that were skipped."""
        return [answer.question for answer in self._answers]

    @property
    def labels(self) -> np.ndarray:
        """P(first is preferred) for each of `questions`, NaN for a skipped one."""
        return np.array([answer.label for answer in self._answers])

    @property
    def comparisons(self) -> Comparisons:
        """The answers as a data set; a ValueError if there are none."""
        return comparisons_of(self._answers)

    @property
    def model(self) -> CostModel:
        """The σ to use now: the mean over the posterior of the weights at equal sharpness.

        It minimises what is expected of the person's own cost, in units in which all that they
        may want counts alike.
        """
        return self._belief.features.model(self._state(len(self)).mean)

    @property
    def posterior(self) -> CostModel:
        """Equally probable σ after the answers, a stack."""
        return self._belief.features.model(self._state(len(self)).w)

    @property
    def certificate(self) -> Laplace:
        """The numbers that say that a local maximum of the posterior density was found."""
        return self._state(len(self)).laplace

    @property
    def result(self) -> MapResult:
        """What `fit_map` makes of the same answers with the Wishart prior of the same mode.

        A convex problem with a certificate. A lapse rate ε smooths the labels: each becomes
        (1 − ε)·label + ε/2, which keeps it convex.
        """
        options, data = self._options, self.comparisons
        if not isinstance(options.prior, WishartPrior):
            raise ValueError("result needs a quadratic σ, got a SeparableCost as prior: use model")
        rate = self.certificate.lapse
        labels = (1 - rate) * data.labels + rate / 2
        data = Comparisons(data.trajectories, data.first, data.second, labels)
        return fit_map(data, options.prior, structure=options.structure)

    @property
    def regret(self) -> Regret:
        """How much worse the controller of `model` may be than the best one for the person."""
        n = len(self)
        return self._once(
            ("regret", n, 0),
            lambda: regret_of(self._state(n).mean, self._state(n).w, self._options),
        )

    @property
    def consistency(self) -> Consistency:
        """What the repeated questions say of the person."""
        return consistency_of(self.questions, self.labels)

    def finished(self, level: float = 0.02, q: float = 0.9, least_gain: float = 0.0) -> str | None:
        """Return why to stop asking, None if there is reason to go on.

        Parameters
        ----------
        level, q : float
            Stop if the regret is at most ``level`` with probability ``q``.
        least_gain : float
            What an answer costs, in nats: stop if the next question is worth less.
        """
        least_gain = nonnegative("least_gain", least_gain, allow_inf=True)
        if self.regret.stop(level, q):
            return f"the regret is at most {100 * level:g} % with probability {q:g}"
        if self.next().gain < least_gain:
            return f"the next question is worth less than {least_gain:g} nats"
        return None

    # Inside

    def _open(self) -> list[Question]:
        """Return the questions of the present batch that are not answered yet."""
        n = len(self)
        start, size = self._batch
        if n >= start + size:
            start, size = self._batch = (n, 1)
        made = self._once(
            ("questions", start, size),
            lambda: make(
                self._answers[:start], size, self._state(start), self._options, self._belief
            ),
        )
        if n >= start + len(made):  # a pool had fewer left
            self._batch = (n, 1)
            return self._open()
        return made[n - start :]

    def _state(self, n: int) -> State:
        return self._once(
            ("state", n, 0), lambda: state_after(self._answers[:n], self._options, self._belief)
        )

    def _once(self, name: tuple[str, int, int], compute: Callable[[], Any]) -> Any:
        """Return what was computed after as many answers, or compute it."""
        if name not in self._cache:
            value = compute()
            kept = (self._batch[0], len(self))
            self._cache = {k: v for k, v in self._cache.items() if k[1] in kept}
            self._cache[name] = value
        return self._cache[name]
