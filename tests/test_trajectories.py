"""Trajectories, φ, settling times and rollouts against arithmetic done by hand."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prefmpc import (
    LinearSystem,
    NonlinearSystem,
    QuadraticCost,
    Trajectory,
    max_input,
    phi,
    rollout,
    second_moments,
    settling_text,
    settling_time,
)
from prefmpc._pytree import bypass_init

# Two steps, two states, one input.
X = np.array([[1.0, 2.0], [3.0, -1.0], [100.0, 100.0]])
U = np.array([[2.0], [-1.0]])
Q = np.array([[2.0, 1.0], [1.0, 3.0]])
R = np.array([[5.0]])
# x_0ᵀQx_0 = 2·1² + 2·1·(1·2) + 3·2² = 2 + 4 + 12 = 18
# x_1ᵀQx_1 = 2·3² + 2·1·(3·−1) + 3·1² = 18 − 6 + 3 = 15
# u_0ᵀRu_0 = 5·2² = 20, u_1ᵀRu_1 = 5·1² = 5, and x_2 does not count: φ = 18 + 15 + 20 + 5 = 58
PHI = 58.0


@pytest.mark.parametrize("cost", [QuadraticCost(Q, R), lambda T: phi(T, Q, R)], ids=["σ", "φ"])
def test_two_steps_by_hand(cost):
    assert float(cost(Trajectory(X, U))) == pytest.approx(PHI, rel=1e-14)
    other = X.copy()
    other[-1] = -7.0
    assert float(cost(Trajectory(other, U))) == float(cost(Trajectory(X, U)))
    assert cost(Trajectory(np.stack([X, 2 * X]), np.stack([U, 2 * U]))) == pytest.approx(
        [PHI, 4 * PHI], rel=1e-14
    )


def test_second_moments_by_hand():
    moments = second_moments(Trajectory(X, U))
    np.testing.assert_array_equal(moments.Sx, [[1 + 9, 2 - 3], [2 - 3, 4 + 1]])
    np.testing.assert_array_equal(moments.Su, [[4 + 1]])


@st.composite
def trajectories_and_weights(draw):
    """Anything finite, with semidefinite weights."""
    batch, N, nx, nu = draw(st.sampled_from([(1, 1, 1, 1), (2, 3, 4, 2), (3, 2, 1, 3)]))
    entries = st.floats(-10, 10)
    x = draw(arrays(float, (batch, N + 1, nx), elements=entries))
    u = draw(arrays(float, (batch, N, nu), elements=entries))
    root_Q = draw(arrays(float, (nx, nx), elements=entries))
    root_R = draw(arrays(float, (nu, nu), elements=entries))
    return Trajectory(x, u), root_Q @ root_Q.T, root_R @ root_R.T


@given(trajectories_and_weights())
def test_phi_is_linear_in_the_second_moments(case):
    T, Q, R = case
    moments = second_moments(T)
    inner = np.einsum("ij,bij->b", Q, moments.Sx) + np.einsum("ij,bij->b", R, moments.Su)
    plain = [
        sum(x @ Q @ x for x in states[:-1]) + sum(u @ R @ u for u in inputs)
        for states, inputs in zip(T.x, T.u, strict=True)
    ]
    scale = 1 + np.abs(plain).max()
    np.testing.assert_allclose(inner, plain, atol=1e-12 * scale)
    np.testing.assert_allclose(phi(T, Q, R), plain, atol=1e-12 * scale)


def test_a_trajectory_is_a_frozen_pytree_with_batches():
    T = Trajectory(np.stack([X, -X, 2 * X]), np.stack([U, -U, 2 * U]))
    assert (len(T), T.horizon, T.batch_shape) == (3, 2, (3,))
    np.testing.assert_array_equal(T.y, T.x[:, :-1])
    np.testing.assert_array_equal(T[1].x, -X)
    assert T[[2, 0]].batch_shape == (2,)
    assert float(jax.jit(lambda T: phi(T, Q, R))(T[0])) == pytest.approx(PHI)
    np.testing.assert_allclose(jax.vmap(lambda T: phi(T, Q, R))(T), [58, 58, 232])
    with pytest.raises(dataclasses.FrozenInstanceError):
        T.x = X
    with pytest.raises(IndexError, match="no batch dimension"):
        T[0][0]
    with pytest.raises(TypeError, match=r"its number of steps is \.horizon"):
        len(T[0])


def test_lists_are_welcome():
    assert Trajectory([[1], [2]], [[3]], [[4]]).y.item() == 4


PLANT = LinearSystem([[1, 1], [0, 1]], [[0], [1]], [[1, 0]], dt=1)


def test_rollout_by_hand():
    # x⁺ = (x₁ + x₂, x₂ + u) with u = −x₁/2 from (2, 0): u_0 = −1, x_1 = (2, −1), u_1 = −1,
    # x_2 = (1, −2).
    by_gain = rollout(PLANT, [2, 0], [[0.5, 0.0]], 2)
    by_function = rollout(PLANT, [2, 0], lambda x: -0.5 * x[:1], 2)
    for T in (by_gain, by_function):
        np.testing.assert_array_equal(T.x, [[2, 0], [2, -1], [1, -2]])
        np.testing.assert_array_equal(T.u, [[-1], [-1]])
        np.testing.assert_array_equal(T.y, [[2], [2]])


def test_rollout_applies_the_input_limits_on_demand():
    # As above with −0.6 ≤ u ≤ 0.25: −1 becomes −0.6, and x_1 = (2, −0.6), x_2 = (1.4, −1.2);
    # from (−2, 0) the input is 0.25.
    limits = {"u_min": -0.6, "u_max": 0.25}
    plant = LinearSystem([[1, 1], [0, 1]], [[0], [1]], [[1, 0]], dt=1, **limits)
    same = NonlinearSystem(plant.step, plant.output, nx=2, nu=1, dt=1, **limits)
    for law in ([[0.5, 0.0]], lambda x: -0.5 * x[:1]):
        for system in (plant, same):
            T = rollout(system, [[2, 0], [-2, 0]], law, 2, saturate=True)
            np.testing.assert_allclose(T.x[0], [[2, 0], [2, -0.6], [1.4, -1.2]], atol=1e-15)
            np.testing.assert_array_equal(T.u, [[[-0.6], [-0.6]], [[0.25], [0.25]]])
            np.testing.assert_array_equal(rollout(system, [2, 0], law, 2).u, [[-1], [-1]])


def test_rollout_of_a_batch_with_a_gain_each():
    x0, K = np.array([[2.0, 0], [2.0, 0]]), np.array([[[0.5, 0]], [[0.0, 0]]])
    T = rollout(PLANT, x0, K, 2)
    np.testing.assert_array_equal(T.x[0], [[2, 0], [2, -1], [1, -2]])
    np.testing.assert_array_equal(T.x[1], [[2, 0]] * 3)


def settles(*y, epsilon=0.1):
    """κ of a single output."""
    return settling_time(np.array(y, float)[:, None], epsilon)


def test_settling_times_by_hand():
    assert settles(0, 0, 0) == 0
    assert settles(1, 0, 0) == 1  # outside at first only
    assert settles(0, 1, 0) == 2
    assert settles(1, -1, 0) == 2
    assert settles(1, 0, 1, 0, 0) == 3  # it comes back, and leaves once more
    assert settles(1, 0, 1, 0, 1) == np.inf
    assert settles(0, 0, 1) == np.inf  # outside at last only
    assert settles(1, 1, 1) == np.inf
    assert settles(0) == 0
    assert settles(1) == np.inf
    assert settles(1, 0.1, -0.1, epsilon=0.1) == 1  # the border belongs to the ball
    assert settles(1, 0.1, np.nextafter(0.1, 1), epsilon=0.1) == np.inf
    assert settles(1, 0, 0, epsilon=0) == 1


def test_settling_is_about_the_length_of_the_output():
    # ‖(3, 4)‖₂ = 5, though no entry exceeds 4; and y counts, not x.
    y = np.array([[6.0, 0], [3, 4], [0, 0]])
    T = Trajectory(np.ones((4, 1)), np.ones((3, 1)), y)
    assert settling_time(T, 5) == settling_time(y, 5) == 1
    assert settling_time(T, 4.9) == 2
    assert settling_time(T, 6) == 0
    assert settling_time(T) == 2  # ε = 0.1
    assert settling_time(Trajectory(np.ones((4, 1)), np.ones((3, 1)))) == np.inf


def test_what_is_not_finite_has_not_settled():
    y = np.zeros((4, 3, 1))
    y[0, 0], y[1, 1], y[2, 2] = np.nan, np.inf, np.nan
    T = bypass_init(Trajectory, x=np.zeros((4, 4, 1)), u=np.zeros((4, 3, 1)), y=y)
    np.testing.assert_array_equal(settling_time(T), [1, 2, np.inf, 0])
    with pytest.raises(ValueError, match="trajectory must be finite"):
        settling_time(y)


# 0.3² + 0.4² = 0.5², so that the border comes up.
OUTPUTS = arrays(
    float,
    st.tuples(st.just(2), st.just(3), st.integers(1, 6), st.integers(1, 2)),
    elements=st.sampled_from([0.0, 0.3, -0.4, 0.5, 0.6, -2.0]),
)


@given(OUTPUTS)
def test_settling_times_as_they_are_defined(y):
    def slow(outputs):
        """The least κ with ‖y_k‖ ≤ ε for all k ≥ κ."""
        inside = [np.sqrt(sum(v * v for v in output)) <= 0.5 for output in outputs]
        return next((float(k) for k in range(len(inside)) if all(inside[k:])), np.inf)

    expected = [[slow(outputs) for outputs in row] for row in y]
    kappa = settling_time(y, 0.5)
    assert kappa.dtype == np.float64
    np.testing.assert_array_equal(kappa, expected)
    steps = y.shape[-2]
    T = Trajectory(np.zeros((2, 3, steps + 1, 1)), np.zeros((2, 3, steps, 1)), y)
    np.testing.assert_array_equal(settling_time(T, 0.5), expected)
    np.testing.assert_array_equal(settling_time(y.tolist(), 0.5), expected)


def test_settling_times_in_words():
    assert settling_text(7, 30) == settling_text(np.float64(7), 30) == "7"
    assert settling_text(6.5, 30) == "6.5"
    assert settling_text(0.0, 30) == "0"
    assert settling_text(np.inf, 30) == ">30"
    assert settling_text(settles(1, 1), 2) == ">2"


def test_the_largest_input_by_hand():
    u = np.array([[[1, -2], [0, 1.5]], [[0, 0], [0.5, 0]], [[-1, 0], [-3, 2]]])
    T = Trajectory(np.zeros((3, 3, 1)), u)
    np.testing.assert_array_equal(max_input(T), [2, 0.5, 3])
    assert max_input(T[0]) == 2
    pairs = Trajectory(np.zeros((1, 3, 3, 1)), u[None])
    np.testing.assert_array_equal(max_input(pairs), [[2, 0.5, 3]])


NAN_X = X.copy()
NAN_X[1, 0] = np.nan


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Trajectory(NAN_X, U), r"x must be finite, got 1 bad value.*\(1, 0\)"),
        (lambda: Trajectory(X, U * np.inf), "u must be finite"),
        (lambda: Trajectory(X, U, [[np.nan], [0]]), "y must be finite"),
        (lambda: Trajectory(jnp.asarray(NAN_X), U), "x must be finite"),
        (
            lambda: Trajectory(X * (1 + 1j), U),
            "x must be an array of real numbers, got an",
        ),
        (lambda: Trajectory(X[:-1], U), "x must hold one step more than u.*2 states for 2 inputs"),
        (lambda: Trajectory(X[0], U), "x must have shape"),
        (lambda: Trajectory(X, U[:, 0]), "u must have shape"),
        (lambda: Trajectory(X[:1], U[:0]), "u must hold at least one step"),
        (lambda: Trajectory(X, U, X), r"y must have shape \(..., 2, any\)"),
        (lambda: Trajectory(X[None], U), "same leading batch shape"),
        (lambda: phi(Trajectory(X, U), np.eye(3), R), r"Q must have shape \(..., 2, 2\)"),
        (lambda: phi(Trajectory(X, U), Q, np.eye(2)), r"R must have shape \(..., 1, 1\)"),
        (lambda: phi(Trajectory(X, U), -Q, R), "Q must be positive semidefinite"),
        (lambda: phi(Trajectory(X, U), [[1, 1], [0, 1]], R), "Q must be symmetric"),
        (lambda: phi(Trajectory(X, U), np.nan * Q, R), "Q must be finite"),
        (lambda: second_moments(X), "trajectory must be a Trajectory, got ndarray"),
        (lambda: phi(X, Q, R), "trajectory must be a Trajectory, got ndarray"),
        (lambda: rollout(PLANT, [1, 2, 3], [[1, 1]], 2), r"x0 must have shape \(..., 2\)"),
        (lambda: rollout(PLANT, [np.nan, 0], [[1, 1]], 2), "x0 must be finite"),
        (lambda: rollout(PLANT, [1, 2], [[1, 1, 1]], 2), r"law must have shape \(..., 1, 2\)"),
        (lambda: rollout(PLANT, [1, 2], [[1, np.inf]], 2), "law must be finite"),
        (lambda: rollout(PLANT, [1, 2], [[1, 1]], 0), "steps must be a whole number of at least 1"),
        (lambda: rollout(PLANT, [1, 2], lambda x: x, 2), r"law must return .*\(1,\)"),
        (lambda: rollout(PLANT, np.ones((3, 2)), np.ones((2, 1, 2)), 2), "law must"),
        (lambda: rollout("plant", [1, 2], [[1, 1]], 2), "system must be a System"),
        (lambda: max_input(U), "trajectory must be a Trajectory, got ndarray"),
        (lambda: settling_time(X, -1), "epsilon must be finite and at least 0"),
        (lambda: settling_time(X, np.nan), "epsilon must be finite"),
        (lambda: settling_time(X, "0.1"), "epsilon must be a number"),
        (lambda: settling_time([1.0, 0.0]), r"trajectory must have shape \(..., any, any\)"),
        (lambda: settling_time(NAN_X), "trajectory must be finite"),
        (lambda: settling_time("soon"), "trajectory must be an array of real numbers"),
        (lambda: settling_text("soon", 30), "kappa must be a number of at least 0"),
        (lambda: settling_text([1, 2], 30), r"kappa must be a number.*got \[1, 2\]"),
        (lambda: settling_text(np.nan, 30), "kappa must be at least 0, got nan"),
        (lambda: settling_text(3, 0), "steps must be a whole number of at least 1"),
        (lambda: settling_time(np.zeros((2, 0, 3))), "trajectory must hold at least one step"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
