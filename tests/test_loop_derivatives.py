"""The derivatives of closed loops are those of finite differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prefmpc import (
    Polyhedron,
    QuadraticCost,
    closed_loops,
    mpc_rollout,
    oscillating_masses,
    random_states,
)
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2000)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
STATES = np.asarray(random_states(RADIUS, key=KEY, shape=(12,)))
# Speed limits of two masses; half of the states are too energetic for them.
LIMITS = Polyhedron(np.eye(8)[[3, 4, 4]] * [[1], [1], [-1]], [0.3] * 3)
SLOW = [0, 4, 8, 9, 10]
N, STEPS = 8, 6


def person(T):
    """What the controller does not know: force counts twice as much as it thinks."""
    x, u = T.x[..., :-1, :], T.u
    return jnp.einsum("...kx,...kx->...", x, x) + 2 * jnp.einsum("...ku,...ku->...", u, u)


CALM = STATES[SLOW]


@pytest.mark.parametrize("constraints", [None, LIMITS])
def test_derivatives_are_those_of_finite_differences(constraints):
    def performance(cost, x0):
        T = mpc_rollout(MASSES, cost, x0, horizon=N, steps=STEPS, constraints=constraints)
        return person(T).mean()

    # One program for values and slopes: most of the time goes into compiling it.
    both = jax.jit(jax.value_and_grad(performance, argnums=(0, 1)))
    plain = closed_loops(MASSES, PAPER, CALM, horizon=N, steps=STEPS, constraints=constraints)
    value, slopes = both(PAPER, CALM)
    assert float(value) == pytest.approx(person(plain.trajectories).mean())
    saturated = np.abs(plain.trajectories.u) > 1 - 1e-9
    at_limit = np.abs(np.abs(plain.trajectories.x[..., 3:5]) - 0.3) < 1e-6
    assert saturated.any()
    assert at_limit.any() == (constraints is not None)

    push = jax.jit(lambda at, way: jax.jvp(performance, at, way))
    rng = np.random.default_rng(0)
    for _ in range(3):
        way = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), (PAPER, CALM))
        ahead = jax.tree.map(lambda a, b: a + 1e-6 * b, (PAPER, CALM), way)
        behind = jax.tree.map(lambda a, b: a - 1e-6 * b, (PAPER, CALM), way)
        expected = (both(*ahead)[0] - both(*behind)[0]) / 2e-6
        pairs = zip(jax.tree.leaves(slopes), jax.tree.leaves(way), strict=True)
        assert sum(np.vdot(a, b) for a, b in pairs) == pytest.approx(float(expected), rel=1e-5)
        forward = push((PAPER, CALM), way)[1]
        assert float(forward) == pytest.approx(float(expected), rel=1e-5)
