"""Answers of a person who is not sure, drawn from the pairs of a small pool."""

from __future__ import annotations

import jax

from prefmpc import (
    Comparisons,
    QuadraticCost,
    logistic,
    lqr_pool,
    oscillating_masses,
)
from studies import RADIUS


def sampled_answers(weights, size, *, seed):
    """Return the pool of 30 trajectories, and what somebody with these weights said of it."""
    pool = lqr_pool(
        oscillating_masses(), 30, 10, key=jax.random.key(seed), radius=RADIUS, saturate=False
    )
    person = logistic(QuadraticCost(weights.Q, weights.R), 1.0)
    soft = Comparisons.random(pool, person, size, key=jax.random.key(seed + 1))
    return pool, soft.sampled(key=jax.random.key(seed + 2))
