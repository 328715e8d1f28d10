"""The network that need not be convex by hand; gradients of all σ models by finite differences."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import (
    Comparisons,
    ICNNCost,
    MLPCost,
    QuadraticCost,
    SignalCost,
    SumCost,
    Trajectory,
    by_criterion,
)
from prefmpc.learning.losses import cross_entropy, pair_data

KEY = jax.random.key(2800)
RNG = np.random.default_rng(0)
SCALE = np.array([2.0, 0.5, 1.0])  # two states, one input
T = Trajectory(RNG.normal(size=(5, 4, 2)), RNG.normal(size=(5, 3, 1)))


def by_hand(model, x, u):
    """One trajectory, layer by layer."""
    stages = [np.concatenate([x[k], u[k]]) / SCALE for k in range(len(u))]
    total = 0.0
    for v in stages if model.over == "stage" else [np.concatenate(stages)]:
        z = v
        for W, b in zip(model.W, model.b, strict=True):
            a = W @ z + b
            kinds = {"tanh": np.tanh(a), "relu": a * (a > 0), "softplus": np.log1p(np.exp(a))}
            z = kinds[model.activation]
        total += model.c @ z + model.floor * v @ v
    return total


@pytest.mark.parametrize("activation", ["relu", "tanh", "softplus"])
@pytest.mark.parametrize("steps", [None, 3])
def test_an_mlp_by_hand(activation, steps):
    options = {"widths": (4, 3), "steps": steps, "activation": activation, "floor": 0.3}
    model = MLPCost.random(SCALE, key=KEY, **options)
    expected = [by_hand(model, T.x[i], T.u[i]) for i in range(5)]
    np.testing.assert_allclose(model(T), expected, rtol=1e-12)
    assert model(T[2]) == pytest.approx(expected[2])
    np.testing.assert_allclose(jax.jit(lambda m, t: m(t))(model, T), expected, rtol=1e-12)
    np.testing.assert_allclose(model.score(model.features(T)), expected, rtol=1e-12)


def test_a_network_sees_deviations_from_a_set_point():
    model = MLPCost.random(SCALE, key=KEY, widths=(4,))
    x_r, u_r = np.array([1.0, -2.0]), np.array([0.5])
    moved = Trajectory(T.x + x_r, T.u + u_r, x_r=x_r, u_r=u_r)
    np.testing.assert_allclose(model(moved), model(T), rtol=1e-12)
    assert np.abs(model(Trajectory(moved.x, moved.u)) - model(T)).max() > 0.1


def test_stacks_draws_and_bounds():
    stack = MLPCost.random(SCALE, key=KEY, widths=(5, 2), shape=(3,))
    assert stack.batch_shape == (3,)
    assert [W.shape for W in stack.W] == [(3, 5, 3), (3, 2, 5)]
    assert stack[1].batch_shape == ()
    np.testing.assert_array_equal(stack[1].W[0], stack.W[0][1])
    again = MLPCost.random(SCALE, key=KEY, widths=(5, 2), shape=(3,))
    np.testing.assert_array_equal(again.c, stack.c)
    assert np.abs(stack.c[0] - stack.c[1]).max() > 1e-3
    low, high = stack.bounds()
    assert all(np.isneginf(leaf).all() for leaf in jax.tree.leaves(low))
    assert all(np.isposinf(leaf).all() for leaf in jax.tree.leaves(high))
    assert jax.tree.structure(low) == jax.tree.structure(stack)
    with pytest.raises(ValueError, match="must be a single one"):
        stack(T)
    with pytest.raises(IndexError, match="no batch dimension"):
        _ = stack[0][0]
    assert not MLPCost.linear_in_features


def test_the_loss_of_a_network_by_hand():
    model = MLPCost.random(SCALE, key=KEY, widths=(4,))
    person = by_criterion(lambda t: np.asarray(t.x)[..., 0].max(-1))
    data = Comparisons.random(T, person, 12, key=KEY)
    gap = model(T)[data.second] - model(T)[data.first]
    expected = np.mean(np.logaddexp(0, gap) - data.labels * gap)
    assert cross_entropy(model, pair_data(model, data, 16)) == pytest.approx(expected)


# ---- gradients of every σ model, against central differences ----

QUADRATIC = QuadraticCost([[2.0, 0.5], [0.5, 1.0]], [[0.7]])


def _models():
    models = {"quadratic": QUADRATIC}
    for activation in ("relu", "tanh", "softplus"):
        for steps in (None, 3):
            options = {"steps": steps, "activation": activation, "floor": 0.1}
            models[f"MLP {activation} {steps}"] = MLPCost.random(
                SCALE, key=KEY, widths=(4, 3), **options
            )
    for activation in ("relu", "softplus", "squared_relu"):
        for more in ({}, {"steps": 3}, {"even": True}):
            models[f"ICNN {activation} {more}"] = ICNNCost.random(
                SCALE, key=KEY, widths=(4, 3), activation=activation, floor=0.1, **more
            )
    models["sum"] = SumCost([QUADRATIC, models["MLP tanh None"]], [0.5, 2.0])
    wide = {3: QuadraticCost(np.diag([1.0, 2, 3]), [[1.0]]), 2: QUADRATIC}
    for signals in ("x", "y", ("y", "du"), ("dy", "du"), ("x", "x_r"), ("x", "u_r"), "x0"):
        sizes = {"x": 2, "y": 1, "du": 1, "dy": 1, "x_r": 2, "u_r": 1, "x0": 5}
        n = sum(sizes[s] for s in ([signals] if isinstance(signals, str) else signals))
        inner = wide.get(n) or QuadraticCost(np.diag(1.0 + np.arange(n)), [[1.0]])
        models[f"signals {signals}"] = SignalCost(inner, signals)
    models["network of signals"] = SignalCost(
        MLPCost.random([1.0, 1, 1], key=KEY, widths=(4,)), ["y", "du"]
    )
    return models


MODELS = _models()
AT = Trajectory(
    T.x[0],
    T.u[0],
    T.x[0, :-1, :1] - T.x[0, :-1, 1:],
    x_r=[0.3, -0.1],
    u_r=[0.2],
    y_r=[0.4],
    u_before=[0.5],
)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_are_those_of_finite_differences(name):
    model = MODELS[name]

    @jax.jit
    def both(point):
        return jax.value_and_grad(lambda p: p[0](p[1]))(point)

    point = (model, AT)
    leaves, tree = jax.tree.flatten(point)
    slope = jax.tree.leaves(both(point)[1])
    rng = np.random.default_rng(1)
    moving = [leaf for leaf in leaves if np.size(leaf)]
    assert len(moving) >= 8  # weights and the parts of the trajectory
    for i, leaf in enumerate(leaves):
        direction = rng.normal(size=np.shape(leaf))

        def value(step, i=i, direction=direction):
            moved = [a + step * direction if j == i else a for j, a in enumerate(leaves)]
            return float(both(jax.tree.unflatten(tree, moved))[0])

        estimate = (value(1e-6) - value(-1e-6)) / 2e-6
        ours = float((slope[i] * direction).sum())
        assert ours == pytest.approx(estimate, rel=1e-6, abs=1e-7), (name, i)


ONE = {"W": [np.ones((2, 3))], "b": [np.zeros(2)], "c": np.ones(2)}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: MLPCost(**ONE, scale=SCALE, activation="sine"), "activation must be one of"),
        (lambda: MLPCost(**ONE, scale=SCALE, over="time"), "over must be .stage. or .trajectory."),
        (lambda: MLPCost(**ONE, scale=SCALE, over="peak"), "over must be .stage. or .trajectory."),
        (lambda: MLPCost(**ONE, scale=-SCALE), "scale must hold positive numbers"),
        (lambda: MLPCost(**ONE, scale=[1.0, 1]), "columns, the entries of v, got 3"),
        (lambda: MLPCost(**ONE, scale=[1.0, 1], over="trajectory"), "must have a multiple of 2"),
        (lambda: MLPCost(**ONE, scale=SCALE, floor=-1), "floor must be finite and at least 0"),
        (lambda: MLPCost([], [], [1.0], scale=SCALE), "W and b must hold the same number of"),
        (lambda: MLPCost(**{**ONE, "b": []}, scale=SCALE), "W and b must hold the same number"),
        (lambda: MLPCost(**{**ONE, "c": np.ones(3)}, scale=SCALE), r"c must have shape \(2,\)"),
        (lambda: MLPCost(**{**ONE, "b": [0.0]}, scale=SCALE), r"W\[0\] must have shape"),
        (
            lambda: MLPCost(**{**ONE, "W": [np.full((2, 3), np.nan)]}, scale=SCALE),
            r"W\[0\] must be",
        ),
        (lambda: MLPCost(**ONE, scale=SCALE)(Trajectory(T.x[..., :1], T.u)), "must have 3 states"),
        (lambda: MLPCost.random(SCALE, key=KEY, steps=4)(T), "trajectory.u must have shape"),
        (lambda: MLPCost.random(SCALE, key=KEY, widths=()), "widths must name at least one"),
        (lambda: MLPCost.random(SCALE, key=KEY, widths=(0,)), r"widths\[0\] must be a whole"),
        (lambda: MLPCost.random(SCALE, key=KEY, steps=0), "steps must be a whole number"),
        (lambda: MLPCost.random([0.0, 1], key=KEY), "scale must hold positive numbers"),
        (lambda: MLPCost(**ONE, scale=SCALE)("T"), "trajectory must be a Trajectory"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
