"""Part "nonlinear": whose minima does nonlinear MPC find, and how long does a solve take?

1. 10 states of a lane change and of a pendulum on a cart: `NonlinearMPC` against CasADi with IPOPT
   (multiple shooting, a program of its own).
2. Time of a warm solve in closed loop, median and 99th percentile, by horizon.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import show

from prefmpc import (
    MLPCost,
    NonlinearMPC,
    Polyhedron,
    QuadraticCost,
    SignalCost,
    SumCost,
    cart_pendulum,
    kinematic_bicycle,
    steady_state,
)

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import multiple_shooting as peer

STATES = 10
HORIZONS = (10, 40)
STEPS = 25


def lane_change(horizon: int, network: bool = False) -> tuple[NonlinearMPC, dict]:
    """Return the controller of the car, and its set point as an argument of ``solve``."""
    car = kinematic_bicycle()
    reference = steady_state(car, peer.LANE, start=([3.5, 0, 0, 20], [0, 0]))
    cost = SignalCost(QuadraticCost(peer.CAR_Q, peer.CAR_R), "y")
    if network:
        scale = [3.5, 0.2, 0.05, 5, 0.4, 2]
        cost = SumCost([cost, MLPCost.random(scale, key=jax.random.key(1))])
    rows = np.eye(6)[2:4]
    limits = Polyhedron(
        np.concatenate([rows, -rows]), [*peer.CAR_HIGH, *(-b for b in peer.CAR_LOW)]
    )

    def lateral(x: jax.Array, u: jax.Array) -> jax.Array:
        a = x[3] ** 2 * jnp.tan(x[2]) / peer.LENGTH
        return jnp.stack([a - peer.LIMIT, -a - peer.LIMIT])

    controller = NonlinearMPC(car, cost, horizon, constraints=limits, path=lateral)
    return controller, {"reference": reference}


def swing_up(horizon: int) -> tuple[NonlinearMPC, dict]:
    """Return the controller of the pendulum."""
    cost = QuadraticCost(peer.PENDULUM_Q, peer.PENDULUM_R)
    return NonlinearMPC(cart_pendulum(), cost, horizon), {}


def compared(controller: NonlinearMPC, options: dict, states: Any, answers: Any) -> dict[str, Any]:
    """Count who ends where, and whether both ends are minima."""
    statuses: Counter[str] = Counter()
    row: dict[str, Any] = {"same": 0, "lower": 0, "higher": 0, "no_minimum": 0, "difference": 0.0}
    for x0, (status, cost, plan) in zip(states, answers, strict=True):
        controller.reset()
        ours = controller.solve(x0, **options)
        statuses[f"{ours.status} / {status}"] += 1
        if not ours.success:
            continue
        apart = float((ours.cost - cost) / abs(cost))
        if abs(apart) <= 1e-5:
            row["same"] += 1
            row["difference"] = max(row["difference"], abs(apart))
            continue
        row["lower" if apart < 0 else "higher"] += 1
        # Started at their plan, ours must stay at their cost: then both are minima.
        again = controller.solve(x0, start=plan, **options)
        row["no_minimum"] += not abs(again.cost - cost) <= 1e-5 * abs(cost)
    return row | {"statuses": ", ".join(f"{count} {s}" for s, count in statuses.items())}


def agreement(count: int, names: tuple[str, ...]) -> dict[str, Any]:
    """Solve the same problems by ours and by CasADi with IPOPT."""
    problems = {
        "lane change": (10, lane_change, peer.lane_change, peer.lane_changes),
        "pendulum": (40, swing_up, peer.swing_up, peer.swing_ups),
    }
    rows = []
    for name in names:
        horizon, make, their, draw = problems[name]
        states = draw(count, np.random.default_rng(1))
        solve = their(horizon)
        answers = [solve(x0) for x0 in states]
        rows.append({"name": name, "states": count} | compared(*make(horizon), states, answers))
    columns = {
        "name": "",
        "states": "states",
        "same": "same cost",
        "difference": "largest difference",
    }
    columns |= {"lower": "ours lower", "higher": "theirs lower", "no_minimum": "not both minima"}
    show("1. NonlinearMPC and CasADi with IPOPT", rows, columns | {"statuses": "ours / theirs"})
    return {"rows": rows}


def warm_solves(controller: NonlinearMPC, options: dict, x: Any) -> tuple[list[float], int]:
    """Return the seconds of each solve along a closed loop but the first, and the failures."""
    seconds: list[float] = []
    controller.solve(x, **options)  # compiles
    controller.reset()
    for k in range(STEPS + 1):
        answer = controller.solve(x, **options)
        if k:  # the first has no plan to start from
            seconds.append(answer.seconds)
        if not answer.success:
            return seconds, 1
        x = controller.system.step(x, answer.u)
    return seconds, 0


def times() -> dict[str, Any]:
    """Time warm solves in closed loop."""
    controllers = {
        "lane change": lane_change,
        "pendulum": swing_up,
        "lane change, MLP": lambda N: lane_change(N, network=True),
    }
    rows = []
    for name, make in controllers.items():
        states = peer.swing_ups if name == "pendulum" else peer.lane_changes
        for N in HORIZONS:
            x = states(1, np.random.default_rng(2))[0]
            seconds, failed = warm_solves(*make(N), x)
            middle, slow = (float(q) for q in np.quantile(seconds, [0.5, 0.99]))
            row = {"name": name, "N": N, "seconds": middle}
            rows.append(row | {"slow_seconds": slow, "failed": failed})
    columns = {"name": "", "N": "N", "seconds": "ms", "slow_seconds": "99 % below, ms"}
    show(f"2. A warm solve, median of {STEPS}", rows, columns | {"failed": "not solved"})
    return {"rows": rows}


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    if mini:
        return {"agreement": agreement(2, ("lane change",))}
    return {"agreement": agreement(STATES, ("lane change", "pendulum")), "times": times()}
