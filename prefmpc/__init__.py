"""prefmpc: learn the objective of a model predictive controller from people's choices.

The idea is that of arXiv 2511.22502: a model σ of what a person minimises is trained on pairwise
choices, through P(T_i is preferred to T_j) = 1 / (1 + exp(σ(T_i) − σ(T_j))), and then *is* the
objective of the controller.
"""

from prefmpc.comparisons import Comparisons
from prefmpc.convex import MapResult, WishartPrior, bryson, fit_map
from prefmpc.evaluation import (
    ClosedLoops,
    WinRate,
    accuracy,
    closed_loops,
    regret,
    simulate,
    win_rate,
)
from prefmpc.models import CostModel, QuadraticCost
from prefmpc.mpc import BatchedMPC, LinearMPC, MPCError, MPCSolution
from prefmpc.pools import lqr_pool, random_states, random_weights
from prefmpc.preferences import (
    Criterion,
    Preference,
    QuadraticPreference,
    SettlingTimePreference,
    by_criterion,
    erring,
    lexicographic,
    logistic,
    one_by_one,
)
from prefmpc.sets import Polyhedron
from prefmpc.systems import LinearSystem, oscillating_masses
from prefmpc.training import FitError, FitResult, fit
from prefmpc.trajectories import (
    Moments,
    Trajectory,
    max_input,
    phi,
    rollout,
    second_moments,
    settling_text,
    settling_time,
)

__version__ = "0.1.0"

__all__ = [
    "BatchedMPC",
    "ClosedLoops",
    "Comparisons",
    "CostModel",
    "Criterion",
    "FitError",
    "FitResult",
    "LinearMPC",
    "LinearSystem",
    "MPCError",
    "MPCSolution",
    "MapResult",
    "Moments",
    "Polyhedron",
    "Preference",
    "QuadraticCost",
    "QuadraticPreference",
    "SettlingTimePreference",
    "Trajectory",
    "WinRate",
    "WishartPrior",
    "accuracy",
    "bryson",
    "by_criterion",
    "closed_loops",
    "erring",
    "fit",
    "fit_map",
    "lexicographic",
    "logistic",
    "lqr_pool",
    "max_input",
    "one_by_one",
    "oscillating_masses",
    "phi",
    "random_states",
    "random_weights",
    "regret",
    "rollout",
    "second_moments",
    "settling_text",
    "settling_time",
    "simulate",
    "win_rate",
]
