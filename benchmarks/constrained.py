"""Part "constrained": closed loops with limits on the states, some of them impossible to keep.

The speed of the two masses that forces act on is limited. (Positions do not do here: within reach
of the forces, a limit that is ever active is one that some starts violate.) Twice: at the states
that an input can move, x_1 … x_N, with times; and at x_0 … x_N−1, where a state that was led to a
limit may have passed it by rounding, which a solver has to forgive: verdicts alone.

"differ" counts the loops that end with another status than with DAQP.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import peers
from loops import COLUMNS, HORIZON, MINI, OURS, Case, Run, Sizes, compare
from measure import show

from prefmpc import Polyhedron, closed_loops

SPEED = 0.15
"""In m/s."""


def speed_limit(system: Any, *, after: bool) -> Polyhedron:
    """Return −SPEED ≤ v ≤ SPEED for the outer masses: at x_{k+1} = A x_k + B u_k, or at x_k."""
    at = [3, 5]
    rows = np.hstack([system.A, system.B] if after else [np.eye(6), np.zeros((6, 2))])[at]
    return Polyhedron(np.vstack([rows, -rows]), np.full(2 * len(at), SPEED))


def ours(case: Case, limits: Polyhedron, tol: float) -> Callable[[], Any]:
    """Return our closed loops, everything that they say."""
    options: dict[str, Any] = {"horizon": HORIZON, "steps": case.sizes.steps, "tol": tol}
    return lambda: closed_loops(case.system, case.cost, case.x0, constraints=limits, **options)


def inputs(loops: Callable[[], Any]) -> Run:
    """Return the same as a function that returns the inputs."""
    return lambda: loops().trajectories.u


def verdicts(case: Case, limits: Polyhedron) -> dict[str, np.ndarray]:
    """Return the last status (m,) of each loop, by name."""
    problem, steps = case.condensed(limits), case.sizes.steps
    said = {
        name: ours(case, limits, tol)().status[:, -1]
        for name, tol in zip(OURS, (1e-6, 1e-8), strict=True)
    }
    for name, make in peers.MAKERS.items():
        said[name] = peers.closed_loops(case.system, make(problem), case.x0, steps)[1]
    return said


def counted(said: dict[str, np.ndarray]) -> dict[str, dict[str, int]]:
    """Return how many loops end how, by name."""
    truth = said["DAQP, kept"]
    return {
        name: {
            "infeasible": int((status == peers.INFEASIBLE).sum()),
            "unfinished": int((status == peers.UNFINISHED).sum()),
            "status_differs": int((status != truth).sum()),
        }
        for name, status in said.items()
    }


STATUS_COLUMNS = {
    "infeasible": "infeasible",
    "unfinished": "unfinished",
    "status_differs": "differ",
}


def with_times(case: Case) -> dict[str, Any]:
    """The limits where they can be kept."""
    limits = speed_limit(case.system, after=True)
    problem = case.condensed(limits)
    exact = case.looped(peers.daqp_model(problem, tight=True))()
    runs: dict[str, Run] = {
        name: inputs(ours(case, limits, tol)) for name, tol in zip(OURS, (1e-6, 1e-8), strict=True)
    }
    runs |= {name: case.looped(make(problem)) for name, make in peers.MAKERS.items()}
    share = active_share(case, problem)
    words = counted(verdicts(case, limits))
    rows = [row | words[row["name"]] for row in compare(runs, exact, case.sizes.repeats, {})]
    title = f"1. Speed of the outer masses ≤ {SPEED} m/s at x_1 … x_N, active in {share:.0%} of the"
    show(f"{title} solves", rows, COLUMNS | STATUS_COLUMNS)
    return {"rows": rows, "active_share": share}


def active_share(case: Case, problem: peers.Condensed) -> float:
    """Return in which share of the solves along the loops a limit on the states is active."""
    exact = peers.daqp_model(problem, tight=True)
    seen: list[bool] = []

    def solve(x: np.ndarray) -> tuple[str, np.ndarray]:
        word, plan = exact(x)
        if word == peers.SOLVED:
            room = problem.limits - problem.E @ x - problem.G @ plan
            seen.append(bool((room < 1e-9).any()))
        return word, plan

    case.looped(solve)()
    return float(np.mean(seen))


def from_the_start(case: Case) -> dict[str, Any]:
    """The limits where the present state may already be beyond them by rounding."""
    said = counted(verdicts(case, speed_limit(case.system, after=False)))
    rows = [{"name": name} | words for name, words in said.items()]
    show("2. The same at x_0 … x_N−1: verdicts", rows, {"name": ""} | STATUS_COLUMNS)
    return {"rows": rows}


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    case = Case.of(MINI if mini else Sizes())
    return {"with_times": with_times(case), "from_the_start": from_the_start(case)}
