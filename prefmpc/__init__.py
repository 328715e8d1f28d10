"""prefmpc: learn the objective of a model predictive controller from people's choices.

The idea is that of arXiv 2511.22502: a model σ of what a person minimises is trained on pairwise
choices, through P(T_i is preferred to T_j) = 1 / (1 + exp(σ(T_i) − σ(T_j))), and then *is* the
objective of the controller.
"""

from prefmpc.evaluation import ClosedLoops, accuracy, closed_loops, simulate
from prefmpc.models import CostModel, QuadraticCost
from prefmpc.mpc import BatchedMPC, LinearMPC, MPCError, MPCSolution
from prefmpc.preferences import Comparisons, Preference, QuadraticPreference, one_by_one
from prefmpc.sets import Polyhedron
from prefmpc.systems import LinearSystem, oscillating_masses
from prefmpc.training import FitError, FitResult, fit
from prefmpc.trajectories import (
    Moments,
    Trajectory,
    lqr_pool,
    phi,
    random_states,
    random_weights,
    rollout,
    second_moments,
)

__version__ = "0.1.0"

__all__ = [
    "BatchedMPC",
    "ClosedLoops",
    "Comparisons",
    "CostModel",
    "FitError",
    "FitResult",
    "LinearMPC",
    "LinearSystem",
    "MPCError",
    "MPCSolution",
    "Moments",
    "Polyhedron",
    "Preference",
    "QuadraticCost",
    "QuadraticPreference",
    "Trajectory",
    "accuracy",
    "closed_loops",
    "fit",
    "lqr_pool",
    "one_by_one",
    "oscillating_masses",
    "phi",
    "random_states",
    "random_weights",
    "rollout",
    "second_moments",
    "simulate",
]
