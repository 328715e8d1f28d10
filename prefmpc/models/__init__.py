"""Models σ of what a person minimises: quadratic ones, sums, networks, and what σ may see."""

from prefmpc.models.mlp import MLPCost
from prefmpc.models.networks import ICNNCost, soft_constraints
from prefmpc.models.quadratic import CostModel, QuadraticCost, SumCost
from prefmpc.models.separable import SeparableCost
from prefmpc.models.signals import SignalCost, select

__all__ = [
    "CostModel",
    "ICNNCost",
    "MLPCost",
    "QuadraticCost",
    "SeparableCost",
    "SignalCost",
    "SumCost",
    "select",
    "soft_constraints",
]
