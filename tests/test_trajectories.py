"""Trajectories, φ and the random pools against arithmetic done by hand."""

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
    QuadraticCost,
    Trajectory,
    lqr_pool,
    oscillating_masses,
    phi,
    random_states,
    random_weights,
    rollout,
    second_moments,
)

KEY = jax.random.key(2000)

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


def test_rollout_of_a_batch_with_a_gain_each():
    x0, K = np.array([[2.0, 0], [2.0, 0]]), np.array([[[0.5, 0]], [[0.0, 0]]])
    T = rollout(PLANT, x0, K, 2)
    np.testing.assert_array_equal(T.x[0], [[2, 0], [2, -1], [1, -2]])
    np.testing.assert_array_equal(T.x[1], [[2, 0]] * 3)


def test_a_pool_is_made_of_lqr_loops_from_random_states(masses):
    radius = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])
    pool = lqr_pool(masses, 8, 10, key=KEY, radius=radius)
    assert pool.x.shape == (8, 11, 6)
    x, u = np.asarray(pool.x), np.asarray(pool.u)
    moved = x[:, :-1] @ masses.A.T + u @ masses.B.T
    np.testing.assert_allclose(x[:, 1:], moved, atol=1e-13)
    assert (np.abs(x[:, 0]) <= radius).all()
    # Each loop has one gain: inputs are linear in the states, and gains differ between loops.
    gains = [np.linalg.lstsq(x[i, :-1], u[i], rcond=None) for i in range(8)]
    for i, (K, *_) in enumerate(gains):
        np.testing.assert_allclose(x[i, :-1] @ K, u[i], atol=1e-10)
    assert np.abs(gains[0][0] - gains[1][0]).max() > 1e-3
    again = lqr_pool(masses, 8, 10, key=KEY, radius=radius)
    np.testing.assert_array_equal(again.x, pool.x)


def test_a_pool_uses_the_weights_that_it_is_given(masses):
    Q, R = np.diag([40.0, 40, 40, 5, 5, 5]), 0.2 * np.eye(2)
    weights = np.stack([Q] * 3), np.stack([R] * 3)
    pool = lqr_pool(masses, 3, 5, key=KEY, radius=np.ones(6), weights=weights)
    K = masses.lqr(Q, R)[0]
    np.testing.assert_allclose(pool.u, -pool.x[:, :-1] @ K.T, atol=1e-12)


def test_random_weights_are_predominantly_diagonal():
    Q, R = random_weights(6, 2, key=KEY, shape=(200,))
    assert (Q.shape, R.shape) == ((200, 6, 6), (200, 2, 2))
    for weights in (Q, R):
        np.testing.assert_allclose(weights, np.swapaxes(weights, -1, -2), atol=1e-14)
        assert np.linalg.eigvalsh(weights).min() >= 0.1
        diagonal = np.diagonal(weights, axis1=-2, axis2=-1)
        assert diagonal.min() >= 0.1
        assert 4.5 < diagonal.mean() < 5.7  # U[0.1, 10] has mean 5.05, coupling adds 0.03
    off = Q - np.eye(6) * Q
    assert 0 < np.abs(off).max() < 0.2
    narrow, _ = random_weights(2, 1, key=KEY, low=1, high=2, coupling=0)
    np.testing.assert_array_equal(narrow, np.diag(np.diag(narrow)))
    assert ((np.diag(narrow) >= 1) & (np.diag(narrow) <= 2)).all()


def test_random_states_fill_their_box():
    x = random_states([1.0, 0.0, 3.0], key=KEY, shape=(4000,))
    np.testing.assert_array_equal(x[:, 1], 0)
    assert (np.abs(x) <= [1, 0, 3]).all()
    # Uniform on [−r, r]: mean 0, standard deviation r/√3.
    np.testing.assert_allclose(x.mean(0) / [1, 1, 3], 0, atol=0.04)
    np.testing.assert_allclose(x.std(0), np.array([1, 0, 3]) / np.sqrt(3), rtol=0.03, atol=1e-12)
    np.testing.assert_array_equal(x, random_states([1.0, 0.0, 3.0], key=KEY, shape=(4000,)))


def test_every_kind_of_key():
    one, two = jax.random.split(KEY)

    def draw(key):
        return random_states(np.ones(3), key=key)

    np.testing.assert_array_equal(draw(one), draw(jax.random.clone(one)))
    np.testing.assert_array_equal(draw(one), draw(jax.random.key_data(one)))  # an old-style key
    assert (draw(one) != draw(two)).all()
    generator = np.random.default_rng(0)
    assert (draw(generator) != draw(generator)).all()  # NumPy's own moves on


NAN_X = X.copy()
NAN_X[1, 0] = np.nan
MASSES = oscillating_masses()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Trajectory(NAN_X, U), r"x must be finite, got 1 bad value.*\(1, 0\)"),
        (lambda: Trajectory(X, U * np.inf), "u must be finite"),
        (lambda: Trajectory(X, U, [[np.nan], [0]]), "y must be finite"),
        (lambda: Trajectory(jnp.asarray(NAN_X), U), "x must be finite"),
        (lambda: Trajectory(X * (1 + 1j), U), "x must be an array of real numbers, got complex"),
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
        (lambda: rollout("plant", [1, 2], [[1, 1]], 2), "system must be a LinearSystem"),
        (lambda: random_weights(0, 1, key=KEY), "nx must be a whole number"),
        (lambda: random_weights(1, 1.5, key=KEY), "nu must be a whole number"),
        (lambda: random_weights(1, 1, key=KEY, low=0), "low and high must satisfy 0 < low < high"),
        (lambda: random_weights(1, 1, key=KEY, low=3, high=2), "0 < low < high, got 3 and 2"),
        (lambda: random_weights(1, 1, key=KEY, coupling=-1), "coupling must be finite and at"),
        (lambda: random_states([-1.0], key=KEY), "radius must not be negative"),
        (lambda: random_states([np.nan], key=KEY), "radius must be finite"),
        (lambda: random_states([1.0], key=0), "key must be a single JAX random key.*got int"),
        (lambda: random_states(1.0, key=KEY), "radius must have 1 dimension"),
        (lambda: lqr_pool(MASSES, 0, 5, key=KEY, radius=np.ones(6)), "size must be a whole"),
        (lambda: lqr_pool(MASSES, 2, 0, key=KEY, radius=np.ones(6)), "steps must be a whole"),
        (lambda: lqr_pool(MASSES, 2, 5, key=KEY, radius=np.ones(5)), "x0 must have shape|radius"),
        (
            lambda: lqr_pool(
                MASSES,
                2,
                5,
                key=KEY,
                radius=np.ones(6),
                weights=(np.ones((1, 6, 6)), np.ones((1, 2, 2))),
            ),
            "weights must hold 2 matrices each, got 1 and 1",
        ),
        (lambda: lqr_pool("plant", 2, 5, key=KEY, radius=[1]), "system must be a LinearSystem"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
