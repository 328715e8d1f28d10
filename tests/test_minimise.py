"""`minimise` on problems whose answer is known."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prefmpc.learning._lbfgsb import minimise

# minimise(): one small problem, whose answer is known, compiled once.


@pytest.fixture(scope="module")
def shrink():
    """θ = {a, b} that minimises ½‖θ − target‖² + l1·‖θ‖₁ over −1 ≤ a ≤ 2, b ≥ 0.01."""

    @jax.jit
    def run(start, target, l1):
        return minimise(
            lambda t: ((t["a"] - target[0]) ** 2 + (t["b"] - target[1]) ** 2) / 2,
            start,
            ({"a": -1.0, "b": 0.01}, {"a": 2.0, "b": jnp.inf}),
            l1=l1,
            max_iterations=200,
            tol=1e-10,
        )

    return lambda start, target, l1=0.0: run(
        {"a": float(start[0]), "b": float(start[1])}, np.array(target, float), l1
    )


@pytest.mark.parametrize("start", [(0, 1), (5, -5), (-9, -9), (100, 100), (2, 0.01)])
@pytest.mark.parametrize("target", [(1, 3), (3, -4), (-5, 0.5), (0, 0)])
@pytest.mark.parametrize("l1", [0.0, 0.4])
def test_minimise_from_anywhere_finds_the_known_optimum(shrink, start, target, l1):
    # Soft thresholding, then the box; started outside of it jaxopt itself goes astray.
    target = np.array(target, float)
    shrunk = np.sign(target) * np.maximum(np.abs(target) - l1, 0)
    expected = np.clip(shrunk, [-1, 0.01], [2, np.inf])
    theta, _, error = shrink(start, target, l1)
    assert error <= 1e-10
    np.testing.assert_allclose([theta["a"], theta["b"]], expected, atol=1e-8)


def test_an_infinite_slope_towards_a_bound_is_no_minimum():
    # √x on x ≥ 0: the projected gradient at 0 is 0, the gradient itself infinite.
    low, high = np.zeros(2), np.full(2, np.inf)
    options = {"max_iterations": 50, "tol": 1e-3}
    x, _, error = minimise(lambda x: jnp.sqrt(x).sum(), np.zeros(2), (low, high), **options)
    assert (np.asarray(x) == 0).all()
    assert np.isnan(error)
    _, _, error = minimise(lambda x: jnp.sum((x - 1) ** 2), np.zeros(2), (low, high), **options)
    assert error <= 1e-3
