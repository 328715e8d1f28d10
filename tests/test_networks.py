"""Networks as σ: by hand, by finite differences, convex whatever the weights, and trainable."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prefmpc import (
    Comparisons,
    ICNNCost,
    Polyhedron,
    QuadraticCost,
    SumCost,
    Trajectory,
    accuracy,
    bryson,
    by_criterion,
    fit,
    fit_map,
    lqr_pool,
    oscillating_masses,
    soft_constraints,
)
from prefmpc.learning.losses import cross_entropy, pair_data
from studies import RADIUS

RNG = np.random.default_rng(0)
SCALE = np.array([2.0, 0.5, 1.0])  # two states, one input
T = Trajectory(RNG.normal(size=(5, 4, 2)), RNG.normal(size=(5, 3, 1)))
POOL = lqr_pool(
    oscillating_masses(), 40, 10, key=jax.random.key(2500), radius=RADIUS, saturate=False
)


def by_hand(model, x, u):
    """One trajectory, unit by unit."""
    stages = [np.concatenate([x[k], u[k]]) / SCALE for k in range(len(u))]
    inputs = stages if model.over == "stage" else [np.concatenate(stages)]
    total = 0.0
    for v in inputs:
        z = np.zeros(0)
        for i, (V, b) in enumerate(zip(model.V, model.b, strict=True)):
            before = V @ v + b + (model.U[i - 1] @ z if i else 0)
            positive = np.maximum(before, 0)
            z = {
                "relu": positive,
                "squared_relu": positive**2,
                "softplus": np.logaddexp(before, 0),
            }[model.activation]
        total += z @ model.c + model.floor * v @ v
    return total


@pytest.mark.parametrize("activation", ["relu", "softplus", "squared_relu"])
@pytest.mark.parametrize("steps", [None, 3])
def test_an_icnn_by_hand(activation, steps):
    model = ICNNCost.random(
        SCALE,
        key=jax.random.key(1),
        widths=(4, 3, 2),
        steps=steps,
        activation=activation,
        floor=0.3,
    )
    expected = [by_hand(model, T.x[i], T.u[i]) for i in range(5)]
    np.testing.assert_allclose(model(T), expected, rtol=1e-12)
    assert model(T[2]) == pytest.approx(expected[2])
    np.testing.assert_allclose(jax.jit(lambda m, t: m(t))(model, T), expected, rtol=1e-12)


def test_gradients_are_those_of_finite_differences():
    model = ICNNCost.random(SCALE, key=jax.random.key(2), widths=(4, 3), floor=0.1)
    features = jnp.asarray(model.features(T[0]))
    slope = jax.grad(lambda m: m.score(features))(model)
    for name in ("V", "b", "U"):
        for i, leaf in enumerate(getattr(model, name)):
            index = tuple(RNG.integers(0, n) for n in leaf.shape)

            def moved(step, name=name, i=i, index=index):
                leaves = {k: [a.copy() for a in getattr(model, k)] for k in ("V", "b", "U")}
                leaves[name][i][index] += step
                other = ICNNCost(**leaves, c=model.c, scale=SCALE, floor=0.1)
                return float(other(T[0]))

            estimate = (moved(1e-5) - moved(-1e-5)) / 2e-5
            assert getattr(slope, name)[i][index] == pytest.approx(estimate, rel=1e-6, abs=1e-9)


@settings(max_examples=60)
@given(
    st.integers(0, 10_000),
    st.sampled_from(["relu", "softplus", "squared_relu"]),
    st.sampled_from([None, 3]),
    st.booleans(),
    st.floats(0, 1),
)
def test_convex_whatever_the_weights_within_the_bounds(seed, activation, steps, bias, mix):
    rng = np.random.default_rng(seed)
    options = {"steps": steps, "activation": activation, "bias": bias}
    start = ICNNCost.random(SCALE, key=rng, widths=(5, 4), **options)
    low, high = start.bounds()
    wild = jax.tree.map(lambda leaf: leaf + 3 * rng.normal(size=leaf.shape), start)
    model = jax.tree.map(np.clip, wild, low, high)
    a, b = (Trajectory(5 * rng.normal(size=(4, 2)), 5 * rng.normal(size=(3, 1))) for _ in "ab")
    between = jax.tree.map(lambda p, q: mix * p + (1 - mix) * q, a, b)
    chord = mix * model(a) + (1 - mix) * model(b)
    assert model(between) <= chord + 1e-9 * (1 + abs(chord))
    if not bias and activation != "softplus":  # the set point is kept
        assert model(jax.tree.map(np.zeros_like, a)) == 0 <= model(a)


def test_a_floor_makes_it_strictly_convex():
    flat = ICNNCost([np.zeros((1, 3))], [np.zeros(1)], [], [0.0], scale=SCALE)
    model = ICNNCost(flat.V, flat.b, flat.U, flat.c, scale=SCALE, floor=2.0)
    v = np.concatenate([T.x[:, :-1], T.u], axis=-1) / SCALE
    np.testing.assert_allclose(flat(T), 0)
    np.testing.assert_allclose(model(T), 2 * (v**2).sum((1, 2)))


def test_training_keeps_it_convex_and_learns_what_a_quadratic_cannot():
    def overshoot(trajectory):  # only to one side
        return np.maximum(np.asarray(trajectory.x)[..., 0], 0).sum(-1)

    person = by_criterion(overshoot)
    data = Comparisons.random(POOL, person, 150, key=jax.random.key(2501))
    fresh = lqr_pool(
        oscillating_masses(), 40, 10, key=jax.random.key(2502), radius=RADIUS, saturate=False
    )
    test = Comparisons.random(fresh, person, 300, key=jax.random.key(2503))
    scale = np.concatenate([np.abs(POOL.x).max((0, 1)), [1, 1]])
    kind = {"activation": "squared_relu", "bias": False}
    starts = ICNNCost.random(scale, key=jax.random.key(2504), widths=(6,), shape=(2,), **kind)
    options = {"key": jax.random.key(0), "selection": "training_loss", "max_iterations": 60}
    result = fit(data, starts, tol=1e-1, l2=1e-4, adam_steps=400, **options)
    model = result.model
    assert min(leaf.min() for leaf in (*model.U, model.c)) >= 0
    assert not model.b[0].any()
    quadratic = fit_map(data, bryson(scale[:6], [1, 1])).model
    assert accuracy(model, test) > accuracy(quadratic, test) + 0.05


def test_a_stack_of_networks_and_its_members():
    stack = ICNNCost.random(SCALE, key=jax.random.key(3), widths=(4,), shape=(3,))
    assert stack.batch_shape == (3,)
    assert stack[1].batch_shape == ()
    np.testing.assert_array_equal(stack[1].V[0], stack.V[0][1])
    with pytest.raises(IndexError, match="no batch dimension"):
        _ = stack[0][0]
    with pytest.raises(ValueError, match="must be a single one"):
        stack(T)


def test_a_sum_by_hand_and_trained():
    quadratic = QuadraticCost(np.eye(2), [[1.0]])
    network = ICNNCost.random(SCALE, key=jax.random.key(4), widths=(4,))
    total = SumCost([quadratic, network], [0.5, 2])
    np.testing.assert_allclose(total(T), 0.5 * quadratic(T) + 2 * network(T), rtol=1e-12)
    np.testing.assert_allclose(total.score(total.features(T)), total(T), rtol=1e-12)
    low, high = total.bounds()
    assert low.models[1].c.min() == 0
    assert np.isinf(high.models[0].theta_Q).all()
    data = pair_data(total, Comparisons(T, [0, 1, 2], [1, 2, 3], [1.0, 0.0, 1.0]))
    z = np.asarray(total(T))
    expected = np.mean([np.logaddexp(0, s * (z[i + 1] - z[i])) for i, s in enumerate((-1, 1, -1))])
    assert cross_entropy(total, data) == pytest.approx(expected)
    slope = jax.grad(cross_entropy)(total, data)
    assert slope.weights == (0.5, 2)
    assert np.abs(slope.models[0].theta_R).max() > 0 < np.abs(slope.models[1].c).max()


def test_soft_constraints_by_hand():
    penalty = soft_constraints(Polyhedron([[1.0, 0, 0], [0, 0, -2.0]], [0.5, 1.0]), [10.0, 1.0])
    over = np.maximum(T.x[:, :-1, 0] - 0.5, 0).sum(1)
    under = np.maximum(-2 * T.u[:, :, 0] - 1, 0).sum(1)
    assert over.max() > 0 < under.max()
    np.testing.assert_allclose(penalty(T), 10 * over + under, rtol=1e-12)


WALL = Polyhedron([[1.0, 0, 0]], [0.5])
ONE = {"V": [np.ones((2, 3))], "b": [np.zeros(2)], "U": [], "c": np.ones(2)}
TWO = {"V": [np.ones((2, 3))] * 2, "b": [np.zeros(2)] * 2, "U": [np.ones((2, 2))], "c": np.ones(2)}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ICNNCost(**ONE, scale=SCALE, activation="tanh"), "activation must be one of"),
        (
            lambda: ICNNCost(**{**ONE, "b": [np.ones(2)]}, scale=SCALE, bias=False),
            r"b\[0\] must be zero for a network without bias",
        ),
        (lambda: ICNNCost(**ONE, scale=SCALE, over="time"), "over must be .stage. or .trajectory."),
        (lambda: ICNNCost(**ONE, scale=-SCALE), "scale must hold positive numbers"),
        (lambda: ICNNCost(**ONE, scale=SCALE, floor=-1), "floor must be finite and at least 0"),
        (lambda: ICNNCost(**{**ONE, "c": -np.ones(2)}, scale=SCALE), "c must not be negative"),
        (lambda: ICNNCost(**{**ONE, "c": np.ones(3)}, scale=SCALE), r"c must have shape \(2,\)"),
        (lambda: ICNNCost(**{**ONE, "U": [1.0]}, scale=SCALE), "must hold L, L and L − 1 layers"),
        (
            lambda: ICNNCost(**{**TWO, "U": [-np.ones((2, 2))]}, scale=SCALE),
            r"U\[0\] must not be negative, else σ is not convex",
        ),
        (lambda: ICNNCost(**ONE, scale=[1.0]), "V must have 1 columns"),
        (lambda: ICNNCost(**ONE, scale=[1.0, 1], over="trajectory"), "V must have a multiple of 2"),
        (lambda: ICNNCost(**ONE, scale=SCALE)(POOL), "trajectory must have 3 states and inputs"),
        (
            lambda: ICNNCost.random(SCALE, key=jax.random.key(0), steps=4)(T),
            "trajectory.u must have shape",
        ),
        (lambda: ICNNCost.random(SCALE, key=jax.random.key(0), widths=()), "widths must name at"),
        (lambda: soft_constraints(1, 1.0), "constraints must be a Polyhedron, got int"),
        (lambda: soft_constraints(WALL, -1.0), "weight must be one or 1 nonnegative numbers"),
        (lambda: soft_constraints(WALL, [1.0, 1.0]), "weight must be one or 1 nonnegative"),
        (
            lambda: soft_constraints(Polyhedron(np.zeros((0, 3)), np.zeros(0)), 1.0),
            "constraints must have at least one row",
        ),
        (lambda: SumCost([]), "models must be a sequence of at least one"),
        (lambda: SumCost([1]), r"models\[0\] must be a σ model, got int"),
        (lambda: SumCost([ICNNCost(**ONE, scale=SCALE)], [1, 2]), "weights must be 1 numbers"),
        (lambda: SumCost([ICNNCost(**ONE, scale=SCALE)], [-1]), r"weights\[0\] must be finite"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
