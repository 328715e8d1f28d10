"""Terminal ingredients put to the test: many learned σ, many states, every step checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linprog

from prefmpc._random import generator
from prefmpc.evaluation import accuracy, simulate
from prefmpc.learning.convex import fit_map
from prefmpc.learning.priors import bryson
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc import LinearMPC, TerminalIngredients, terminal_ingredients
from prefmpc.mpc.loops import closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import QuadraticPreference
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import phi
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.onesided import REACH
from studies.quadratic import QUADRATIC_Q, QUADRATIC_R, RADIUS

PLANTS = ("pendulum", "masses")
HORIZONS = {"pendulum": 5, "masses": 10}
JUDGED, ANSWERS = 10, 100
"""Steps of the trajectories that people judge, and the number of their answers."""
REGRET_HORIZON, REGRET_STEPS = 10, 60
"""For what the person loses, with an N for which both plants are stable without ingredients."""
PENDULUM_RADIUS = np.array([0.2, 0.5])
"""x(0) of the pendulum (angle in rad, angular velocity in rad/s)."""
PENDULUM_Q, PENDULUM_R = np.diag([1.0, 0.01]), np.diag([10.0])
"""A person who likes gentle torques."""
PEOPLE = {"pendulum": (PENDULUM_Q, PENDULUM_R), "masses": (QUADRATIC_Q, QUADRATIC_R)}
RADII = {"pendulum": PENDULUM_RADIUS, "masses": RADIUS}
"""What x(0) is drawn from, for each plant."""
DIRECTIONS = {"pendulum": np.ones(2), "masses": REACH}
"""How far the states go on a ray, in proportion."""
STILL = 1e-6
CHECKS = ("largest state", "largest rise", "unsolved", "steps", "accuracy", "naive fails")


def pendulum() -> LinearSystem:
    """Return an inverted pendulum, linearised about upright: 0.2 kg on a rod of 0.5 m.

    States: angle in rad and angular velocity in rad/s; input: torque in N·m, at most 0.5; sampled
    every 0.05 s.
    """
    gravity, length, mass = 9.81, 0.5, 0.2
    return LinearSystem.from_continuous(
        np.array([[0.0, 1.0], [gravity / length, 0.0]]),
        np.array([[0.0], [1 / (mass * length**2)]]),
        dt=0.05,
        u_min=-0.5,
        u_max=0.5,
    )


def learned(plant: str, *, key: Any) -> tuple[LinearSystem, QuadraticCost, float]:
    """Return the plant, a σ from `ANSWERS` answers, and its accuracy on 500 pairs of new loops."""
    rng = generator(key)
    system = pendulum() if plant == "pendulum" else oscillating_masses()
    radius = RADII[plant]
    ask = QuadraticPreference(*PEOPLE[plant])
    pools = [
        lqr_pool(system, size, JUDGED, key=rng, radius=radius, saturate=False) for size in (50, 100)
    ]
    data = Comparisons.random(pools[0], ask, ANSWERS, key=rng)
    test = Comparisons.random(pools[1], ask, 500, key=rng)
    model = fit_map(data, bryson(radius, system.u_max), structure="diagonal").model
    return system, model, accuracy(model, test)


def feasible_states(
    system: LinearSystem, end: TerminalIngredients, horizon: int, size: int, *, key: Any, unit: Any
) -> np.ndarray:
    """Draw states (size, nx) from which X_N can be reached, on rays up to 99 % of the way out.

    How far a ray can go is a linear program of its own: max r such that x_N ∈ X_N for x_0 = r·d
    and some inputs within their bounds. ``unit`` (nx,) scales the directions.
    """
    rng = generator(key)
    power, columns = np.eye(system.nx), []
    for _ in range(horizon):
        columns.append(power @ system.B)
        power = power @ system.A
    reach = np.concatenate(columns[::-1], axis=1)
    box = np.tile(np.stack([system.u_min, system.u_max], axis=1), (horizon, 1))
    bounds = [(0, None), *map(tuple, box)]
    states = np.zeros((size, system.nx))
    for i in range(size):
        d = unit * rng.standard_normal(system.nx)
        rows = end.polyhedron.H @ np.concatenate([(power @ d)[:, None], reach], axis=1)
        goal = -np.eye(len(bounds))[0]
        far = linprog(goal, A_ub=rows, b_ub=end.polyhedron.h, bounds=bounds, method="highs")
        states[i] = rng.uniform(0.05, 0.99) * far.x[0] * d
    return states


def stability_case(
    *, key: Any, plants: tuple[str, ...] = PLANTS, loops: int = 200, limit: int = 400
) -> dict[str, np.ndarray]:
    """Learn σ for each plant, add terminal ingredients, and check every step of many closed loops.

    Returns
    -------
    dict
        "checks" (plants, 6), by `CHECKS`: the largest entry of any final state (loops stop below
        `STILL`, or after ``limit`` steps); the largest V(x⁺) − V(x) + ℓ(x, u) on the way,
        relative to 1 + V(x); number of problems that were not solved; longest loop; accuracy of σ;
        share of the same states from which MPC without the ingredients meets an infeasible
        problem or ends further out than it began. "rows": half-spaces of X_N. "regret" (plants,
        2): see `ingredients_regret`.
    """
    table, rows, lost = np.full((len(plants), len(CHECKS)), np.nan), [], []
    for i, plant in enumerate(plants):
        place, every = PLANTS.index(plant), generator(key).spawn(3 * len(PLANTS))
        streams = [*every[2 * place : 2 * place + 2], every[2 * len(PLANTS) + place]]
        system, cost, share = learned(plant, key=streams[0])
        end = terminal_ingredients(system, cost)
        options: dict[str, Any] = {"key": streams[1], "unit": DIRECTIONS[plant]}
        x0 = feasible_states(system, end, HORIZONS[plant], loops, **options)
        cured = LinearMPC(system, cost, HORIZONS[plant], terminal=end)
        outcomes = [follow(cured, x, limit) for x in x0]
        final, rise, unsolved, steps = np.array(outcomes).T
        table[i] = [
            final.max(),
            rise.max(),
            unsolved.sum(),
            steps.max(),
            share,
            naive(system, cost, x0, HORIZONS[plant]),
        ]
        rows.append(len(end.polyhedron.h))
        lost.append(ingredients_regret(plant, system, cost, end, key=streams[2]))
    return {"checks": table, "rows": np.array(rows), "regret": np.array(lost)}


def ingredients_regret(
    plant: str,
    system: LinearSystem,
    cost: QuadraticCost,
    end: TerminalIngredients,
    *,
    key: Any,
    loops: int = 30,
) -> list[float]:
    """Return what MPC with the bare σ, and with the ingredients, costs the person.

    Mean φ of closed loops of `REGRET_STEPS`, relative to that of the MPC that knows the person's
    weights and looks ahead as far. States are those that people judge, cut down to where the
    ingredients leave a plan.
    """
    cured = LinearMPC(system, cost, REGRET_HORIZON, terminal=end)
    x0 = random_states(RADII[plant], key=key, shape=(loops,))
    x0 = x0[[cured.solve(x).success for x in x0]]
    person = QuadraticCost(*PEOPLE[plant])
    best = closed_loops(system, person, x0, horizon=REGRET_STEPS, steps=REGRET_STEPS)
    bare = closed_loops(system, cost, x0, horizon=REGRET_HORIZON, steps=REGRET_STEPS)
    runs = [best.trajectories, bare.trajectories, simulate(system, cured, x0, REGRET_STEPS)]
    values = [float(np.mean(phi(run, *PEOPLE[plant]))) for run in runs]
    return [value / values[0] for value in values[1:]]


def follow(controller: LinearMPC, x0: np.ndarray, limit: int) -> tuple[float, float, int, int]:
    """Run a closed loop to `STILL`; see `stability_case` for what is returned."""
    system, Q, R = controller.system, controller.cost.Q, controller.cost.R
    x, rise, before = x0, -np.inf, None
    for step in range(limit + 1):
        solution = controller.solve(x)
        if not solution.success:
            return float(np.abs(x).max()), rise, 1, step
        if before is not None:
            value, first = before
            rise = max(rise, (solution.cost - value + first) / (1 + value))
        if np.abs(x).max() < STILL or step == limit:
            break
        u = solution.u
        before = solution.cost, x @ Q @ x + u @ R @ u
        x = system.A @ x + system.B @ u
    return float(np.abs(x).max()), rise, 0, step


def naive(system: LinearSystem, cost: QuadraticCost, x0: np.ndarray, horizon: int) -> float:
    """Return the share of states from which MPC with the bare σ does not come home."""
    runs = closed_loops(system, cost, x0, horizon=horizon, steps=100)
    end = np.abs(runs.trajectories.x[:, -1]).max(axis=-1)
    return float(np.mean(~(end < np.abs(x0).max(axis=-1))))
