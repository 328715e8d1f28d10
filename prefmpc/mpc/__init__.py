"""Controllers that minimise a learned σ; one file for each family of solvers."""

from prefmpc.mpc.batched import BatchedMPC
from prefmpc.mpc.convex import ConvexMPC
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.solution import MPCError, MPCSolution
from prefmpc.mpc.stability import StabilityCheck, check_stability
from prefmpc.mpc.terminal import TerminalIngredients, terminal_ingredients

__all__ = [
    "BatchedMPC",
    "ConvexMPC",
    "LinearMPC",
    "MPCError",
    "MPCSolution",
    "StabilityCheck",
    "TerminalIngredients",
    "check_stability",
    "terminal_ingredients",
]
