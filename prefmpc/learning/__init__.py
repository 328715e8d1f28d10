"""Learning σ from comparisons: the paper's recipe, the most probable weights, their posterior."""

from prefmpc._results import FitError
from prefmpc.learning.convex import Interval, MapResult, fit_map, fit_maps
from prefmpc.learning.early_stopping import NetworkFit, fit_network
from prefmpc.learning.global_fit import GlobalResult, fit_global
from prefmpc.learning.priors import WishartPrior, blocks, bryson
from prefmpc.learning.selection import PriorChoice, choose_prior
from prefmpc.learning.training import FitResult, fit
from prefmpc.learning.uncertainty import Posterior, posterior

__all__ = [
    "FitError",
    "FitResult",
    "GlobalResult",
    "Interval",
    "MapResult",
    "NetworkFit",
    "Posterior",
    "PriorChoice",
    "WishartPrior",
    "blocks",
    "bryson",
    "choose_prior",
    "fit",
    "fit_global",
    "fit_map",
    "fit_maps",
    "fit_network",
    "posterior",
]
