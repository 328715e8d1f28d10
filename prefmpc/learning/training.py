"""Learning σ from comparisons by the paper's recipe, all restarts at once."""

from __future__ import annotations

import dataclasses
import time
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax

from prefmpc._checks import (
    choice,
    instance,
    nonnegative,
    positive_int,
    require_x64,
    share,
    to_numpy,
)
from prefmpc._random import generator
from prefmpc._results import FitError, Restarts, warn_of_failure
from prefmpc.learning._lbfgsb import minimise
from prefmpc.learning.losses import (
    PairData,
    cross_entropy,
    logits,
    objective,
    padded_size,
    pair_data,
)
from prefmpc.models.quadratic import CostModel, QuadraticCost, check_model
from prefmpc.preferences.comparisons import Comparisons

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
    comparisons: Comparisons,
    initial: CostModel | None = None,
    *,
    key: Any,
    restarts: int = 20,
    selection: Selection = "validation",
    validation_fraction: float = 0.2,
    test: Comparisons | None = None,
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
    comparisons : Comparisons
    initial : model, optional
        The starts, stacked along a leading axis. Default: ``restarts`` random `QuadraticCost`.
    key : JAX random key
        Draws the starts and the validation split.
    selection : {"validation", "training_loss", "leaky_test_accuracy"}
        How the restart is chosen. "validation" (default) keeps ``validation_fraction`` of the
        pairs out of training and takes the smallest cross-entropy on them. "training_loss" trains
        on all pairs. "leaky_test_accuracy" trains on all pairs and takes the best accuracy on
        ``test``, as the paper does: whatever is then measured on ``test`` is too good.
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
    held = _check_options(comparisons, selection, validation_fraction, test)
    l2, l1, tol = nonnegative("l2", l2), nonnegative("l1", l1), nonnegative("tol", tol)
    learning_rate = nonnegative("learning_rate", learning_rate)
    rng = generator(key)
    starts = _starts(comparisons, initial, restarts, rng)

    n = len(comparisons)
    data = pair_data(starts, comparisons, padded_size(n))
    held_out = np.zeros(0, dtype=int)
    if selection == "validation":
        held_out = rng.permutation(n)[:held]
        weights = data.weights.copy()
        weights[held_out] = 0.0
        data = data._replace(weights=weights)

    settings = (l2, l1, learning_rate, positive_int("max_iterations", max_iterations), tol)
    split_signs = l1 > 0  # |θ| is smooth only where θ is split into its two signs
    out = _train(starts, data, settings, positive_int("adam_steps", adam_steps), split_signs)
    models, loss, accuracy, iterations, error, violation = to_numpy(out)

    finite = np.isfinite(loss)
    for leaf in jax.tree.leaves(models):
        finite &= np.isfinite(leaf).reshape(leaf.shape[0], -1).all(axis=1)
    status = np.full(loss.shape, "converged", dtype="<U14")
    status[~(error <= tol)] = "max_iterations"
    status[~(violation <= BOUND_ROUNDING)] = "out_of_bounds"
    status[~finite] = "not_finite"

    if selection == "validation":
        score = _scores(models, comparisons.subset(held_out), "loss")
    elif selection == "training_loss":
        score = loss
    else:
        assert test is not None
        score = _scores(models, test, "errors")
    result = FitResult(
        models=models,
        chosen=best_restart(score, status, loss),
        selection=selection,
        selection_score=score,
        status=status,
        training_loss=loss,
        training_accuracy=accuracy,
        iterations=iterations,
        error=error,
        bound_violation=violation,
        seconds=time.perf_counter() - began,
    )
    warn_of_failure(result)
    return result


def best_restart(score: Any, status: np.ndarray, loss: np.ndarray) -> int | None:
    """Return the converged restart with the smallest score; equal scores are decided by the loss.

    None if no restart converged to finite weights within the bounds, with a finite score and loss.
    """
    usable = np.flatnonzero((status == "converged") & np.isfinite(score) & np.isfinite(loss))
    ranking = np.lexsort((np.asarray(loss)[usable], np.asarray(score)[usable]))
    return int(usable[ranking[0]]) if usable.size else None


@jax.jit(static_argnums=(3, 4))
def _train(
    starts: Any, data: PairData, settings: tuple[Any, ...], adam_steps: int, split_signs: bool
) -> tuple[Any, ...]:
    l2, l1, learning_rate, max_iterations, tol = settings

    def one(start: Any) -> tuple[Any, ...]:
        lower, upper = start.bounds()
        loss = partial(objective, data=data, l2=l2, l1=l1)
        warm = _projected_adam(loss, start, lower, upper, adam_steps, learning_rate)
        model, iterations, error = minimise(
            partial(objective, data=data, l2=l2),
            warm,
            (lower, upper),
            l1=l1 if split_signs else None,
            max_iterations=max_iterations,
            tol=tol,
        )
        outside = jax.tree.map(
            lambda leaf, low, high: jnp.max(jnp.maximum(low - leaf, leaf - high)),
            model,
            lower,
            upper,
        )
        violation = jnp.maximum(jnp.max(jnp.stack(jax.tree.leaves(outside))), 0.0)
        # A maximum may pass over NaN.
        finite = [jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(model)]
        violation = jnp.where(jnp.stack(finite).all(), violation, jnp.nan)
        # Rounding in the solver's Cauchy point; anything larger stays, and is reported.
        inside = jax.tree.map(jnp.clip, model, lower, upper)
        rounding = violation <= BOUND_ROUNDING
        model = jax.tree.map(lambda a, b: jnp.where(rounding, a, b), inside, model)
        hits = _agreement(logits(model, data), data.labels)
        accuracy = jnp.vdot(data.weights, hits) / jnp.sum(data.weights)
        return model, loss(model), accuracy, iterations, error, violation

    return jax.vmap(one)(starts)


