"""The σ of one curve for each signal: its formula, its slopes, its learning, and wrong input."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefmpc import (
    Comparisons,
    FitError,
    SeparableCost,
    SignalCost,
    Trajectory,
    accuracy,
    fit,
)

SCALE = np.array([0.5, 2.0, 1.0])


def some(seed: int, count: int = 30) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(rng.normal(size=(count, 6, 2)), rng.normal(size=(count, 5, 1)))


def model(seed: int = 0) -> SeparableCost:
    return SeparableCost(np.random.default_rng(seed).uniform(0, 1, (3, 3)), scale=SCALE)


def test_one_step_by_hand():
    T = Trajectory([[1.0, 0.0], [9.0, 9.0]], [[0.0]])
    cost = SeparableCost([[7.0, 1, 1], [0.5, 1, 1], [0.25, 1, 1]], scale=SCALE)
    # v = 1 / 0.5 = 2, and x_N = (9, 9) does not count.
    assert np.isclose(cost(T), (np.sqrt(1 + 14**2) - 1) + 0.5 * 4 + 0.25 * 16)


@given(st.integers(0, 10_000))
def test_even_convex_and_least_at_the_set_point(seed):
    a, b = some(seed, 1)[0], some(seed + 1, 1)[0]
    sigma = model(seed)
    middle = Trajectory((a.x + b.x) / 2, (a.u + b.u) / 2)
    mirrored = Trajectory(-np.asarray(a.x), -np.asarray(a.u))
    assert sigma(middle) <= (sigma(a) + sigma(b)) / 2 + 1e-9
    assert np.isclose(sigma(mirrored), sigma(a))
    assert sigma(Trajectory(np.zeros((6, 2)), np.zeros((5, 1)))) == 0


def test_the_curves_add_up_to_the_cost_and_deviations_count():
    T, sigma = some(3)[0], model(1)
    v = np.concatenate([T.x[:-1], T.u], axis=1)
    assert np.isclose(sum(sigma.curve(i, v[:, i]).sum() for i in range(3)), sigma(T))
    moved = Trajectory(T.x + 1.0, T.u + 2.0, x_r=[1.0, 1.0], u_r=[2.0])
    assert np.isclose(sigma(moved), sigma(T))


def test_slopes_agree_with_finite_differences():
    T, sigma = some(4)[0], model(2)
    slope = jax.grad(lambda x: sigma(Trajectory(x, T.u)))(T.x)
    step = np.zeros_like(T.x)
    step[2, 1] = 1e-6
    up, down = (sigma(Trajectory(T.x + sign * step, T.u)) for sign in (1, -1))
    assert np.isclose(slope[2, 1], (up - down) / 2e-6, rtol=1e-6)


def test_learning_is_convex_every_start_ends_in_the_same_weights():
    pool = some(5, 200)
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 200, (2, 300))
    sigma = model(3)
    labels = (sigma(pool[first]) <= sigma(pool[second])).astype(float)
    data = Comparisons(pool, first, second, labels)
    starts = SeparableCost(rng.uniform(0.01, 1, (3, 3, 3)), scale=SCALE)
    options = {"selection": "training_loss", "l2": 1e-3, "tol": 1e-6}
    result = fit(data, starts, key=jax.random.key(0), **options)
    assert np.ptp(result.training_loss) < 1e-8
    assert np.ptp(result.models.c, axis=0).max() < 1e-3
    assert accuracy(result.model, data) > 0.95
    assert (result.model.c >= 1e-4).all()
    assert isinstance(SignalCost(result.model, "x")(pool), np.ndarray)


def test_a_stack_scores_like_its_parts():
    stack = SeparableCost(np.random.default_rng(1).uniform(0, 1, (4, 3, 3)), scale=SCALE)
    T = some(6, 4)
    assert stack.batch_shape == (4,)
    assert np.allclose(stack(T), [stack[i](T[i]) for i in range(4)])
    with pytest.raises(IndexError, match="index must lie"):
        stack[4]
    with pytest.raises(IndexError, match="no batch"):
        stack[0][0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: SeparableCost(np.ones((2, 3)), scale=SCALE), "c must have shape"),
        (lambda: SeparableCost(-np.ones((3, 3)), scale=SCALE), "c must not be negative"),
        (lambda: SeparableCost(np.full((3, 3), np.nan), scale=SCALE), "c must be finite"),
        (lambda: SeparableCost(np.ones((3, 3)), scale=[1.0, 0, 1]), "scale must hold positive"),
        (lambda: model().curve(3, [1.0]), "signal must lie in"),
        (lambda: model().curve(0, [np.nan]), "values must be finite"),
        (lambda: model()("T"), "trajectory must be a Trajectory"),
        (lambda: model()(Trajectory(np.ones((2, 1)), np.ones((1, 1)))), "3 signals, got 2"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_not_even_one_usable_restart_is_an_error():
    pool = some(7, 20)
    data = Comparisons(pool, [0, 2], [1, 3], [1.0, 0.0])
    start = SeparableCost.start(SCALE, shape=(1,))
    with pytest.warns(RuntimeWarning, match="none usable"):
        result = fit(
            data,
            start,
            key=jax.random.key(0),
            selection="training_loss",
            max_iterations=1,
            adam_steps=1,
            tol=0.0,
        )
    with pytest.raises(FitError):
        _ = result.model
