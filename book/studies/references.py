"""Many set points: three people, several ways to learn, and what each is worth elsewhere."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import scipy.linalg

from prefmpc._random import generator
from prefmpc.evaluation import accuracy
from prefmpc.learning.convex import fit_map
from prefmpc.learning.early_stopping import fit_network
from prefmpc.learning.priors import bryson
from prefmpc.models.mlp import MLPCost
from prefmpc.models.quadratic import QuadraticCost, SumCost
from prefmpc.models.signals import SignalCost
from prefmpc.mpc import SteadyState
from prefmpc.mpc.loops import closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import by_criterion
from prefmpc.preferences.pools import random_states, random_weights
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.quadratic import RADIUS, ask_in_pairs, solved

HELD = 0.8
"""Largest force in N that it takes to hold a set point."""
JUDGED, HORIZON, LOOP = 20, 15, 30
"""Steps of the moves that people compare, of the plans, and of the closed loops."""
ANSWERS = 400
Q, R = np.diag([40.0, 40.0, 40.0, 5.0, 5.0, 5.0]), np.diag([2.0, 2.0])
REACH, FORCES = np.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0]), np.array([1.0, 1.0])
"""For Bryson's rule, in m, m/s and N."""
KNOTS = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])
"""Places of the middle mass, in m, between whose weights a σ that sees the set point mixes."""

PEOPLE = ("deviations", "force", "near the wall")
LEARNERS = (
    "one set point",
    "one set point, absolute force",
    "many set points",
    "many, absolute force",
    "many, sees the set point",
    "many, quadratic + network",
)
CONTROLLERS = LEARNERS[:-1]
"""What `references_case` runs in closed loop."""
FAR = SteadyState(np.array([0.4, 0.4, 0.4, 0, 0, 0]), np.array([0.8, 0.8]), np.full(3, 0.4))
"""All masses 0.4 m to the right."""


# ---- where the plant can rest, and moves from one such place to another ----


def set_points(system: LinearSystem, size: int, *, key: Any) -> SteadyState:
    """Draw set points that forces up to `HELD` hold; every part has the leading shape (size,)."""
    u = generator(key).uniform(-HELD, HELD, (size, system.nu))
    x = np.linalg.solve(np.eye(system.nx) - system.A, system.B @ u.T).T
    return SteadyState(x, u, x @ system.C.T)


def origin(system: LinearSystem, size: int) -> SteadyState:
    """Return the origin ``size`` times."""
    return SteadyState(*(np.zeros((size, n)) for n in (system.nx, system.nu, system.ny)))


def moves(system: LinearSystem, starts: np.ndarray, goals: SteadyState, *, key: Any) -> Trajectory:
    """Move from ``starts`` (m, nx) to the set points: random LQRs, forces cut at the bounds."""
    Qs, Rs = random_weights(system.nx, system.nu, key=key, shape=(len(starts),))
    gains = np.stack([system.lqr(*pair)[0] for pair in zip(Qs, Rs, strict=True)])
    x, u = [starts], []
    for _ in range(JUDGED):
        wanted = goals.u - np.einsum("mux,mx->mu", gains, x[-1] - goals.x)
        u.append(np.clip(wanted, system.u_min, system.u_max))
        x.append(system.step(x[-1], u[-1]))
    X, U = np.stack(x, axis=1), np.stack(u, axis=1)
    return Trajectory(X, U, system.output(X[:, :-1]), x_r=goals.x, u_r=goals.u, y_r=goals.y)


def options(size: int, *, key: Any, many: bool = True) -> Trajectory:
    """Return pairs of moves (size, 2) from the same state to the same set point.

    Parameters
    ----------
    many : bool
        Each pair has a set point of its own; otherwise all move to the origin.
    """
    system, streams = oscillating_masses(), generator(key).spawn(3)
    goals = set_points(system, size, key=streams[0]) if many else origin(system, size)
    starts = goals.x + random_states(RADIUS, key=streams[1], shape=(size,))
    twice = SteadyState(*(np.repeat(part, 2, axis=0) for part in (goals.x, goals.u, goals.y)))
    pool = moves(system, np.repeat(starts, 2, axis=0), twice, key=streams[2])
    return jax.tree.map(lambda leaf: leaf.reshape(size, 2, *leaf.shape[1:]), pool)


def asked(pairs: Trajectory, person: Any) -> Comparisons:
    """Ask a person, given by a criterion, about the pairs of `options`."""
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), pairs)
    return ask_in_pairs(flat, by_criterion(person))


# ---- who is asked ----


def minds_deviations(trajectory: Trajectory) -> np.ndarray:
    """Return Σ_k (x_k − x_r)ᵀQ(x_k − x_r) + (u_k − u_r)ᵀR(u_k − u_r)."""
    return np.asarray(phi(trajectory, Q, R))


def minds_force(trajectory: Trajectory) -> np.ndarray:
    """Return Σ_k (x_k − x_r)ᵀQ(x_k − x_r) + u_kᵀRu_k: what it costs to hold counts as well."""
    return np.asarray(phi(absolute_force(trajectory), Q, R))


