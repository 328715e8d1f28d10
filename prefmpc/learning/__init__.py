"""Learning σ from comparisons: the paper's recipe, the most probable weights, their posterior."""

from prefmpc._results import FitError
from prefmpc.learning.camps import Camps, find_camps
from prefmpc.learning.change import (
    Agreement,
    ChangeTest,
    Shared,
    agreement,
    forgetting,
    has_changed,
)
from prefmpc.learning.convex import Interval, MapResult, fit_map, fit_maps
from prefmpc.learning.early_stopping import NetworkFit, fit_network
from prefmpc.learning.global_fit import GlobalResult, fit_global
from prefmpc.learning.people import PeopleResult, fit_hierarchy, fit_raters
from prefmpc.learning.people_posterior import PeoplePosterior, people_posterior
from prefmpc.learning.priors import WishartPrior, blocks, bryson
from prefmpc.learning.selection import PriorChoice, choose_prior
from prefmpc.learning.training import FitResult, fit
from prefmpc.learning.uncertainty import Posterior, posterior

__all__ = [
    "Agreement",
    "Camps",
    "ChangeTest",
    "FitError",
    "FitResult",
    "GlobalResult",
    "Interval",
    "MapResult",
    "NetworkFit",
    "PeoplePosterior",
    "PeopleResult",
    "Posterior",
    "PriorChoice",
    "Shared",
    "WishartPrior",
    "agreement",
    "blocks",
    "bryson",
    "choose_prior",
    "find_camps",
    "fit",
    "fit_global",
    "fit_hierarchy",
    "fit_map",
    "fit_maps",
    "fit_network",
    "fit_raters",
    "forgetting",
    "has_changed",
    "people_posterior",
    "posterior",
]
