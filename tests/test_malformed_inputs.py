"""Malformed input to everything public: a ValueError that names the argument, or a right answer.

`malformed_calls` has a valid call of every callable of the package; each argument of it is then
replaced by what `malformed_values` holds. A few values of each argument are tried; with
``PREFMPC_MALFORMED=all`` in the environment all 20,000 (a minute).
"""

from __future__ import annotations

import inspect
import os
import random
import warnings

import numpy as np
from malformed_calls import valid_calls
from malformed_values import ANYTHING, Own, accepted, spoiled

import prefmpc as p

EVERYTHING = os.environ.get("PREFMPC_MALFORMED") == "all"
PER_ARGUMENT = 4

EXEMPT = {
    **dict.fromkeys(["CostModel", "Criterion", "Preference"], "a type"),
    **dict.fromkeys(["FitError", "MPCError"], "an error"),
    **dict.fromkeys(
        [
            *("CExport", "ClosedLoops", "FitResult", "GlobalResult", "Interval", "MPCSolution"),
            *("Agreement", "Camps", "ChangeTest", "Moments", "PeoplePosterior", "PeopleResult"),
            "Shared",
            *(
                "NetworkFit",
                "Posterior",
                "PriorChoice",
                "Question",
                "SteadyState",
                "TerminalIngredients",
                "WinRate",
            ),
        ],
        "a result",
    ),
}

PATHS = (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError)


def trials():
    """Return (name, argument, label, value) for all that is tried."""
    draw = random.Random(0)
    out = []
    for name, (_, valid) in valid_calls().items():
        for argument in valid:
            bad = {**ANYTHING, **spoiled(valid[argument])}
            labels = sorted(bad)
            if not EVERYTHING:
                # What is right after all may take long: it is computed.
                wrong = [label for label in labels if label not in accepted(name, argument)]
                labels = draw.sample(wrong, PER_ARGUMENT)
            out += [(name, argument, label, bad[label]) for label in labels]
    return out


# Sizes that do not go together may be told of either side.
MISFITS = {
    *("[]", "set", "ragged", "longer", "wider", "empty", "deeper", "flatter", "one more", "one 9"),
    *("larger plant", "larger cost", "trajectory", "pool", "shorter pool", "failed pool"),
}
# Functions that find themselves what is wrong with what they are given.
SPEAKERS = {"cost", "costs", "larger cost", "network", "shorter pool"}


def is_named(argument, label, valid, said):
    if label.endswith("1e308"):  # an overflow may show up anywhere
        return True
    if label in SPEAKERS and (argument == "law" or any(map(callable, valid.values()))):
        return True
    if label in MISFITS or label.removeprefix("first ") in MISFITS:
        return any(other.removesuffix("s") in said for other in valid)
    return argument.removesuffix("s") in said  # one of several may be meant


def complaint(name, argument, label, value):
    """Return what is wrong with the answer to a bad value, None if nothing is."""
    function, valid = valid_calls()[name]
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            function(**{**valid, argument: value})
    except ValueError as error:
        return None if is_named(argument, label, valid, str(error)) else f"not named: {error}"
    except (Own, p.MPCError, p.FitError):
        return None
    except OSError as error:
        return None if argument == "path" else repr(error)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None if label in accepted(name, argument) else "accepted"


def test_malformed_input_is_refused_by_name():
    answers = {trial[:3]: complaint(*trial) for trial in trials()}
    assert len(answers) > 1000
    assert {trial: said for trial, said in answers.items() if said} == {}


def test_every_argument_is_tried():
    for name, (function, valid) in valid_calls().items():
        assert inspect.signature(function).parameters.keys() == valid.keys(), name
        if EVERYTHING and name != "Comparisons.load":  # of a file that is not there
            function(**valid)


def test_everything_public_is_tried_or_exempt():
    tried = {name.split(".")[0].split("(")[0].strip() for name in valid_calls()}
    assert set(p.__all__) - tried <= EXEMPT.keys() <= set(p.__all__)
