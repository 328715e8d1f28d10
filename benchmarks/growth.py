"""Part "growth": how time and memory of closed loops grow with the sizes of the problem.

One size at a time: states m, horizon N, state dimension nx (more masses), controllers c.
``seconds`` is the median of a call of the compiled program of `closed_loops` on arrays that are
ready, the answer copied out; ``memory_mb`` is what XLA plans for intermediate results and output.
``slope`` is the exponent of each, by least squares on logarithms over the upper half of the range.
``largest_error``: of the first loops, against DAQP at tolerances of 1e-12.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import peers
from measure import median, seconds_of, show, slope

from prefmpc import QuadraticCost, oscillating_masses, random_states
from prefmpc.mpc.batched import controllers, starts
from prefmpc.mpc.loops import _program

STEPS = 30
CHECKED = 2
"""Loops that are compared with DAQP."""

RANGES: dict[str, tuple[int, ...]] = {
    "m": (50, 1000, 20_000),
    "N": (5, 20, 80),
    "nx": (4, 16, 32),
    "c": (1, 30, 1000),
}
MINI: dict[str, tuple[int, ...]] = {"m": (4,)}


@dataclasses.dataclass(frozen=True)
class Size:
    """One problem: what is not varied has these sizes."""

    m: int = 200
    N: int = 10
    nx: int = 6
    c: int = 1


def point(size: Size, steps: int, repeats: int) -> dict[str, Any]:
    """Compile, run, check and measure one size."""
    masses = size.nx // 2
    system = oscillating_masses(np.ones(masses))
    weights = np.repeat([40.0, 5.0], masses) * np.geomspace(1, 2, size.c)[:, None]
    costs = QuadraticCost(
        weights[:, None] * np.eye(size.nx), np.tile(0.2 * np.eye(2), (size.c, 1, 1))
    )
    radius = np.repeat([0.3, 0.05], masses)
    x0 = random_states(radius, key=jax.random.key(0), shape=(size.m,))
    many = controllers(system, costs, None, None)
    begin, _ = starts(x0, size.nx, many)
    arguments = (*many, many.systems, begin, 1e-6)
    began: list[Any] = []
    compiling = seconds_of(
        lambda: began.append(_program(size.N, steps).lower(*arguments).compile())
    )
    program = began[0]
    out = jax.tree.map(np.asarray, program(*arguments))
    seconds = median(lambda: jax.tree.map(np.asarray, program(*arguments)), repeats)
    plan = program.memory_analysis()
    problem = peers.condensed(system, np.asarray(costs.Q)[:1], np.asarray(costs.R)[:1], size.N)[0]
    exact = peers.closed_loops(system, peers.daqp_model(problem, tight=True), x0[:CHECKED], steps)
    return {
        "seconds": seconds,
        "compiling_seconds": compiling,
        "memory_mb": (plan.temp_size_in_bytes + plan.output_size_in_bytes) / 2**20,
        "largest_error": float(np.abs(out.u[0, :CHECKED] - exact[0]).max()),
        "solved": float((out.codes == 0).mean()),
        "iterations": float(out.iterations.mean() / steps),
    }


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    results: dict[str, Any] = {}
    steps, repeats = (6, 1) if mini else (STEPS, 7)
    base = Size(m=4) if mini else Size()
    for name, values in (MINI if mini else RANGES).items():
        rows = []
        for value in values:
            # Controllers by the thousand have fewer states each.
            changed = {name: value} | ({"m": 10} if name == "c" else {})
            rows.append({name: value} | point(dataclasses.replace(base, **changed), steps, repeats))
        slopes = {
            key: slope(values, [row[key] for row in rows]) for key in ("seconds", "memory_mb")
        }
        results[name] = {"rows": rows, "slope": slopes}
        columns = {name: name, "seconds": "ms", "memory_mb": "MB", "largest_error": "error of u"}
        columns |= {
            "solved": "solved",
            "iterations": "iterations",
            "compiling_seconds": "compiling, ms",
        }
        show(f"Closed loops and {name}", rows, columns)
        print(f"  time ~ {name}^{slopes['seconds']:.2f}, memory ~ {name}^{slopes['memory_mb']:.2f}")
    return results
