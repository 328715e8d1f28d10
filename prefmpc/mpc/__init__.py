"""Controllers that minimise a learned σ; one file for each family of solvers."""

from prefmpc.mpc.batched import BatchedMPC
from prefmpc.mpc.convex import ConvexMPC
from prefmpc.mpc.export import CExport, export_c
from prefmpc.mpc.feedback import KalmanEstimator, OutputFeedback
from prefmpc.mpc.loops import ClosedLoops, closed_loops, mpc_rollout
from prefmpc.mpc.matrices import matrices
from prefmpc.mpc.nonlinear import NonlinearMPC
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.solution import MPCError, MPCSolution
from prefmpc.mpc.stability import StabilityCheck, check_stability
from prefmpc.mpc.steady import SteadyState, steady_state
from prefmpc.mpc.terminal import TerminalIngredients, terminal_ingredients
from prefmpc.mpc.tracking import ReferenceTracker

__all__ = [
    "BatchedMPC",
    "CExport",
    "ClosedLoops",
    "ConvexMPC",
    "KalmanEstimator",
    "LinearMPC",
    "MPCError",
    "MPCSolution",
    "NonlinearMPC",
    "OutputFeedback",
    "ReferenceTracker",
    "StabilityCheck",
    "SteadyState",
    "TerminalIngredients",
    "check_stability",
    "closed_loops",
    "export_c",
    "matrices",
    "mpc_rollout",
    "steady_state",
    "terminal_ingredients",
]
