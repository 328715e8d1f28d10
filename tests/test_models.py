"""QuadraticCost: its weights θ, its bounds, its gradients, and that JAX may take it apart."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jax.flatten_util import ravel_pytree

from prefmpc import CostModel, QuadraticCost, Trajectory, WishartPrior

KEY = jax.random.key(2000)
RNG = np.random.default_rng(0)
BATCH = Trajectory(RNG.normal(size=(4, 6, 3)), RNG.normal(size=(4, 5, 2)))
Q = np.array([[4.0, 1, 0], [1, 3, 0.5], [0, 0.5, 2]])
R = np.array([[2.0, -0.5], [-0.5, 1]])


@given(st.integers(1, 6), st.data())
def test_weights_survive_the_way_through_theta(n, data):
    root = data.draw(arrays(float, (n, n), elements=st.floats(-5, 5)))
    Q, R = root @ root.T, root.T @ root + 0.1 * np.eye(n)
    cost = QuadraticCost(Q, R)
    scale = 1 + np.abs(root).max() ** 2
    # A singular Q has only the square root of the precision in its factor, not in the product.
    np.testing.assert_allclose(cost.Q, Q, atol=1e-9 * scale)
    np.testing.assert_allclose(cost.R, R, atol=1e-12 * scale)
    rows, columns = np.tril_indices(n)
    assert (np.asarray(cost.theta_Q)[rows == columns] >= 0).all()


@pytest.mark.parametrize(
    "Q",
    [
        np.diag([1.0, 1, 1, 0, 0, 0]),
        np.zeros((2, 2)),
        np.ones((3, 3)),
        np.array([[0.0, 0], [0, 2]]),
        1e-12 * np.ones((2, 2)),
    ],
    ids=["positions only", "nothing", "rank one", "second only", "tiny"],
)
def test_singular_weights(Q):
    cost = QuadraticCost(Q, [[1]])
    np.testing.assert_allclose(cost.Q, Q, atol=1e-14 * max(np.abs(Q).max(), 1e-12) * len(Q) ** 2)


@pytest.mark.parametrize(
    "wrong",
    [
        np.diag([1.0, -1.0]),
        np.diag([1.0, -1e-3]),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.array([[0.0, 1e-3], [1e-3, 1.0]]),
        np.array([[1.0, 1e-6], [0.0, 1.0]]),
        # Indefinite or not symmetric in the unit of the second signal alone.
        np.diag([1e12, -1e-3]),
        np.array([[1e12, 2e3], [2e3, 1e-6]]),
        np.array([[1e12, 1.0], [1.0 + 1e-3, 1e-6]]),
    ],
)
def test_neither_a_large_matrix_nor_a_large_unit_hides_a_wrong_one(wrong):
    for given_Q in (wrong, np.stack([1e12 * np.eye(2), wrong]), np.stack([wrong, np.eye(2)])):
        R = np.ones((*given_Q.shape[:-2], 1, 1))
        with pytest.raises(ValueError, match=r"Q must be (symmetric|positive semidefinite)"):
            QuadraticCost(given_Q, R)
        with pytest.raises(ValueError, match=r"Q must be (symmetric|positive definite)"):
            WishartPrior(wrong, [[1]])


def test_weights_in_units_decades_apart():
    D = np.diag([1e6, 1e-6])
    for S in (np.array([[2.0, 1], [1, 2]]), np.ones((2, 2)), np.diag([1.0, 0])):
        mixed = D @ S @ D
        cost = QuadraticCost(mixed, [[1.0]])
        back = np.linalg.solve(D, np.linalg.solve(D, np.asarray(cost.Q)).T)
        np.testing.assert_allclose(back, S, atol=1e-14)
    with pytest.raises(ValueError, match="R must be positive definite, got a smallest eigenvalue"):
        QuadraticCost([[1.0]], D @ np.ones((2, 2)) @ D)
    QuadraticCost([[1.0]], D @ np.diag([1.0, 2.0]) @ D)


def test_a_singular_matrix_leaves_the_others_of_its_stack_alone():
    stack = np.stack([Q, np.ones((3, 3)), 1e9 * Q])
    theta = QuadraticCost(stack, np.stack([R] * 3)).theta_Q
    np.testing.assert_array_equal(theta[0], QuadraticCost(Q, R).theta_Q)
    np.testing.assert_array_equal(theta[2], QuadraticCost(1e9 * Q, R).theta_Q)


def test_theta_is_the_cholesky_factor_row_by_row():
    cost = QuadraticCost(Q, R)
    L, M = np.linalg.cholesky(Q), np.linalg.cholesky(R)
    expected = [L[0, 0], L[1, 0], L[1, 1], *L[2], M[0, 0], M[1, 0], M[1, 1]]
    np.testing.assert_allclose(cost.theta, expected, atol=1e-15)


def test_bounds_are_those_of_the_paper():
    low, high = QuadraticCost(Q, R).bounds()
    inf = np.inf
    np.testing.assert_array_equal(low.theta_Q, [1, -inf, 0.01, -inf, -inf, 0.01])
    np.testing.assert_array_equal(low.theta_R, [0.01, -inf, 0.01])
    assert (np.asarray(high.theta) == inf).all()
    stacked, _ = QuadraticCost.random(3, 2, key=KEY, shape=(7,)).bounds()
    np.testing.assert_array_equal(stacked.theta_Q, np.tile(low.theta_Q, (7, 1)))


def test_sigma_is_nonnegative_for_any_theta():
    anything = jax.tree.map(lambda leaf: -3 * leaf + 1, QuadraticCost(Q, R))
    assert (np.linalg.eigvalsh(anything.Q) >= -1e-12).all()
    assert (anything(BATCH) >= 0).all()


def test_jit_vmap_and_stacks_agree_with_one_at_a_time():
    stack = QuadraticCost.random(3, 2, key=KEY, shape=(4,))
    assert stack.batch_shape == (4,)
    plain = [float(stack[i](BATCH[i])) for i in range(4)]
    np.testing.assert_allclose(stack(BATCH), plain, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(lambda m, T: m(T))(stack, BATCH), plain, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(lambda m, T: m(T))(stack, BATCH), plain, rtol=1e-12)
    table = jax.vmap(lambda m: m(BATCH))(stack)
    assert table.shape == (4, 4)
    np.testing.assert_allclose(np.diag(table), plain, rtol=1e-12)
    again = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[stack[i] for i in range(4)])
    np.testing.assert_array_equal(again.theta, stack.theta)
    x = BATCH.x[0, :-1]
    by_hand = np.einsum("ki,ij,kj", x, stack.Q[0], x)
    by_hand += np.einsum("ki,ij,kj", BATCH.u[0], stack.R[0], BATCH.u[0])
    assert plain[0] == pytest.approx(by_hand, rel=1e-12)


def test_gradient_against_finite_differences():
    cost = QuadraticCost(Q, R)
    slope = jax.grad(lambda m: m(BATCH[0]))(cost)
    assert isinstance(slope, QuadraticCost)
    theta, unravel = ravel_pytree(cost)
    sigma = jax.jit(lambda theta: unravel(theta)(BATCH[0]))
    h = 1e-6
    steps = h * np.eye(theta.size)
    difference = [float(sigma(theta + d) - sigma(theta - d)) / (2 * h) for d in steps]
    np.testing.assert_allclose(slope.theta, difference, rtol=1e-6, atol=1e-7)


def test_frozen_and_a_cost_model():
    cost = QuadraticCost(Q, R)
    assert isinstance(cost, CostModel)
    with pytest.raises(dataclasses.FrozenInstanceError):
        cost.theta_Q = 0
    with pytest.raises(IndexError, match="no batch dimension"):
        cost[0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: QuadraticCost(-Q, R), "Q must be positive semidefinite, got .* on its diagonal"),
        (lambda: QuadraticCost(np.diag([1, -1e-6]), R), "Q must be positive semidefinite"),
        (lambda: QuadraticCost(Q + np.eye(3, k=1), R), "Q must be symmetric"),
        (lambda: QuadraticCost(Q * np.nan, R), "Q must be finite"),
        (lambda: QuadraticCost(Q[:2], R), r"Q must be a square matrix.*\(2, 3\)"),
        (lambda: QuadraticCost([1, 2], R), "Q must be a square matrix"),
        (lambda: QuadraticCost(Q, 0 * R), "R must be positive definite"),
        (lambda: QuadraticCost(Q, [["a"]]), "R must be an array of real numbers"),
        (lambda: QuadraticCost(np.stack([Q, Q]), R), r"same batch shape, got \(2,\) and \(\)"),
        (lambda: QuadraticCost.random(0, 1, key=KEY), "nx must be a whole number"),
        (lambda: QuadraticCost.random(1, 1, key=KEY, low=-1), "low must be finite and at least 0"),
        (lambda: QuadraticCost(R, R)(BATCH), r"trajectory.x must have shape \(..., any, 2\)"),
        (lambda: QuadraticCost(Q, Q)(BATCH), r"trajectory.u must have shape \(..., any, 3\)"),
        (lambda: QuadraticCost(Q, R)(BATCH.x), "trajectory must be a Trajectory, got ndarray"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_a_loop_over_a_stack_ends() -> None:
    stack = QuadraticCost.random(2, 1, key=jax.random.key(0), shape=(3,))
    assert len(list(stack)) == 3
    with pytest.raises(IndexError, match="got 3"):
        stack[3]
