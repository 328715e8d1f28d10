"""Training σ models that are not convex: many restarts, stopped where held-out answers suffer."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from prefmpc._checks import flag, nonnegative, positive_int, require_x64, share, to_numpy
from prefmpc._random import generator
from prefmpc._results import FitError, Restarts, warn_of_failure
from prefmpc.learning._starts import (
    adam_step,
    begin_adam,
    check_starts,
    finite_models,
    held_out_count,
)
from prefmpc.learning.answer_losses import Task
from prefmpc.learning.losses import cross_entropy, objective
from prefmpc.models.quadratic import CostModel
from prefmpc.preferences.answers import Answers, check_data
from prefmpc.preferences.comparisons import Comparisons

CHECK_EVERY = 10


@dataclasses.dataclass(frozen=True)
class NetworkFit(Restarts):
    """Restarts of `fit_network`, each at its best moment, and which one was chosen.

    Attributes
    ----------
    models : the models with the smallest validation loss of each restart, stacked.
    chosen : int or None
        The restart with the smallest validation loss; None if none stayed finite.
    validation_loss, training_loss : array (checks, restarts)
        Cross-entropy of held-out and of trained answers, at every check; NaN after the end of a
        restart.
    epochs : int array (checks,)
        Passes over the data until each check.
    best : int array (restarts,)
        The check at which each restart was best.
    status : array of str (restarts,)
        "stopped": the validation loss had not fallen for ``patience`` checks; "max_epochs": it
        was still falling; "not_finite": a loss or a weight left the numbers, and the restart is
        not chosen.
    seconds : float
    thresholds : dict of arrays (restarts, ...)
        What was learned beside σ from `Answers`, by name: see `fit_map`. Empty for plain pairs.
    """

    NAME = "fit_network"

    models: Any
    chosen: int | None
    validation_loss: np.ndarray
    training_loss: np.ndarray
    epochs: np.ndarray
    best: np.ndarray
    status: np.ndarray
    seconds: float
    thresholds: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        names, counts = np.unique(self.status, return_counts=True)
        seen = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        if self.chosen is None:
            return f"{self.status.size} restarts: {seen}; none usable"
        loss = self.validation_loss[self.best[self.chosen], self.chosen]
        return (
            f"{self.status.size} restarts: {seen}; restart {self.chosen} chosen, "
            f"validation loss {loss:.4g}"
        )

    def _error(self) -> FitError:
        return FitError(f"{self.message}. The models as they were are in .models")


def fit_network(
    comparisons: Comparisons | Answers,
    initial: CostModel,
    *,
    key: Any,
    validation: Comparisons | Answers | None = None,
    validation_fraction: float = 0.2,
    l2: float = 1e-4,
    learning_rate: float = 0.01,
    max_epochs: int = 2000,
    patience: int = 20,
    batch_size: int = 1024,
    progress: bool = False,
) -> NetworkFit:
    """Train σ by Adam from many starts at once, and keep each where held-out answers are best.

    Minimises eq. (6) of arXiv 2511.22502 on the answers that are not held out. Every ten epochs
    the held-out ones are scored; a restart ends when their cross-entropy has not fallen for
    ``patience`` of these checks. Weights are projected onto the model's bounds after each step.

    Parameters
    ----------
    comparisons : Comparisons or Answers
        As in `fit`.
    initial : model
        The starts, stacked along a leading axis, for instance ``MLPCost.random(..., shape=(8,))``.
    key : JAX random key or int
        Draws the split and the mini-batches.
    validation : Comparisons or Answers, optional
        Held-out answers of your own, for instance about other trajectories. Default: a random
        share of ``validation_fraction`` of the pairs.
    l2 : float
        Weight of ‖θ‖².
    learning_rate : float
        Of Adam, with decay rates 0.9 and 0.999.
    max_epochs, patience : int
    batch_size : int
        Data sets with more pairs, or choices, are passed over in random mini-batches, as few and as
        equal as this size allows: in an epoch each of them comes up once.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If an argument is out of range, or the starts do not fit the data.
    """
    require_x64()
    began = time.perf_counter()
    check_data("comparisons", comparisons)
    starts = check_starts(comparisons, initial)
    settings = nonnegative("l2", l2), nonnegative("learning_rate", learning_rate)
    rounds = -(-positive_int("max_epochs", max_epochs) // CHECK_EVERY)
    patience, batch_size = (
        positive_int("patience", patience),
        positive_int("batch_size", batch_size),
    )
    rng, progress = generator(key), flag("progress", progress)
    validation_fraction = share("validation_fraction", validation_fraction)
    training, held_out = _split(comparisons, validation, validation_fraction, rng)
    task = Task.of(starts, training, held_out)
    data, test = task.data(training), task.data(held_out, 128)
    count = int(data.weights.sum())

    record = _Record.of(_begin(task.starts))
    for _ in _bar(rounds, progress):
        batches = _batches(count, data.weights.size, batch_size, rng)
        state, losses = _advance(record.state, data, test, settings, batches)
        record.add(state, losses, patience)
        if not record.running.any():
            break
    result = record.result(task, time.perf_counter() - began)
    warn_of_failure(result)
    return result


@dataclasses.dataclass
class _Record:
    """Where training stands, and the best moment of each restart (m,)."""

    state: Any
    best: Any
    lowest: np.ndarray
    best_at: np.ndarray
    running: np.ndarray
    finite: np.ndarray
    losses: list[np.ndarray] = dataclasses.field(default_factory=list)
    """Of each check (2, m): of trained and of held-out answers, NaN after the end."""

    @classmethod
    def of(cls, state: Any) -> _Record:
        """Begin with the starts."""
        models = to_numpy(state[0])
        m = len(jax.tree.leaves(models)[0])
        yes = np.ones(m, dtype=bool)
        return cls(state, models, np.full(m, np.inf), np.zeros(m, dtype=int), yes, yes)

    def add(self, state: Any, losses: Any, patience: int) -> None:
        """Take down a check, and end the restarts that are not finite or no longer get better."""
        self.state, models, check = state, to_numpy(state[0]), len(self.losses)
        self.losses.append(np.where(self.running, to_numpy(losses), np.nan))
        trained, held = self.losses[-1]
        # A weight that is NaN need not show in the losses: a ReLU may pass over it.
        fine = np.isfinite(held) & np.isfinite(trained) & finite_models(models)
        self.finite = self.finite & (fine | ~self.running)
        better = self.running & self.finite & (held < self.lowest)
        self.best = jax.tree.map(lambda new, old: _where(better, new, old), models, self.best)
        self.lowest = np.where(better, held, self.lowest)
        self.best_at = np.where(better, check, self.best_at)
        self.running = self.running & self.finite & (check - self.best_at < patience)

    def result(self, task: Task, seconds: float) -> NetworkFit:
        """Return what came of it."""
        usable = self.finite & np.isfinite(self.lowest)
        status = np.where(self.running, "max_epochs", "stopped").astype("<U10")
        status[~usable] = "not_finite"
        trained, held = np.stack(self.losses, axis=1)
        models, thresholds = task.split(self.best)
        return NetworkFit(
            models=models,
            chosen=int(np.argmin(np.where(usable, self.lowest, np.inf))) if usable.any() else None,
            validation_loss=held,
            training_loss=trained,
            epochs=CHECK_EVERY * np.arange(1, len(held) + 1),
            best=self.best_at,
            status=status,
            seconds=seconds,
            thresholds=thresholds,
        )


def _split(
    comparisons: Any, validation: Any, fraction: float, rng: np.random.Generator
) -> tuple[Any, Any]:
    if validation is not None:
        check_data("validation", validation)
        return comparisons, validation
    held = held_out_count(len(comparisons), fraction)
    if not held:
        raise ValueError(
            f"comparisons must hold enough pairs to split for validation, got {len(comparisons)}"
        )
    order = rng.permutation(len(comparisons))
    return comparisons.subset(order[held:]), comparisons.subset(order[:held])


def _bar(rounds: int, progress: bool) -> Any:
    if not progress:
        return range(rounds)
    from tqdm import tqdm

    return tqdm(range(rounds), desc=f"{CHECK_EVERY} epochs each")


def _where(mask: np.ndarray, new: Any, old: Any) -> Any:
    return np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _batches(n: int, padded: int, size: int, rng: np.random.Generator) -> Any:
    """Return ten epochs of mini-batches (rows, size) and how many rows to take of them.

    None for all pairs at once. What is free in a row, and the rows that are not taken, hold the
    index ``padded``, behind the last pair: one shape, and one compilation, for many data sets.
    """
    if n <= size:
        return None
    count = -(-n // size)
    rows = np.full((CHECK_EVERY * -(-padded // size), size), padded)
    for epoch in range(CHECK_EVERY):
        parts = np.array_split(rng.permutation(n), count)
        for row, part in zip(rows[epoch * count :], parts, strict=False):
            row[: part.size] = part
    return rows, CHECK_EVERY * count


@jax.jit
def _begin(starts: Any) -> tuple[Any, Any]:
    return jax.vmap(lambda start: begin_adam(start, start.bounds()))(starts)


@jax.jit
def _advance(state: Any, data: Any, test: Any, settings: Any, batches: Any) -> tuple[Any, Any]:
    """Train for ten epochs; return the state, and the losses of trained and held-out answers."""
    l2, learning_rate = settings

    def one(model: Any, memory: Any) -> Any:
        bounds = model.bounds()

        def step(k: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            part = data if batches is None else data.part(batches[0][k])
            slope = jax.grad(objective)(carry[0], part, l2)
            return adam_step(*carry, slope, bounds, learning_rate)

        steps = CHECK_EVERY if batches is None else batches[1]
        model, memory = jax.lax.fori_loop(0, steps, step, (model, memory))
        return (model, memory), (cross_entropy(model, data), cross_entropy(model, test))

    return jax.vmap(one)(*state)
