"""The loss and the objective, against formulas written out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_comparisons import COST, FEW, POOL, Distance
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

from prefmpc import Comparisons, CostModel, QuadraticCost, Trajectory
from prefmpc.learning.losses import PairData, cross_entropy, logits, objective, pair_data
from prefmpc.learning.training import best_restart


class GivenLogits:
    """A model whose features are the log-odds themselves."""

    @staticmethod
    def score(features):
        return features


def loss_of(z, labels, weights=None):
    z, labels = np.atleast_1d(z).astype(float), np.atleast_1d(labels).astype(float)
    weights = np.ones(z.size) if weights is None else weights
    return float(cross_entropy(GivenLogits, PairData(None, z, labels, weights)))


@given(st.lists(st.tuples(st.floats(-30, 30), st.floats(0, 1)), min_size=6, max_size=6))
def test_loss_is_the_negative_log_likelihood(pairs):
    z, labels = (np.array(column, dtype=np.longdouble) for column in zip(*pairs, strict=True))
    p = 1 / (1 + np.exp(-z))
    q = 1 / (1 + np.exp(z))  # 1 − p, without cancellation
    naive = -(labels * np.log(p) + (1 - labels) * np.log(q)).mean()
    assert loss_of(z, labels) == pytest.approx(float(naive), rel=1e-12, abs=1e-14)


def test_loss_at_logits_far_beyond_what_exp_can_hold():
    assert loss_of(800, 1) == loss_of(-800, 0) == 0
    assert loss_of(800, 0) == loss_of(-800, 1) == 800
    assert loss_of(800, 0.25) == 600
    slope = jax.grad(
        lambda z: cross_entropy(GivenLogits, PairData(None, z, np.array([0.0, 1]), np.ones(2)))
    )(jnp.array([800.0, 800.0]))
    np.testing.assert_array_equal(slope, [0.5, 0])


def test_the_sign_of_the_loss():
    # Smaller σ is preferred: a first that costs less than the second is the likelier answer.
    cheap, dear = Trajectory([[0.1], [0]], [[0]]), Trajectory([[3], [0]], [[0]])
    pool = jax.tree.map(lambda a, b: np.stack([a, b]), cheap, dear)
    model = QuadraticCost([[1]], [[1]])
    right, wrong = (
        float(cross_entropy(model, pair_data(model, Comparisons(pool, [0], [1], [label]))))
        for label in (1, 0)
    )
    # σ is 0.01 and 9: the log-odds are 8.99.
    assert right == pytest.approx(np.log1p(np.exp(-8.99)))
    assert wrong == pytest.approx(8.99 + np.log1p(np.exp(-8.99)))


def test_padding_does_not_count():
    plain, padded = pair_data(COST, FEW), pair_data(COST, FEW, 64)
    assert padded.features.shape[0] == padded.labels.size == padded.weights.size == 64
    expected = float(cross_entropy(COST, plain))
    assert float(cross_entropy(COST, padded)) == pytest.approx(expected, rel=1e-14)
    # A weight of 2 is the same as the pair twice.
    twice = Comparisons(POOL, [0, 1, 2, 3, 0], [1, 2, 3, 4, 1], [1, 0, 0.3, 0.5, 1])
    heavy = plain._replace(weights=np.array([2.0, 1, 1, 1]))
    assert float(cross_entropy(COST, heavy)) == pytest.approx(
        float(cross_entropy(COST, pair_data(COST, twice))), rel=1e-14
    )


@given(st.lists(st.tuples(*[st.integers(0, 4)] * 2, st.floats(0, 1)), min_size=5, max_size=5))
def test_a_pair_asked_the_other_way_round_says_the_same(rows):
    first, second, labels = (np.array(column) for column in zip(*rows, strict=True))
    one = pair_data(COST, Comparisons(POOL, first, second, labels))
    other = pair_data(COST, Comparisons(POOL, second, first, 1 - labels))
    expected = float(cross_entropy(COST, one))
    assert float(cross_entropy(COST, other)) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_objective_by_hand():
    data = pair_data(COST, FEW)
    theta = np.asarray(COST.theta)
    expected = float(cross_entropy(COST, data)) + 0.1 * theta @ theta + 0.2 * np.abs(theta).sum()
    assert float(objective(COST, data, l2=0.1, l1=0.2)) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("l1", [0.0, 0.2])
def test_gradient_of_the_objective_against_finite_differences(l1):
    data = pair_data(COST, FEW)
    theta, unravel = ravel_pytree(COST)

    @jax.jit
    def loss(theta):
        return objective(unravel(theta), data, l2=0.1, l1=l1)

    h = 1e-5
    difference = [
        float(loss(theta + d) - loss(theta - d)) / (2 * h) for d in h * np.eye(theta.size)
    ]
    np.testing.assert_allclose(jax.grad(loss)(theta), difference, rtol=1e-6)


def test_a_model_of_ones_own():
    model = Distance(jnp.asarray(0.5))
    assert isinstance(model, CostModel)
    sizes = 0.5 * np.abs(POOL.x[:, :-1]).sum((-1, -2))
    data = pair_data(model, FEW, 16)
    # Every trajectory once, however many pairs it is in; padded to few shapes.
    assert pair_data(model, FEW).features["size"].shape == (5,)
    assert data.features["size"].shape == (128,)
    z = np.asarray(logits(model, data))[:4]
    np.testing.assert_allclose(z, sizes[FEW.second] - sizes[FEW.first], rtol=1e-12)


# ---- a status depends on the number beside it ----


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_restart_without_a_finite_score_and_loss_is_never_chosen(bad):
    mixed = np.array(["converged", "not_finite"])
    assert best_restart([bad, 1.0], mixed, np.ones(2)) is None
    assert best_restart(np.ones(2), mixed, np.array([bad, 1.0])) is None
    both = np.array(["converged", "converged"])
    assert best_restart(np.array([bad, 3.0]), both, np.ones(2)) == 1
    assert best_restart([1.0, 1.0], both, [2.0, 1.0]) == 1
