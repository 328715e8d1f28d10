"""Part "loops": closed loops of the book's plant, 30 steps, N = 10, against other solvers.

Three tables: one controller from 200 states; 200 different controllers from one state each, what
they have to set up counted; a single small problem at a time. ``largest_error`` is the largest
distance of an input, anywhere along the loops, from what DAQP finds at tolerances of 1e-12.
``seconds`` is the median for all 200 loops; where a peer ran fewer of them, ``loops_run`` says how
many, and ``seconds`` is scaled up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import peers
from measure import medians, seconds_of, show

from prefmpc import (
    BatchedMPC,
    LinearMPC,
    QuadraticCost,
    closed_loops,
    oscillating_masses,
    random_states,
    simulate,
)
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

HORIZON = 10
OURS = ("closed_loops, tol 1e-6", "closed_loops, tol 1e-8")

Run = Callable[[], np.ndarray]
"""Run the loops, and return the inputs (m, steps, nu)."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is run."""

    loops: int = 200
    steps: int = 30
    repeats: int = 7
    linear_mpc: int = 20
    cvxpy: int = 3
    singles: int = 20


MINI = Sizes(loops=4, steps=6, repeats=1, linear_mpc=2, cvxpy=1, singles=3)


@dataclasses.dataclass(frozen=True)
class Case:
    """What is run: the plant, one σ, the states (m, nx)."""

    system: Any
    cost: QuadraticCost
    x0: np.ndarray
    sizes: Sizes

    @classmethod
    def of(cls, sizes: Sizes) -> Case:
        """Return the case of the book."""
        x0 = random_states(RADIUS, key=jax.random.key(0), shape=(sizes.loops,))
        cost = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
        return cls(oscillating_masses(), cost, x0, sizes)

    def condensed(self, constraints: Any = None) -> peers.Condensed:
        """Return the problem for the peers."""
        Q, R = QUADRATIC_Q[None], QUADRATIC_R[None]
        return peers.condensed(self.system, Q, R, HORIZON, constraints)[0]

    def looped(self, solve: peers.Solve, count: int | None = None) -> Run:
        """Return the loop in Python around a solver, over the first ``count`` states."""
        return lambda: peers.closed_loops(self.system, solve, self.x0[:count], self.sizes.steps)[0]

    def ours(self, tol: float, **options: Any) -> Run:
        """Return our closed loops."""
        options |= {"horizon": HORIZON, "steps": self.sizes.steps, "tol": tol}
        return lambda: closed_loops(self.system, self.cost, self.x0, **options).trajectories.u


def compare(
    runs: dict[str, Run], exact: np.ndarray, repeats: int, counts: dict[str, int]
) -> list[dict[str, Any]]:
    """Time the runs side by side, and say how far each is from the exact inputs."""
    found = {name: np.asarray(run()) for name, run in runs.items()}
    seconds = medians(runs, repeats)
    rows = []
    for name, inputs in found.items():
        count = counts.get(name, len(exact))
        error = np.abs(inputs - exact[:count])
        rows.append(
            {
                "name": name,
                "seconds": seconds[name] * len(exact) / count,
                "loops_run": count,
                "largest_error": float(np.nanmax(error)),
                "failed_elsewhere": int((np.isnan(inputs) != np.isnan(exact[:count])).any(2).sum()),
            }
        )
    return with_ratios(rows)


def with_ratios(rows: list[dict[str, Any]], key: str = "seconds") -> list[dict[str, Any]]:
    """Say how many times as long as the first row each takes."""
    return [{**row, "times_ours": row[key] / rows[0][key]} for row in rows]


COLUMNS = {
    "name": "",
    "seconds": "ms",
    "times_ours": "× ours",
    "largest_error": "largest error of u",
    "loops_run": "loops run",
}


def one_controller(case: Case) -> dict[str, Any]:
    """One controller, many states."""
    sizes, problem = case.sizes, case.condensed()
    exact = case.looped(peers.daqp_model(problem, tight=True))()
    ours = case.ours(1e-6)
    first_call = seconds_of(ours)
    linear = LinearMPC(case.system, case.cost, HORIZON)
    x0 = case.x0[: sizes.linear_mpc]
    runs: dict[str, Run] = {
        OURS[0]: ours,
        OURS[1]: case.ours(1e-8),
        **{name: case.looped(make(problem)) for name, make in peers.MAKERS.items()},
        "LinearMPC": lambda: simulate(case.system, linear, x0, sizes.steps).u,
        "CVXPY": case.looped(
            peers.cvxpy_solver(case.system, QUADRATIC_Q, QUADRATIC_R, HORIZON), sizes.cvxpy
        ),
    }
    vmapped = peers.qpax_loops(case.system, [problem], sizes.steps, QPAX)
    runs["qpax"] = lambda: vmapped(case.x0)[0]
    counts = {"LinearMPC": sizes.linear_mpc, "CVXPY": sizes.cvxpy}
    rows = compare(runs, exact, sizes.repeats, counts)
    said = qpax_says(vmapped, case.x0)
    rows = [row | (said if row["name"] == "qpax" else {}) for row in rows]
    show(f"1. One controller, {sizes.loops} loops of {sizes.steps} steps", rows, COLUMNS)
    print(f"  the first call of closed_loops, compilation included: {first_call:.2f} s")
    print(
        f"  qpax says that {said['says_converged']:.0%} of its solves converged, "
        f"{said['converged_to_nan']} of these to NaN"
    )
    return {"rows": rows, "first_call_seconds": first_call}


