"""``python -m studies NAME``: repeat a study and write the file that the book reads."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from studies import (
    answers,
    asking,
    asking_limits,
    lane,
    measures,
    onesided,
    people,
    priors,
    quadratic,
    references,
    settling,
    signals,
    stability,
)
from studies.spread import write_spread

BOOK = Path(__file__).parents[1]


def _settling(*, key: Any) -> dict[str, np.ndarray]:
    draw = settling.settling_case(key=key)
    table = draw.table.copy()
    table[:, :, settling.SETTLING_COLUMNS.index("time s")] = np.nan  # belongs to a machine
    return {"table": table, "data κ": np.array(draw.data_kappa)}


def _ties(*, key: Any) -> dict[str, np.ndarray]:
    return {"table": settling.ties_case(key=key)}


def _distinct(*, key: Any) -> dict[str, np.ndarray]:
    return {"table": quadratic.distinct_case(key=key)}


Study = tuple[Callable[..., dict[str, np.ndarray]], str, dict[str, Any]]
STUDIES: dict[str, Study] = {
    "quadratic": (
        quadratic.quadratic_variants,
        "case_studies/quadratic_spread.json",
        {"rows": quadratic.ROWS, "columns": quadratic.COLUMNS},
    ),
    "distinct": (
        _distinct,
        "case_studies/distinct_spread.json",
        {"rows": quadratic.DISTINCT_ROWS, "columns": quadratic.DISTINCT_COLUMNS},
    ),
    "settling": (
        _settling,
        "case_studies/settling_spread.json",
        {
            "variants": settling.SETTLING_VARIANTS,
            "rows": settling.SETTLING_ROWS,
            "columns": settling.SETTLING_COLUMNS,
        },
    ),
    "ties": (
        _ties,
        "case_studies/ties_spread.json",
        {"rows": settling.TIES_ROWS, "columns": settling.TIES_COLUMNS},
    ),
    "priors": (
        priors.priors_case,
        "insight/priors_spread.json",
        {"people": priors.PEOPLE, "sizes": quadratic.SIZES, "learners": priors.LEARNERS},
    ),
    "calibration": (
        priors.calibration_case,
        "insight/calibration_spread.json",
        {
            **{"cases": priors.CASES, "methods": priors.METHODS},
            **{"sizes": priors.ASKED, "levels": priors.LEVELS},
        },
    ),
    "onesided": (
        onesided.onesided_case,
        "extensions/onesided_spread.json",
        {
            **{"sizes": onesided.ONESIDED_SIZES, "learners": onesided.LEARNERS},
            "controllers": onesided.CONTROLLERS,
        },
    ),
    "answers": (
        answers.answers_case,
        "extensions/answers_spread.json",
        {"people": answers.PEOPLE, "learners": answers.LEARNERS, "counts": answers.COUNTS},
    ),
    "asking": (
        asking.asking_case,
        "extensions/asking_spread.json",
        {
            **{"people": asking.PEOPLE, "strategies": tuple(asking.STRATEGIES)},
            "counts": asking.COUNTS,
        },
    ),
    "fewer": (
        partial(
            asking.asking_case,
            people=("paper, sure",),
            strategies=("made on purpose",),
            counts=asking.FEWER,
        ),
        "extensions/fewer_spread.json",
        {"counts": asking.FEWER},
    ),
    "stopping": (
        asking_limits.stopping_case,
        "extensions/stopping_spread.json",
        {
            **{"people": asking_limits.STOPPING_PEOPLE, "counts": asking_limits.STOPPING_COUNTS},
            **{"measures": asking_limits.MEASURES, "tests": asking_limits.TESTS},
        },
    ),
    "limits": (
        asking_limits.limits_case,
        "extensions/limits_spread.json",
        {
            **{"priors": tuple(asking_limits.PRIORS), "assumed": tuple(asking_limits.ASSUMED)},
            **{"ways": asking_limits.WAYS, "counts": asking_limits.LIMIT_COUNTS},
        },
    ),
    "settled": (
        asking_limits.settled_case,
        "extensions/settled_spread.json",
        {
            **{"variants": settling.SETTLING_VARIANTS, "ways": asking_limits.WAYS},
            **{"counts": asking_limits.SETTLED_COUNTS, "columns": asking_limits.SETTLED_COLUMNS},
        },
    ),
    "people": (
        people.people_case,
        "extensions/people_spread.json",
        {
            **{"rated": people.RATED, "few": people.FEW, "pooled": people.POOLED},
            **{"camps": people.CAMPS, "camp columns": people.CAMP_COLUMNS},
            **{"methods": people.METHODS, "calibrated": people.CALIBRATED},
            **{"changes": people.CHANGES, "remembered": people.REMEMBERED},
        },
    ),
    "references": (
        references.references_case,
        "extensions/references_spread.json",
        {
            **{"people": references.PEOPLE, "learners": references.LEARNERS},
            "controllers": references.CONTROLLERS,
        },
    ),
    "stability": (
        stability.stability_case,
        "extensions/stability_spread.json",
        {"plants": stability.PLANTS, "checks": stability.CHECKS},
    ),
    "signals": (
        signals.signals_case,
        "extensions/signals_spread.json",
        {
            **{"cases": signals.CASES, "sizes": signals.SIGNALS_SIZES},
            **{"learners": signals.LEARNERS, "tests": signals.TESTS, "alone": signals.ALONE},
            **{"jerk sizes": signals.JERK_SIZES, "jerk learners": signals.JERK_LEARNERS},
        },
    ),
    "lane": (
        lane.lane_case,
        "extensions/lane_spread.json",
        {"answers": lane.ANSWERS, "learners": lane.LANE_LEARNERS, "signals": lane.LANE_SIGNALS},
    ),
    "measures": (
        measures.measures_case,
        "insight/measures_spread.json",
        {"models": measures.MODELS, "columns": measures.MODEL_COLUMNS},
    ),
}


def main() -> None:
    """Run from the command line."""
    from tqdm import tqdm

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("--draws", type=int, default=50, help="seeds 0 … DRAWS − 1")
    parser.add_argument("--out", type=Path, help="default: the file of the book")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    run, name, head = STUDIES[arguments.study]
    seeds = list(range(arguments.draws))
    draws = [run(key=jax.random.key(seed)) for seed in tqdm(seeds, desc="draws")]
    out = arguments.out or BOOK / name
    out.parent.mkdir(exist_ok=True)
    write_spread(out, {**head, "seeds": seeds}, draws)


if __name__ == "__main__":
    main()
