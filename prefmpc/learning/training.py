"""Learning σ from comparisons by the paper's recipe, all restarts in one compiled call."""

from __future__ import annotations

import dataclasses
import time
import warnings
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._checks import (
    choice,
    nonnegative,
    positive_int,
    require_x64,
    share,
    to_numpy,
    traced,
)
from prefmpc._random import generator
from prefmpc._results import FitError, Restarts, warn_of_failure
from prefmpc.learning._lbfgsb import minimise
from prefmpc.learning._starts import check_starts, finite_models, held_out_count, projected_adam
from prefmpc.learning.answer_losses import Task
from prefmpc.learning.losses import accuracy, cross_entropy, objective
from prefmpc.models.quadratic import CostModel, QuadraticCost
from prefmpc.preferences.answers import Answers, check_data
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.recordings import batches

Selection = Literal["validation", "training_loss", "leaky_test_accuracy"]
Status = Literal["converged", "max_iterations", "out_of_bounds", "not_finite"]

BOUND_ROUNDING = 1e-9
"""A weight this little outside its bounds is clipped; further outside, the restart is refused."""


@dataclasses.dataclass(frozen=True)
class FitResult(Restarts):
    """What came of every restart, and which one was chosen.

    Attributes
    ----------
    models : the trained models, stacked along a leading axis of length ``restarts``.
    chosen : int or None
        Index of the chosen restart; None if no restart may be used.
    selection : how it was chosen; ``selection_score`` (restarts,) is what was compared, smaller
        is better.
    status : array of str (restarts,)
        "converged", "max_iterations", "out_of_bounds" or "not_finite".
    training_loss : array (restarts,)
        The objective of eq. (6) on the pairs that were trained on, regularisation included.
    training_accuracy : array (restarts,)
        Share of those pairs whose answer the model gives.
    iterations : int array (restarts,)
        L-BFGS-B iterations.
    error : array (restarts,)
        Largest entry of the projected gradient where the solver stopped.
    bound_violation : array (restarts,)
        Largest amount by which the solver left a weight outside its bounds.
    seconds : float
        Wall time, compilation included if there was one.
    thresholds : dict of arrays (restarts, ...)
        What was learned beside σ from `Answers`, by name: see `fit_map`. Empty for plain pairs.
    """

    NAME = "fit"

    models: Any
    chosen: int | None
    selection: Selection
    selection_score: np.ndarray
    status: np.ndarray
    training_loss: np.ndarray
    training_accuracy: np.ndarray
    iterations: np.ndarray
    error: np.ndarray
    bound_violation: np.ndarray
    seconds: float
    thresholds: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        counts = {name: int((self.status == name).sum()) for name in get_args(Status)}
        seen = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        how = f"restart {self.chosen} chosen by {self.selection}" if self.success else "none usable"
        return f"{self.status.size} restarts: {seen}; {how}"

    def _error(self) -> FitError:
        return FitError(
            f"{self.message}. The models as they stopped are in .models, the reasons in .status"
        )


def fit(
    comparisons: Comparisons | Answers,
    initial: CostModel | None = None,
    *,
    key: Any,
    restarts: int = 20,
    selection: Selection = "validation",
    validation_fraction: float = 0.2,
    test: Comparisons | Answers | None = None,
    l2: float = 1e-6,
    l1: float = 0.0,
    adam_steps: int = 200,
    learning_rate: float = 0.01,
    max_iterations: int = 1000,
    tol: float = 1e-3,
) -> FitResult:
    """Train σ on comparisons by the recipe of arXiv 2511.22502, section III.

    Adam (decay rates 0.9 and 0.999), projected onto the bounds after each step, then L-BFGS-B
    with history 10; every restart from its own random start, all restarts in one compiled call.
    Minimises eq. (6): the mean cross-entropy plus ``l2``·‖θ‖² plus ``l1``·‖θ‖₁.

    Parameters
    ----------
    comparisons : Comparisons or Answers
        Thresholds of `Answers` (see `fit_map`) are learned along and belong to θ. The mean is over
        all choices: a ranking is as many as it has places but the last.
    initial : model, optional
        The starts, stacked along a leading axis. Default: ``restarts`` random `QuadraticCost`.
    key : JAX random key or int
        Draws the starts and the validation split.
    selection : {"validation", "training_loss", "leaky_test_accuracy"}
        How the restart is chosen. "validation" (default) keeps ``validation_fraction`` of the
        pairs out of training and takes the smallest cross-entropy on them, or, where they are too
        few for that, warns and does as "training_loss", which trains on all pairs.
        "leaky_test_accuracy" trains on all pairs and takes the best accuracy on ``test``, as the
        paper does: whatever is then measured on ``test`` is too good.
    tol : float
        L-BFGS-B stops when no entry of the projected gradient is larger.

    Returns
    -------
    FitResult

    Raises
    ------
    ValueError
        If an argument is out of range, or the starts do not fit the data.
    """
    require_x64()
    began = time.perf_counter()
    check_data("comparisons", comparisons)
    n = len(comparisons)
    selection, held = _selection(n, selection, validation_fraction, test)
    l2, l1, tol = nonnegative("l2", l2), nonnegative("l1", l1), nonnegative("tol", tol)
    learning_rate = nonnegative("learning_rate", learning_rate)
    rng, restarts = generator(key), positive_int("restarts", restarts)
    if initial is None:
        pool = batches(comparisons.trajectories)[0]
        nx, nu = pool.x.shape[-1], pool.u.shape[-1]
        starts: Any = QuadraticCost.random(nx, nu, key=rng, shape=(restarts,))
    else:
        starts = check_starts(comparisons, initial)
    settings = (l2, l1, learning_rate, positive_int("max_iterations", max_iterations), tol)
    adam_steps = positive_int("adam_steps", adam_steps)

    task = Task.of(starts, comparisons, test)
    data = task.data(comparisons)
    held_out = rng.permutation(n)[:held] if held else np.zeros(0, dtype=int)
    data.hold_out(held_out)
    split_signs = l1 > 0  # |θ| is smooth only where θ is split into its two signs
    with traced("initial"):
        out = _train(task.starts, data, settings, adam_steps, split_signs)
    trained = _Trained(*to_numpy(out))
    status, loss = _status(trained, tol), trained.training_loss
    if selection == "training_loss":
        score = loss
    else:
        judges = comparisons.subset(held_out) if test is None else test
        losses, errors = _scores(trained.models, task.data(judges))
        score = np.asarray(losses if test is None else errors)
    models, thresholds = task.split(trained.models)
    result = FitResult(
        **trained._replace(models=models)._asdict(),
        chosen=best_restart(score, status, loss),
        selection=selection,
        selection_score=score,
        status=status,
        seconds=time.perf_counter() - began,
        thresholds=thresholds,
    )
    warn_of_failure(result)
    return result