def speed_weight(place: Any) -> Any:
    """Return the weight of squared velocities for set points with the middle mass at ``place``."""
    return 1 + 1000 * np.maximum(place, 0) ** 2


def gentle_near_the_wall(trajectory: Trajectory) -> np.ndarray:
    """Return what `minds_deviations` returns, with velocities that count more to the right."""
    dx, du = trajectory.deviation().x[..., :-1, :], trajectory.deviation().u
    weight = speed_weight(trajectory.x_r[..., 1])
    rest = 40 * (dx[..., :3] ** 2).sum((-1, -2)) + 2 * (du**2).sum((-1, -2))
    return rest + weight * (dx[..., 3:] ** 2).sum((-1, -2))


CRITERIA = dict(zip(PEOPLE, (minds_deviations, minds_force, gentle_near_the_wall), strict=True))


def known(person: str, place: float) -> QuadraticCost:
    """Return the weights of one of `PEOPLE` at a set point."""
    speed = speed_weight(place) if person == PEOPLE[2] else 5.0
    return QuadraticCost(np.diag([40.0] * 3 + [speed] * 3), R)


# ---- what σ is given to see ----


def absolute_force(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with u_r = 0: states as deviations, forces as they are."""
    return Trajectory(
        trajectory.x, trajectory.u, x_r=trajectory.x_r, u_r=np.zeros_like(trajectory.u_r)
    )


def shares(place: Any) -> np.ndarray:
    """Return how much of each of `KNOTS` is in ``place`` (...): (..., knots), in all 1."""
    eye = np.eye(len(KNOTS))
    return np.stack([np.interp(place, KNOTS, row) for row in eye], axis=-1)


def gated(trajectory: Trajectory) -> Trajectory:
    """Return one copy of the deviations for each knot, times the root of its share.

    A quadratic cost of these copies is Σ_i share_i·φ(T; Q_i, R_i): between the knots the weights
    are mixed.
    """
    roots = np.sqrt(shares(trajectory.x_r[..., 1]))[..., None, :, None]
    plain = trajectory.deviation()

    def copies(signal: np.ndarray) -> np.ndarray:
        many = roots * signal[..., None, :]
        return many.reshape(*many.shape[:-2], -1)

    return Trajectory(copies(plain.x), copies(plain.u))


def mixed(model: QuadraticCost, place: float) -> QuadraticCost:
    """Return what a model of `gated` signals is at one set point: an ordinary quadratic cost."""
    part, n = shares(place), len(KNOTS)
    nx, nu = (len(W) // n for W in (model.Q, model.R))
    Qs, Rs = np.reshape(np.diag(model.Q), (n, nx)), np.reshape(np.diag(model.R), (n, nu))
    return QuadraticCost(np.diag(part @ Qs), np.diag(part @ Rs))


VIEWS = dict(zip(LEARNERS, (None, absolute_force, None, absolute_force, gated, None), strict=True))


def viewed(data: Comparisons, learner: str) -> Comparisons:
    """Return the same answers about what a learner sees."""
    view = VIEWS[learner]
    if view is None:
        return data
    return Comparisons(view(data.trajectories), data.first, data.second, data.labels)


def learn(learner: str, data: Comparisons) -> QuadraticCost:
    """Return the most probable diagonal weights, as seen by one of `CONTROLLERS`."""
    copies = len(KNOTS) if VIEWS[learner] is gated else 1
    prior = bryson(np.tile(REACH, copies), np.tile(FORCES, copies))
    return fit_map(viewed(data, learner), prior, structure="diagonal").model


def learn_network(data: Comparisons, base: QuadraticCost, *, key: Any) -> Any:
    """Learn a quadratic that starts at ``base``, plus a network that sees x − x_r, u − u_r, x_r."""
    streams = generator(key).spawn(2)
    places = np.array([0.4, 0.4, 0.4, 1.0, 1.0, 1.0])
    scale = np.concatenate([REACH, places, FORCES])
    network = MLPCost.random(scale, key=streams[0], widths=(16,), shape=(4,))
    stack = jax.tree.map(lambda leaf: np.stack([leaf] * 4), base)
    starts: Any = SumCost([stack, SignalCost(network, ("x", "x_r"))])
    return fit_network(data, starts, key=streams[1]).model


def rest(cost: Any, goal: SteadyState, system: LinearSystem) -> np.ndarray:
    """Return the outputs (ny,) of the steady state with the smallest stage cost.

    Looks on a grid over the forces that hold a place, 0.02 N apart: 1 cm for all masses.
    """
    line = np.linspace(-1.0, 1.0, 101)
    u = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    x = np.linalg.solve(np.eye(system.nx) - system.A, system.B @ u.T).T
    still = Trajectory(np.stack([x, x], axis=1), u[:, None], x_r=goal.x, u_r=goal.u)
    return np.asarray(system.C @ x[np.argmin(np.asarray(cost(still)))])


# ---- control ----


def affine(system: LinearSystem, goal: SteadyState, absolute: bool) -> LinearSystem:
    """Return the plant in the state (x − x_r, 1): its input is u − u_r, or u itself."""
    A = scipy.linalg.block_diag(system.A, 1.0)
    if absolute:
        A[:-1, -1] = -system.B @ goal.u
    B = np.concatenate([system.B, np.zeros((1, system.nu))])
    shift = 0.0 if absolute else goal.u
    low, high = system.u_min - shift, system.u_max - shift
    return LinearSystem(A, B, dt=system.dt, u_min=low, u_max=high)


def controlled(
    system: LinearSystem,
    costs: list[QuadraticCost],
    goal: SteadyState,
    x0: np.ndarray,
    *,
    absolute: bool,
    steps: int = LOOP,
) -> Trajectory:
    """Return the closed loops (costs,) from x0 to one set point."""
    Qs = np.stack([scipy.linalg.block_diag(cost.Q, 0.0) for cost in costs])
    stack = QuadraticCost(Qs, np.stack([cost.R for cost in costs]))
    plant, start = affine(system, goal, absolute), np.append(x0 - goal.x, 1.0)[None]
    run = solved(closed_loops(plant, stack, start, horizon=HORIZON, steps=steps))[:, 0]
    x = run.x[..., :-1] + goal.x
    u = run.u if absolute else run.u + goal.u
    return Trajectory(x, u, system.output(x[:, :-1]), x_r=goal.x, u_r=goal.u, y_r=goal.y)


def each(points: SteadyState) -> list[SteadyState]:
    """Return the set points of a batch one by one."""
    parts = zip(points.x, points.u, points.y, strict=True)
    return [SteadyState(*part) for part in parts]


def references_case(
    *, key: Any, people: tuple[str, ...] = PEOPLE, loops: int = 40, network: bool = True
) -> dict[str, np.ndarray]:
    """Learn from each person in every way, and use what was learned at new set points.

    Parameters
    ----------
    people : some of `PEOPLE`; what comes of them does not depend on the others.
    network : bool
        Whether to train the network, which takes longest.

    Returns
    -------
    dict
        "accuracy" (people, learners): share of 1000 pairs of moves to new set points, each to its
        own, that the model answers as the person does; "cost" (people, controllers): what closed
        loops to ``loops`` new set points cost the person, relative to the MPC that knows the
        person; "short" (people, learners): by how many cm the middle mass stays short of the set
        point `FAR` in the steady state that σ likes best.
    """
    share, short = np.full((2, len(people), len(LEARNERS)), np.nan)
    cost = np.zeros((len(people), len(CONTROLLERS)))
    system, every = oscillating_masses(), generator(key).spawn(6)
    pools = [
        options(size, key=stream, many=many)
        for size, stream, many in zip(
            (1000, ANSWERS, ANSWERS), every, (True, False, True), strict=False
        )
    ]
    goals = each(set_points(system, loops, key=every[3]))
    off = random_states(RADIUS, key=every[4], shape=(loops,))
    streams = every[5].spawn(len(PEOPLE))
    for i, person in enumerate(people):
        criterion = CRITERIA[person]
        test, one, many = (asked(pool, criterion) for pool in pools)
        models: list[Any] = [
            learn(name, one if name.startswith("one") else many) for name in CONTROLLERS
        ]
        if network:
            stream = streams[PEOPLE.index(person)]
            models.append(learn_network(many, models[2], key=stream))
        for j, (name, model) in enumerate(zip(LEARNERS, models, strict=False)):
            share[i, j] = accuracy(model, viewed(test, name))
            short[i, j] = 100 * (FAR.y - rest(seen(model, name), FAR, system))[1]
        paid = [
            loop_costs(system, models, person, goal, goal.x + d)
            for goal, d in zip(goals, off, strict=True)
        ]
        cost[i] = np.mean(paid, axis=0)[:-1] / np.mean(paid, axis=0)[-1]
    return {"accuracy": share, "cost": cost, "short": short}


def seen(model: Any, learner: str) -> Any:
    """Return the model as a function of a trajectory with its set point."""
    view = VIEWS[learner]
    return model if view is None else lambda trajectory: model(view(trajectory))


def loop_costs(
    system: LinearSystem, models: list[Any], person: str, goal: SteadyState, x0: np.ndarray
) -> np.ndarray:
    """Return what the loops of all `CONTROLLERS`, then of the one that knows, cost a person."""
    place = float(goal.y[1])
    ready = [
        mixed(model, place) if VIEWS[name] is gated else model
        for name, model in zip(CONTROLLERS, models, strict=False)
    ] + [known(person, place)]
    absolute = np.array([VIEWS[n] is absolute_force for n in CONTROLLERS] + [person == PEOPLE[1]])
    values = np.zeros(len(ready))
    for reading in (False, True):
        chosen = np.flatnonzero(absolute == reading)
        stack = [ready[c] for c in chosen]
        run = controlled(system, stack, goal, x0, absolute=reading)
        values[chosen] = CRITERIA[person](run)
    return values
