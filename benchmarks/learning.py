"""Part "learning": times of learning a quadratic σ from n comparisons, and where the minimum is.

``seconds`` is the median of a warm call; ``excess`` is how far the objective lies above the best
of all that solve the same problem, relative to its size. Where a peer would take more than about
10 s, its numbers are null and ``reason`` says so. A million comparisons are learned in a process
of its own, for its peak memory. Last, the same number of comparisons of longer trajectories.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import Any

import jax
import learners
import numpy as np
from measure import child, median, seconds_of, show

import prefmpc
import studies

PRIOR = ([*studies.RADIUS], [1.0, 1.0])
SIZES = (20, 1000, 10_000, 100_000, 1_000_000)
HORIZONS = (10, 40, 160)
RESTARTS = 20
LONG = 3.0
"""What takes longer (in s) is timed once, or three times for a million."""

UP_TO = {
    "fit_map": SIZES[-1],
    "SciPy L-BFGS-B, NumPy": 100_000,
    "Clarabel through CVXPY": 1000,
    "fit_global": 10_000,
    "fit, 20 restarts at once": 1000,
    "SciPy L-BFGS-B, NumPy, 20 restarts": 10_000,
    "jaxopt, 20 restarts one by one": 1000,
}
"""The largest n that each manages within about 10 s."""

NOT_COMPILED = [name for name in UP_TO if name.startswith(("SciPy", "Clarabel"))]

MILLION = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
import learning, measure
print(json.dumps(learning.with_memory(int(sys.argv[1]), 7)))
"""


def pool_of(size: int, horizon: int = 10) -> prefmpc.Trajectory:
    """Return trajectories to compare."""
    system, key = prefmpc.oscillating_masses(), jax.random.key(0)
    return prefmpc.lqr_pool(system, size, horizon, key=key, radius=studies.RADIUS, saturate=False)


def data_of(pool: prefmpc.Trajectory, n: int) -> prefmpc.Comparisons:
    """Return n comparisons; of 10 000 and more, one in ten is answered wrongly."""
    rng = np.random.default_rng(0)
    first = rng.integers(0, len(pool), n)
    second = (first + rng.integers(1, len(pool), n)) % len(pool)
    cost = prefmpc.phi(pool, studies.QUADRATIC_Q, studies.QUADRATIC_R)
    labels = cost[first] <= cost[second]
    if n >= 10_000:
        labels ^= rng.uniform(size=n) < 0.1
    return prefmpc.Comparisons(pool, first, second, labels)


def learners_of(data: prefmpc.Comparisons) -> dict[str, dict[str, Callable[[], float]]]:
    """Return by problem and name what learns, and returns its objective."""
    prior = prefmpc.bryson(*PRIOR)
    key = jax.random.key(0)
    starts = prefmpc.QuadraticCost.random(6, 2, key=key, shape=(RESTARTS,))

    def ours() -> float:
        result = prefmpc.fit(data, starts, key=key, selection="training_loss")
        return float(result.training_loss.min())

    return {
        "MAP": {
            "fit_map": lambda: prefmpc.fit_map(data, prior).objective,
            "SciPy L-BFGS-B, NumPy": lambda: learners.scipy_map(data, prior),
            "Clarabel through CVXPY": lambda: learners.clarabel_map(data, prior),
        },
        "recipe": {
            "fit_global": lambda: prefmpc.fit_global(data).objective,
            "fit, 20 restarts at once": ours,
            "SciPy L-BFGS-B, NumPy, 20 restarts": lambda: learners.scipy_recipe(data, starts),
            "jaxopt, 20 restarts one by one": learners.jaxopt_recipe(data, starts),
        },
    }


def timed(work: Callable[[], float], repeats: int, compiled: bool) -> tuple[float, float, float]:
    """Return the objective, and the seconds of the first call and of a later one."""
    found: list[float] = []
    first = seconds_of(lambda: found.append(work()))
    if first > LONG and not compiled:  # the next call would take as long
        return found[0], first, first
    again = seconds_of(work)
    return found[0], first, again if again > LONG or repeats == 1 else median(work, repeats)


