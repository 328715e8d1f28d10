"""prefmpc: learn the objective of a model predictive controller from people's choices.

The idea is that of arXiv 2511.22502: a model σ of what a person minimises is trained on pairwise
choices, through P(T_i is preferred to T_j) = 1 / (1 + exp(σ(T_i) − σ(T_j))), and then *is* the
objective of the controller.
"""

from inspect import ismodule as _ismodule

from prefmpc.asking import *
from prefmpc.evaluation import *
from prefmpc.learning import *
from prefmpc.models import *
from prefmpc.mpc import *
from prefmpc.preferences import *
from prefmpc.systems import *

__version__ = "0.1.0"

# What is public stands in the rooms' own lists.
__all__ = sorted(
    name for name, value in vars().items() if not name.startswith("_") and not _ismodule(value)
)
