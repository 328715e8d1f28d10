"""Nonlinear MPC: whose minima does it find, and how long does a solve take? ``make bench``.

1. 50 states of a lane change and of a pendulum on a cart: `NonlinearMPC` by both solvers against
   CasADi with IPOPT (multiple shooting, a program of its own).
2. Time of a warm solve in closed loop, median and 99th percentile, by horizon and solver.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

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

STATES = 50
HORIZONS = (10, 20, 40)
LOOPS, STEPS = 2, 25
SOLVERS = ("slsqp", "ipopt")


def lane_change(horizon: int, solver: str, network: bool = False) -> tuple[NonlinearMPC, dict]:
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

    controller = NonlinearMPC(car, cost, horizon, constraints=limits, path=lateral, solver=solver)
    return controller, {"reference": reference}


def swing_up(horizon: int, solver: str) -> tuple[NonlinearMPC, dict]:
    """Return the controller of the pendulum."""
    cost = QuadraticCost(peer.PENDULUM_Q, peer.PENDULUM_R)
    return NonlinearMPC(cart_pendulum(), cost, horizon, solver=solver), {}


def agreement() -> None:
    """Solve the same problems by all, and count who ends where."""
    print(f"1. {STATES} states each, N = 10 and 40: NonlinearMPC and CasADi with IPOPT")
    print(f"   {'':24s}{'same':>7s}{'ours is':>10s}{'theirs is':>11s}   statuses")
    print(f"   {'':24s}{'cost':>7s}{'lower':>10s}{'lower':>11s}")
    problems = {
        "lane change": (10, lane_change, peer.lane_change, peer.lane_changes),
        "pendulum": (40, swing_up, peer.swing_up, peer.swing_ups),
    }
    for name, (horizon, make, their, draw) in problems.items():
        states = draw(STATES, np.random.default_rng(1))
        solve = their(horizon)
        answers = [solve(x0) for x0 in states]
        for solver in SOLVERS:
            controller, options = make(horizon, solver)
            statuses: Counter[str] = Counter()
            same = lower = higher = inexact = 0
            largest = 0.0
            for x0, (status, cost, plan) in zip(states, answers, strict=True):
                controller.reset()
                ours = controller.solve(x0, **options)
                statuses[f"{ours.status} / {status}"] += 1
                if not ours.success:
                    continue
                apart = (ours.cost - cost) / abs(cost)
                if abs(apart) <= 1e-5:
                    same += 1
                    largest = max(largest, abs(apart))
                    continue
                lower, higher = lower + (apart < 0), higher + (apart > 0)
                # Started at their plan, ours must stay at their cost: then both are minima.
                again = controller.solve(x0, start=plan, **options)
                inexact += not abs(again.cost - cost) <= 1e-5 * abs(cost)
            row = f"{same:7d}{lower:10d}{higher:11d}   "
            row += ", ".join(f"{count} {s}" for s, count in statuses.items())
            print(f"   {f'{name}, {solver}':24s}{row}", flush=True)
            print(
                f"   {'':24s}largest relative difference where the cost is the same {largest:.0e}; "
                f"{inexact} of the others no minimum of both"
            )
    print()


def times() -> None:
    """Print the table of solve times."""
    controllers = {
        "lane change": lane_change,
        "pendulum": swing_up,
        "lane change, MLP": lambda N, solver: lane_change(N, solver, network=True),
    }
    print(f"2. ms for a warm solve, median / 99th percentile of {LOOPS * STEPS}")
    print("   " + " " * 24 + "".join(f"{f'N = {N}':>16s}" for N in HORIZONS) + "   not solved")
    for name, make in controllers.items():
        states = peer.swing_ups if name == "pendulum" else peer.lane_changes
        for solver in SOLVERS:
            row, failed = [], 0
            for N in HORIZONS:
                controller, options = make(N, solver)
                controller.solve(states(1, np.random.default_rng(0))[0], **options)  # compiles
                seconds = []
                for x in states(LOOPS, np.random.default_rng(2)):
                    controller.reset()
                    for k in range(STEPS + 1):
                        answer = controller.solve(x, **options)
                        if k:  # the first has no plan to start from
                            seconds.append(answer.seconds)
                        if not answer.success:
                            failed += 1
                            break
                        x = controller.system.step(x, answer.u)
                median, slow = np.quantile(1e3 * np.array(seconds), [0.5, 0.99])
                row.append(f"{f'{median:.1f} / {slow:.1f}':>16s}")
            print(f"   {f'{name}, {solver}':24s}" + "".join(row) + f"{failed:13d}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    agreement()
    times()