QPAX = 1e-6
"""Tolerance of qpax. At 1e-8 it is exact, but never says so and always takes all of its steps."""


def qpax_says(run: Callable[[np.ndarray], Any], x0: np.ndarray) -> dict[str, Any]:
    """Return how often qpax says that it converged, and how often with NaN."""
    u, converged = (np.asarray(a) for a in run(x0))
    wrong = np.isnan(u).any(-1) & (converged > 0)
    return {"says_converged": float((converged > 0).mean()), "converged_to_nan": int(wrong.sum())}


def many_controllers(case: Case) -> dict[str, Any]:
    """As many different controllers as states; the peers set up as many problems."""
    sizes, m = case.sizes, case.sizes.loops
    costs = QuadraticCost.random(6, 2, key=jax.random.key(1), shape=(m,))
    weights = np.asarray(costs.Q), np.asarray(costs.R)

    def ours(tol: float) -> np.ndarray:
        options: dict[str, Any] = {"horizon": HORIZON, "steps": sizes.steps, "tol": tol}
        runs = closed_loops(case.system, costs, case.x0[:, None], **options)
        return runs.trajectories.u[:, 0]

    def condense() -> list[peers.Condensed]:
        return peers.condensed(case.system, *weights, HORIZON)

    problems = condense()

    def loops(make: Callable[..., peers.Solve], given: Any, count: int) -> np.ndarray:
        each = []
        for problem, x in zip(given, case.x0[:count], strict=False):
            each.append(peers.closed_loops(case.system, make(problem), x[None], sizes.steps)[0])
        return np.concatenate(each)

    def linear(i: int) -> np.ndarray:
        return simulate(
            case.system, LinearMPC(case.system, costs[i], HORIZON), case.x0[i], sizes.steps
        ).u

    exact = loops(lambda p: peers.daqp_model(p, tight=True), problems, m)
    first_call = seconds_of(lambda: ours(1e-6))
    runs: dict[str, Run] = {
        name: lambda t=t: ours(t) for name, t in zip(OURS, (1e-6, 1e-8), strict=True)
    }
    for name, make in peers.MAKERS.items():
        runs[name] = lambda make=make: loops(make, condense(), m)
    runs["LinearMPC"] = lambda: np.stack([linear(i) for i in range(sizes.linear_mpc)])
    if sizes.repeats > 1:  # it takes long to compile
        vmapped = peers.qpax_loops(case.system, problems, sizes.steps, QPAX)
        runs["qpax"] = lambda: vmapped(case.x0)[0]
    rows = compare(runs, exact, sizes.repeats, {"LinearMPC": sizes.linear_mpc})
    prepare = {
        name: lambda make=make: [make(p) for p in condense()] for name, make in peers.MAKERS.items()
    }
    setup = medians(prepare, sizes.repeats)
    rows = [row | {"setup_seconds": setup.get(row["name"])} for row in rows]
    columns = COLUMNS | {"setup_seconds": "ms of it for setting up"}
    show(f"2. {m} different controllers, one loop each", rows, columns)
    return {"rows": rows, "first_call_seconds": first_call}


def single(case: Case) -> dict[str, Any]:
    """One state, one solve: here solvers in C win. Over several states, each on its own."""
    problem, x0 = case.condensed(), case.x0[: case.sizes.singles]
    batched = BatchedMPC(case.system, case.cost, HORIZON, tol=1e-6)
    linear = LinearMPC(case.system, case.cost, HORIZON)
    solvers: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "BatchedMPC.solve": lambda x: batched.solve(x).u,
        "LinearMPC.solve": lambda x: linear.solve(x).u,
    }
    for name, make in peers.MAKERS.items():
        solve = make(problem)
        solvers[name] = lambda x, solve=solve: solve(x)[1][:2].copy()  # PIQP hands out its own
    exact = peers.daqp_model(problem, tight=True)
    wanted = np.stack([exact(x)[1][:2] for x in x0])
    runs: dict[str, Run] = {
        name: lambda solve=solve: np.stack([solve(x) for x in x0])
        for name, solve in solvers.items()
    }
    found = {name: run() for name, run in runs.items()}
    seconds = medians(runs, case.sizes.repeats)
    rows = [
        {
            "name": name,
            "seconds": seconds[name] / len(x0),
            "largest_error": float(np.abs(found[name] - wanted).max()),
        }
        for name in runs
    ]
    rows = with_ratios(rows)
    columns = {k: v for k, v in COLUMNS.items() if k != "loops_run"}
    show(f"3. A single problem at a time, mean of {len(x0)} states", rows, columns)
    return {"rows": rows}


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    case = Case.of(MINI if mini else Sizes())
    return {
        "sizes": dataclasses.asdict(case.sizes) | {"horizon": HORIZON},
        "one_controller": one_controller(case),
        "many_controllers": many_controllers(case),
        "single": single(case),
    }
