"""prefmpc: learn the objective of a model predictive controller from people's choices.

The idea is that of arXiv 2511.22502: a model σ of what a person minimises is trained on pairwise
choices, through P(T_i is preferred to T_j) = 1 / (1 + exp(σ(T_i) − σ(T_j))), and then *is* the
objective of the controller.
"""

from prefmpc.comparisons import Comparisons
from prefmpc.convex import Interval, MapResult, fit_map, fit_maps
from prefmpc.early_stopping import NetworkFit, fit_network
from prefmpc.evaluation import WinRate, accuracy, regret, simulate, win_rate
from prefmpc.global_fit import GlobalResult, fit_global
from prefmpc.loops import ClosedLoops, closed_loops, mpc_rollout
from prefmpc.losses import FitError
from prefmpc.mlp import MLPCost
from prefmpc.models import CostModel, QuadraticCost, SumCost
from prefmpc.mpc import (
    BatchedMPC,
    ConvexMPC,
    LinearMPC,
    MPCError,
    MPCSolution,
    NonlinearMPC,
    ReferenceTracker,
    StabilityCheck,
    SteadyState,
    TerminalIngredients,
    check_stability,
    steady_state,
    terminal_ingredients,
)
from prefmpc.networks import ICNNCost, soft_constraints
from prefmpc.nonlinear import NonlinearSystem
from prefmpc.plants import cart_pendulum, kinematic_bicycle
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
from prefmpc.priors import WishartPrior, blocks, bryson
from prefmpc.selection import PriorChoice, choose_prior
from prefmpc.separable import SeparableCost
from prefmpc.sets import Ellipsoid, Polyhedron, SecondOrderCone
from prefmpc.signals import SignalCost, select
from prefmpc.systems import LinearSystem, oscillating_masses
from prefmpc.training import FitResult, fit
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
from prefmpc.uncertainty import Posterior, posterior

__version__ = "0.1.0"

__all__ = [
    "BatchedMPC",
    "ClosedLoops",
    "Comparisons",
    "ConvexMPC",
    "CostModel",
    "Criterion",
    "Ellipsoid",
    "FitError",
    "FitResult",
    "GlobalResult",
    "ICNNCost",
    "Interval",
    "LinearMPC",
    "LinearSystem",
    "MLPCost",
    "MPCError",
    "MPCSolution",
    "MapResult",
    "Moments",
    "NetworkFit",
    "NonlinearMPC",
    "NonlinearSystem",
    "Polyhedron",
    "Posterior",
    "Preference",
    "PriorChoice",
    "QuadraticCost",
    "QuadraticPreference",
    "ReferenceTracker",
    "SecondOrderCone",
    "SeparableCost",
    "SettlingTimePreference",
    "SignalCost",
    "StabilityCheck",
    "SteadyState",
    "SumCost",
    "TerminalIngredients",
    "Trajectory",
    "WinRate",
    "WishartPrior",
    "accuracy",
    "blocks",
    "bryson",
    "by_criterion",
    "cart_pendulum",
    "check_stability",
    "choose_prior",
    "closed_loops",
    "erring",
    "fit",
    "fit_global",
    "fit_map",
    "fit_maps",
    "fit_network",
    "kinematic_bicycle",
    "lexicographic",
    "logistic",
    "lqr_pool",
    "max_input",
    "mpc_rollout",
    "one_by_one",
    "oscillating_masses",
    "phi",
    "posterior",
    "random_states",
    "random_weights",
    "regret",
    "rollout",
    "second_moments",
    "select",
    "settling_text",
    "settling_time",
    "simulate",
    "soft_constraints",
    "steady_state",
    "terminal_ingredients",
    "win_rate",
]