def _projected_adam(
    loss: Any, start: Any, lower: Any, upper: Any, steps: int, learning_rate: Any
) -> Any:
    def step(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        slope = jax.grad(loss)(carry[0])
        return adam_step(*carry, slope, (lower, upper), learning_rate), None

    inside = jax.tree.map(jnp.clip, start, lower, upper)
    carry = inside, adam(learning_rate).init(inside)
    (model, _), _ = jax.lax.scan(step, carry, None, length=steps)
    return model


def adam(learning_rate: Any) -> Any:
    """Return Adam with its usual decay rates."""
    return optax.adam(learning_rate, b1=0.9, b2=0.999)


def adam_step(
    model: Any, memory: Any, slope: Any, bounds: tuple[Any, Any], learning_rate: Any
) -> tuple[Any, Any]:
    """Take one step of Adam, projected onto the bounds; return the model and Adam's memory."""
    updates, memory = adam(learning_rate).update(slope, memory)
    moved = jax.tree.map(jnp.add, model, updates)
    return jax.tree.map(jnp.clip, moved, *bounds), memory


def _agreement(z: Any, labels: Any) -> Any:
    """P(the model's answer is the person's), for log-odds z; equal costs count as "first"."""
    return jnp.where(z >= 0, labels, 1 - labels)


@jax.jit
def _validation(models: Any, data: PairData) -> tuple[Any, Any]:
    def one(model: Any) -> tuple[Any, Any]:
        hits = _agreement(logits(model, data), data.labels)
        errors = 1 - jnp.vdot(data.weights, hits) / jnp.sum(data.weights)
        return cross_entropy(model, data), errors

    return jax.vmap(one)(models)


def _scores(models: Any, comparisons: Comparisons, kind: str) -> np.ndarray:
    data = pair_data(models, comparisons, padded_size(len(comparisons)))
    loss, errors = _validation(models, data)
    return np.asarray(loss if kind == "loss" else errors)


def _starts(
    comparisons: Comparisons, initial: CostModel | None, restarts: int, key: Any
) -> CostModel:
    trajectories, restarts = comparisons.trajectories, positive_int("restarts", restarts)
    if initial is None:
        nx, nu = trajectories.x.shape[-1], trajectories.u.shape[-1]
        return QuadraticCost.random(nx, nu, key=key, shape=(restarts,))
    return check_starts(comparisons, initial)


def check_starts(comparisons: Comparisons, initial: Any) -> CostModel:
    """Return the starts, stacked along one leading axis, or raise a ValueError."""
    if isinstance(initial, QuadraticCost) and not initial.batch_shape:
        initial = jax.tree.map(lambda leaf: leaf[None], initial)
    check_model("initial", initial, "a stack of σ models")
    # The weights of a single network may all have the same first dimension.
    if any(getattr(m, "batch_shape", None) == () for m in getattr(initial, "models", (initial,))):
        raise ValueError("initial must be stacked along one leading axis, got a single model")
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(initial)}
    if len(sizes) != 1 or not all(sizes):
        raise ValueError(f"initial must be stacked along one leading axis, got {sorted(sizes)}")
    one = jax.tree.map(lambda leaf: leaf[0], initial)
    try:
        one(comparisons.trajectories)
    except ValueError as error:
        raise ValueError(f"initial must fit the comparisons: {error}") from None
    return initial


def held_out_count(n: int, fraction: float, advice: str = "") -> int:
    """Return how many of n pairs are kept out of training: at least one, and not all of them."""
    count = max(1, round(fraction * n))
    if count >= n:
        raise ValueError(
            f"comparisons must hold enough pairs to split for validation, got {n}{advice}"
        )
    return count


def _check_options(
    comparisons: Any, selection: str, fraction: float, test: Comparisons | None
) -> int:
    """Return the number of pairs to hold out, or raise a ValueError."""
    instance("comparisons", comparisons, Comparisons)
    if test is not None:
        instance("test", test, Comparisons)
    choice("selection", selection, get_args(Selection))
    fraction = share("validation_fraction", fraction)
    if (test is None) == (selection == "leaky_test_accuracy"):
        raise ValueError(
            'test must be given with selection="leaky_test_accuracy" and only then, '
            f"got selection={selection!r} and test={'None' if test is None else 'a data set'}"
        )
    if selection != "validation":
        return 0
    return held_out_count(len(comparisons), fraction, '; selection="training_loss" needs no split')
