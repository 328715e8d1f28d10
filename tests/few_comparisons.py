"""Four pairs of five short trajectories, and a model of one weight that is no quadratic."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from prefmpc import Comparisons, QuadraticCost, Trajectory
from prefmpc._pytree import register_pytree

RNG = np.random.default_rng(0)
POOL = Trajectory(RNG.normal(size=(5, 4, 2)), RNG.normal(size=(5, 3, 1)))
FEW = Comparisons(POOL, [0, 1, 2, 3], [1, 2, 3, 4], [1, 0, 0.3, 0.5])
COST = QuadraticCost([[2.0, 0.3], [0.3, 1]], [[0.7]])


@dataclasses.dataclass(frozen=True)
class Distance:
    """σ = w · Σ|x|: not a quadratic, and used through differences of scores."""

    w: object
    linear_in_features = False

    @staticmethod
    def features(trajectory):
        return {"size": jnp.abs(trajectory.x[..., :-1, :]).sum((-1, -2))}

    def score(self, features):
        return self.w * features["size"]

    def __call__(self, trajectory):
        return self.score(self.features(trajectory))

    def bounds(self):
        return Distance(jnp.zeros_like(self.w)), Distance(jnp.full_like(self.w, 2.0))


register_pytree(Distance)