def with_memory(n: int, repeats: int) -> dict[str, Any]:
    """Learn from n comparisons; return time, Newton steps, and the process's peak memory in MB."""
    from measure import peak_memory

    data, prior = data_of(pool_of(2000), n), prefmpc.bryson(*PRIOR)
    before = peak_memory()
    first = seconds_of(lambda: prefmpc.fit_map(data, prior))
    result = prefmpc.fit_map(data, prior)
    repeats = repeats if result.seconds < LONG else 3
    seconds = float(np.median([prefmpc.fit_map(data, prior).seconds for _ in range(repeats)]))
    return {
        "seconds": seconds,
        "first_call_seconds": first,
        "newton_steps": result.iterations,
        "objective": result.objective,
        "peak_memory_mb": peak_memory(),
        "before_learning_mb": before,
    }


def by_size(sizes: tuple[int, ...], pool: prefmpc.Trajectory, repeats: int) -> dict[str, Any]:
    """Learn from more and more comparisons, by ours and by peers."""
    rows: list[dict[str, Any]] = []
    for n in sizes:
        for problem, peers in learners_of(data_of(pool, n)).items():
            here = []
            for name, work in peers.items():
                row: dict[str, Any] = {"n": n, "problem": problem, "name": name}
                if n > UP_TO[name]:
                    row |= {
                        "seconds": None,
                        "objective": None,
                        "reason": "left out: takes too long",
                    }
                elif n == 1_000_000:
                    row |= child(MILLION, n)
                else:
                    value, first, seconds = timed(work, repeats, name not in NOT_COMPILED)
                    row |= {"seconds": seconds, "first_call_seconds": first, "objective": value}
                here.append(row)
                print(f"  n = {n}, {name}: {row['seconds']}", file=sys.stderr, flush=True)
            best = min((row["objective"] for row in here if row["seconds"]), default=0.0)
            for row in here:
                if row["seconds"]:
                    row["excess"] = (row["objective"] - best) / abs(best)
                    row["times_ours"] = row["seconds"] / here[0]["seconds"]
            rows += here
    columns = {"n": "n", "problem": "problem", "name": "", "seconds": "ms", "times_ours": "× first"}
    columns |= {"excess": "objective above the best", "first_call_seconds": "first call, ms"}
    show("1. Learning from n comparisons of trajectories with N = 10", rows, columns)
    last = rows[-len(UP_TO)] if len(rows) >= len(UP_TO) else rows[0]
    if "peak_memory_mb" in last:
        before, after = last["before_learning_mb"], last["peak_memory_mb"]
        print(
            f"  fit_map, n = {last['n']}: {last['newton_steps']} Newton steps, peak memory "
            f"{after:.0f} MB, {after - before:.0f} MB of it for learning"
        )
    return {"rows": rows}


def by_horizon(horizons: tuple[int, ...], size: int, n: int, repeats: int) -> dict[str, Any]:
    """Learn from equally many comparisons of longer trajectories; their moments apart."""
    rows = []
    prior = prefmpc.bryson(*PRIOR)
    for horizon in horizons:
        pool = pool_of(size, horizon)
        data = data_of(pool, n)
        moments = median(lambda pool=pool: prefmpc.second_moments(pool), repeats)
        seconds = median(lambda data=data: prefmpc.fit_map(data, prior), repeats)
        steps = prefmpc.fit_map(data, prior).iterations
        row = {"horizon": horizon, "seconds": seconds, "moments_seconds": moments}
        each = (seconds - moments) / steps
        rows.append(row | {"newton_steps": steps, "step_seconds": each})
    columns = {"horizon": "N", "seconds": "fit_map, ms", "moments_seconds": "moments of it, ms"}
    columns |= {"newton_steps": "Newton steps", "step_seconds": "ms a step without the moments"}
    show(f"2. n = {n} comparisons of {size} trajectories of length N", rows, columns)
    return {"n": n, "pool": size, "rows": rows}


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of CVXPY and jaxopt
        if mini:
            small = by_size((20,), pool_of(30), 1)
            return {"by_size": small, "by_horizon": by_horizon((5, 10), 30, 20, 1)}
        sizes = by_size(SIZES, pool_of(2000), 7)
        return {"by_size": sizes, "by_horizon": by_horizon(HORIZONS, 2000, 10_000, 7)}
