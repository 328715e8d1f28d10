"""Random weights, random states, and the pools of closed loops that people compare."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import LinearSystem, lqr_pool, oscillating_masses, random_states, random_weights

KEY = jax.random.key(2000)


def test_a_pool_is_made_of_lqr_loops_from_random_states(masses):
    radius = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])
    pool = lqr_pool(masses, 8, 10, key=KEY, radius=radius, saturate=False)
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
    again = lqr_pool(masses, 8, 10, key=KEY, radius=radius, saturate=False)
    np.testing.assert_array_equal(again.x, pool.x)


def test_a_pool_uses_the_weights_that_it_is_given(masses):
    Q, R = np.diag([40.0, 40, 40, 5, 5, 5]), 0.2 * np.eye(2)
    weights = np.stack([Q] * 3), np.stack([R] * 3)
    pool = lqr_pool(masses, 3, 5, key=KEY, radius=np.ones(6), weights=weights, saturate=False)
    K = masses.lqr(Q, R)[0]
    np.testing.assert_allclose(pool.u, -pool.x[:, :-1] @ K.T, atol=1e-12)


def test_a_pool_keeps_the_input_limits_unless_told_otherwise(masses):
    radius = 3 * np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])
    limited = LinearSystem(
        masses.A, masses.B, masses.C, dt=masses.dt, u_min=[-0.5, -np.inf], u_max=[np.inf, 0.8]
    )
    weights = random_weights(6, 2, key=KEY, shape=(20,))
    start = {"key": KEY, "radius": radius, "weights": weights}
    pool, free = (lqr_pool(limited, 20, 12, **start, saturate=which) for which in (True, False))
    default = lqr_pool(limited, 20, 12, **start)
    np.testing.assert_array_equal(default.x, pool.x)
    K = np.stack([limited.lqr(q, r)[0] for q, r in zip(*weights, strict=True)])
    for T, low, high in ((pool, limited.u_min, limited.u_max), (free, -np.inf, np.inf)):
        x = T.x[:, 0]
        for k in range(12):  # by hand
            u = np.clip(-np.einsum("iuk,ik->iu", K, x), low, high)
            np.testing.assert_allclose(T.u[:, k], u, atol=1e-12)
            x = x @ limited.A.T + u @ limited.B.T
            np.testing.assert_allclose(T.x[:, k + 1], x, atol=1e-12)
    assert pool.u[..., 0].min() == -0.5
    assert pool.u[..., 1].max() == 0.8
    assert free.u[..., 0].min() < -0.6 < 0.6 < pool.u[..., 0].max()  # that bound is infinite
    assert free.u[..., 1].max() > 0.9


def test_a_plant_without_limits_has_the_same_pool_with_and_without_them(masses):
    unlimited = LinearSystem(masses.A, masses.B, masses.C, dt=masses.dt)
    start = {"key": KEY, "radius": np.ones(6)}
    free = lqr_pool(masses, 4, 6, **start, saturate=False)
    assert np.abs(free.u).max() > 1
    np.testing.assert_allclose(lqr_pool(unlimited, 4, 6, **start).u, free.u, rtol=0, atol=1e-13)


def test_a_pool_starts_where_it_is_told(masses):
    x0 = np.repeat(random_states(np.ones(6), key=KEY, shape=(2,)), 3, axis=0)
    pool = lqr_pool(masses, 6, 4, key=KEY, x0=x0)
    np.testing.assert_array_equal(pool.x[:, 0], x0)
    # The same start, a controller of its own for each.
    first = pool.u[:3, 0]
    assert (first != np.roll(first, 1, axis=0)).all()
    np.testing.assert_array_equal(lqr_pool(masses, 6, 4, key=KEY, x0=x0.tolist()).u, pool.u)


def test_the_controllers_of_a_pool_do_not_depend_on_its_starts(masses):
    def gain(**start):
        pool = lqr_pool(masses, 1, 20, key=KEY, saturate=False, **start)
        return np.linalg.lstsq(pool.x[0, :-1], pool.u[0], rcond=None)[0]

    expected = gain(radius=np.ones(6))
    np.testing.assert_allclose(gain(x0=np.eye(6)[:1]), expected, atol=1e-9)


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


MASSES = oscillating_masses()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: random_weights(0, 1, key=KEY), "nx must be a whole number"),
        (lambda: random_weights(1, 1.5, key=KEY), "nu must be a whole number"),
        (lambda: random_weights(1, 1, key=KEY, low=0), "low and high must satisfy 0 < low < high"),
        (lambda: random_weights(1, 1, key=KEY, low=3, high=2), "0 < low < high, got 3 and 2"),
        (lambda: random_weights(1, 1, key=KEY, coupling=-1), "coupling must be finite and at"),
        (lambda: random_states([-1.0], key=KEY), "radius must not be negative"),
        (lambda: random_states([np.nan], key=KEY), "radius must be finite"),
        (lambda: random_states([1.0], key=-1), "key must be a single JAX random key.*got -1"),
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
            r"weights\[0\] must have shape \(2, .*got \(1, ",
        ),
        (lambda: lqr_pool("plant", 2, 5, key=KEY, radius=[1]), "system must be a LinearSystem"),
        (lambda: lqr_pool(MASSES, 2, 5, key=KEY), "radius or x0 must be given, and not both"),
        (
            lambda: lqr_pool(MASSES, 2, 5, key=KEY, radius=np.ones(6), x0=np.ones((2, 6))),
            "radius or x0 must be given, and not both",
        ),
        (lambda: lqr_pool(MASSES, 2, 5, key=KEY, x0=np.ones((3, 6))), "x0 must have shape"),
        (lambda: lqr_pool(MASSES, 2, 5, key=KEY, x0=np.ones((2, 5))), "x0 must have shape"),
        (lambda: lqr_pool(MASSES, 2, 5, key=KEY, x0=np.ones(6)), "x0 must have shape"),
        (lambda: lqr_pool(MASSES, 1, 5, key=KEY, x0=np.full((1, 6), np.nan)), "x0 must be finite"),
        (lambda: lqr_pool(MASSES, 2, 5, key=0.5, radius=np.ones(6)), "key must be a single JAX"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