def _selection(n: int, selection: Selection, fraction: float, test: Any) -> tuple[Selection, int]:
    """Return how to choose among the restarts, and how many pairs are kept out for that."""
    if test is not None:
        check_data("test", test)
    choice("selection", selection, get_args(Selection))
    fraction = share("validation_fraction", fraction)
    if (test is None) == (selection == "leaky_test_accuracy"):
        raise ValueError(
            'test must be given with selection="leaky_test_accuracy" and only then, '
            f"got selection={selection!r} and test={'None' if test is None else 'a data set'}"
        )
    held = held_out_count(n, fraction) if selection == "validation" else 0
    if selection == "validation" and not held:
        warnings.warn(
            f"fit: {n} comparison(s) are too few to keep some out of training for validation; "
            "the restart is chosen by training loss",
            RuntimeWarning,
            stacklevel=3,
        )
        selection = "training_loss"
    return selection, held


class _Trained(NamedTuple):
    """What `FitResult` says of every restart."""

    models: Any
    training_loss: Any
    training_accuracy: Any
    iterations: Any
    error: Any
    bound_violation: Any


def _status(trained: _Trained, tol: float) -> np.ndarray:
    status = np.full(trained.error.shape, "converged", dtype="<U14")
    status[~(trained.error <= tol)] = "max_iterations"
    status[~(trained.bound_violation <= BOUND_ROUNDING)] = "out_of_bounds"
    status[~(np.isfinite(trained.training_loss) & finite_models(trained.models))] = "not_finite"
    return status


def best_restart(score: Any, status: np.ndarray, loss: np.ndarray) -> int | None:
    """Return the converged restart with the smallest score; equal scores are decided by the loss.

    None if no restart converged to finite weights within the bounds, with a finite score and loss.
    """
    usable = np.flatnonzero((status == "converged") & np.isfinite(score) & np.isfinite(loss))
    ranking = np.lexsort((np.asarray(loss)[usable], np.asarray(score)[usable]))
    return int(usable[ranking[0]]) if usable.size else None


@jax.jit(static_argnums=(3, 4))
def _train(
    starts: Any, data: Any, settings: tuple[Any, ...], adam_steps: int, split_signs: bool
) -> _Trained:
    l2, l1, learning_rate, max_iterations, tol = settings

    def one(start: Any) -> _Trained:
        bounds = start.bounds()
        loss = partial(objective, data=data, l2=l2, l1=l1)
        model, iterations, error = minimise(
            partial(objective, data=data, l2=l2),
            projected_adam(loss, start, bounds, adam_steps, learning_rate),
            bounds,
            l1=l1 if split_signs else None,
            max_iterations=max_iterations,
            tol=tol,
        )
        outside = jax.tree.map(
            lambda leaf, low, high: jnp.max(jnp.maximum(low - leaf, leaf - high), initial=0.0),
            model,
            *bounds,
        )
        violation = jnp.maximum(jnp.max(jnp.stack(jax.tree.leaves(outside))), 0.0)
        # A maximum may pass over NaN.
        finite = [jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(model)]
        violation = jnp.where(jnp.stack(finite).all(), violation, jnp.nan)
        # Rounding in the solver's Cauchy point; anything larger stays, and is reported.
        rounding = violation <= BOUND_ROUNDING
        inside = jax.tree.map(jnp.clip, model, *bounds)
        model = jax.tree.map(lambda a, b: jnp.where(rounding, a, b), inside, model)
        return _Trained(model, loss(model), accuracy(model, data), iterations, error, violation)

    # One after another: the solver's branches are then branches, compiled in half the time, and
    # no restart waits for the slowest.
    trained: _Trained = jax.lax.map(one, starts)
    return trained


@jax.jit
def _scores(models: Any, data: Any) -> tuple[Any, Any]:
    """Return the cross-entropy and the share of wrong answers of each model (m,)."""

    def one(model: Any) -> tuple[Any, Any]:
        return cross_entropy(model, data), 1 - accuracy(model, data)

    return jax.vmap(one)(models)
