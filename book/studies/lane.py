"""A passenger in a car that changes lanes: peaks of acceleration and jerk against quickness."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._random import generator
from prefmpc.evaluation import accuracy, win_rate
from prefmpc.learning.convex import fit_map
from prefmpc.learning.priors import bryson
from prefmpc.learning.training import fit
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.models.separable import SeparableCost
from prefmpc.models.signals import SignalCost, select
from prefmpc.mpc import MPCError, NonlinearMPC, SteadyState
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import by_criterion
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import System
from prefmpc.systems.plants import kinematic_bicycle
from prefmpc.systems.sets import Polyhedron
from studies.quadratic import ask_in_pairs

SAMPLE, STEPS, LANE_HORIZON = 0.25, 32, 20
"""Sample time in s, steps of a drive (8 s), and the controller's horizon (5 s)."""

BAND = 0.3
"""In the lane from the moment on from which the car stays this near to its centre, in m."""

EASY_ACCELERATION, EASY_JERK, PATIENCE = 1.5, 2.5, 2.0
"""What costs the passenger one unit (peaks in m/s² and m/s³, waiting in s)."""

LATERAL_LIMIT = 4.0
"""Largest lateral acceleration in m/s², for the tyres."""

SIGNALS = ("y", "dy")
SCALE = np.array([2.0, 0.05, 0.5, 1.0, 0.15, 0.0066, 0.2, 0.1, 0.012, 1.0])
"""Sizes of y, Δy and u (position, heading, lateral acceleration, speed; steering, throttle)."""

LANE_SIGNALS = (
    *("position", "heading", "lateral acceleration", "speed"),
    *("lateral speed", "turn", "jerk", "speeding up", "steering rate", "throttle"),
)

ANSWERS = (50, 100, 400)
LANE_LEARNERS = ("separable", "quadratic")
GRID = {
    "lateral speed": (0.0, 0.3, 1.0, 3.0),
    "lateral acceleration": (0.0, 0.3, 1.0, 3.0),
    "jerk": (1.0, 3.0, 10.0, 30.0),
}
FINER = 3**0.5
TUNING_SEED = 100
"""Weights of a hand-tuned quadratic, beside 1 for the position in m²."""


def lane_car() -> System:
    """Return the car of the study."""
    return kinematic_bicycle(dt=SAMPLE)


@cache
def limits() -> dict[str, Any]:
    """Return the constraints: steering, speed, the road, and the grip of the tyres."""
    edge = np.array([6.0, 0.5, 0.5, 40.0, np.inf, np.inf])
    low = -edge
    low[3] = 0.0
    return {"constraints": Polyhedron.box(low, edge), "path": grip}


def grip(x: Any, u: Any) -> Any:
    """Return lateral acceleration minus its limit, both ways; not positive where tyres hold."""
    lateral = lane_car().output(x)[2]
    return jnp.stack([lateral - LATERAL_LIMIT, -lateral - LATERAL_LIMIT])


def peaks(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return peak lateral acceleration in m/s², peak jerk in m/s³, and time to the lane in s.

    A car that is not in its lane at the end counts with one and a half times the drive.
    """
    y = np.asarray(trajectory.deviation().y)
    offset, lateral = np.abs(y[..., 0]), y[..., 2]
    jerk = np.abs(np.diff(lateral, axis=-1)) / SAMPLE
    steps = offset.shape[-1]
    outside = offset > BAND
    since = np.argmax(outside[..., ::-1], axis=-1)
    arrival = np.where(outside.any(axis=-1), steps - since, 0)
    time = SAMPLE * np.where(outside[..., -1], 1.5 * steps, arrival)
    return np.abs(lateral).max(-1), jerk.max(-1), time


def discomfort(trajectory: Trajectory) -> np.ndarray:
    """Return what the passenger minds: (peak a/1.5)² + (peak jerk/2.5)² + time/2."""
    acceleration, jerk, time = peaks(trajectory)
    return (acceleration / EASY_ACCELERATION) ** 2 + (jerk / EASY_JERK) ** 2 + time / PATIENCE


PASSENGER = by_criterion(discomfort)


def scenarios(size: int, *, key: Any) -> np.ndarray:
    """Draw states (size, 4) from which to change lanes: 1 to 5 m away, 12 to 30 m/s fast."""
    rng = generator(key)
    side, way = rng.choice([-1.0, 1.0], size), rng.uniform(1, 5, size)
    x0 = np.zeros((size, 4))
    x0[:, 0], x0[:, 3] = side * way, rng.uniform(12, 30, size)
    return x0


def drives(x0: np.ndarray, *, key: Any) -> Trajectory:
    """Let a different driver drive from each state (m, 4): plans and temperaments vary.

    A driver has a smooth path of 1.5 to 5 s in mind, starts early or late, and corrects what is off
    it firmly or loosely: nobody strolls, since choices between slow drives say nothing about jerk.
    Drives beyond the grip of the tyres, or with a jerk above 10 m/s³, are
    driven again by another driver.
    """
    rng = generator(key)
    parts: list[np.ndarray] = []
    left = np.arange(len(x0))
    while left.size:
        drive = _drive(x0[left], rng)
        arrays = [np.asarray(array) for array in (drive.x, drive.u)]
        if not parts:
            parts = [array.copy() for array in arrays]
        for whole, array in zip(parts, arrays, strict=True):
            whole[left] = array
        acceleration, jerk, _ = peaks(drive)
        left = left[(acceleration > LATERAL_LIMIT) | (jerk > 10)]
    return _about_lane(parts[0], parts[1])


def _drive(x: np.ndarray, rng: np.random.Generator) -> Trajectory:
    car, m = lane_car(), len(x)
    start, v = x[:, 0].copy(), x[:, 3].copy()
    duration, skew = rng.uniform(1.5, 5, m), np.exp(rng.normal(0, 0.3, m))
    late, speed = rng.uniform(0, 0.7, m), np.exp(rng.uniform(0, np.log(2.5), m))
    damping = 1 + 2 * rng.uniform(0.6, 1.2, m)
    states, inputs = [x], []
    for k in range(STEPS):
        s = np.clip((k * SAMPLE - late) / duration, 0, 1) ** skew
        wanted = start * (1 - s**3 * (10 - 15 * s + 6 * s**2))
        lateral = v**2 * np.tan(x[:, 2]) / 2.7
        rates = (speed**3 * (x[:, 0] - wanted), damping * speed**2 * v * x[:, 1])
        jerk = -(rates[0] + rates[1] + damping * speed * lateral)
        u = np.stack([jerk * 2.7 / v**2, np.zeros(m)], axis=1)
        inputs.append(np.clip(u, car.u_min, car.u_max))
        x = car.step(x, inputs[-1])
        states.append(x)
    return _about_lane(np.stack(states, axis=1), np.stack(inputs, axis=1))


def _about_lane(x: np.ndarray, u: np.ndarray) -> Trajectory:
    """Return drives as trajectories whose set point is the lane, at the speed of the start."""
    x_r = np.zeros_like(x[:, 0])
    x_r[:, 3] = x[:, 0, 3]
    y = lane_car().output(x[:, :-1])
    return Trajectory(x, u, y, x_r=x_r, u_r=np.zeros_like(u[:, 0]), y_r=x_r)


def lane_pairs(size: int, *, key: Any) -> Comparisons:
    """Ask the passenger about ``size`` pairs of drives, each two from one state."""
    streams = generator(key).spawn(2)
    starts = scenarios(size, key=streams[0])
    pool = drives(np.repeat(starts, 2, axis=0), key=streams[1])
    return ask_in_pairs(pool, PASSENGER)


def fit_separable(data: Comparisons) -> SignalCost:
    """Learn a `SeparableCost` of y, Δy and u: a convex problem, hence one start."""
    start = SignalCost(SeparableCost.start(SCALE, shape=(1,)), SIGNALS)
    options: dict[str, Any] = {"l2": 1e-4, "learning_rate": 0.05, "tol": 1e-4}
    return fit(data, start, key=jax.random.key(0), selection="training_loss", **options).model


def fit_quadratic(data: Comparisons) -> SignalCost:
    """Learn a diagonal quadratic of the same signals, from the prior of Bryson's rule."""
    seen = Comparisons(select(data.trajectories, SIGNALS), data.first, data.second, data.labels)
    prior = bryson(3 * SCALE[:8], 3 * SCALE[8:])
    return SignalCost(fit_map(seen, prior, structure="diagonal").model, SIGNALS)


def by_hand(speed: float, acceleration: float, jerk: float) -> SignalCost:
    """Return the quadratic of a point of `GRID`: weights per unit of each signal, squared."""
    increments = np.array([speed, 0.0, jerk, 0.0]) / SAMPLE**2
    Q = np.diag([1.0, 0.0, acceleration, 1.0, *increments])
    return SignalCost(QuadraticCost(Q, 0.1 * np.eye(2)), SIGNALS)


def controlled_drives(cost: Any, x0: np.ndarray, steps: int = STEPS) -> tuple[Trajectory, Any]:
    """Drive with the MPC of a learned σ from every state (m, 4).

    Returns the drives and the seconds of every solve (m, steps). A failed solve raises an
    `MPCError`.
    """
    car = lane_car()
    controller = NonlinearMPC(car, cost, LANE_HORIZON, **limits())
    x, u = np.empty((len(x0), steps + 1, 4)), np.empty((len(x0), steps, 2))
    seconds = np.empty((len(x0), steps))
    x[:, 0] = x0
    for i, start in enumerate(x0):
        target = np.array([0.0, 0.0, 0.0, start[3]])
        lane = SteadyState(target, np.zeros(2), target)
        controller.reset()
        for k in range(steps):
            solution = controller.solve(x[i, k], reference=lane)
            if not solution.success:
                raise MPCError(solution)
            seconds[i, k] = solution.seconds
            u[i, k] = solution.u
            x[i, k + 1] = car.step(x[i, k], solution.u)
    return _about_lane(x, u), seconds


def excess(trajectory: Trajectory) -> np.ndarray:
    """Return by how much a drive breaks its limits at most, (m,); not positive if it does not."""
    sets, x, u = limits(), np.asarray(trajectory.x)[..., :-1, :], np.asarray(trajectory.u)
    Z = sets["constraints"]
    rows = np.concatenate([x, u], axis=-1) @ Z.H.T - Z.h
    tyres = np.abs(np.asarray(trajectory.y)[..., 2]) - LATERAL_LIMIT
    return np.maximum(rows.max((-1, -2)), tyres.max(-1))


def tuning_cost(setting: tuple[float, ...], x0: np.ndarray) -> float:
    """Return the mean discomfort of the drives of a hand-tuned setting."""
    return float(discomfort(controlled_drives(by_hand(*setting), x0)[0]).mean())


@cache
def tuned_by_hand() -> tuple[tuple[float, ...], float]:
    """Return the best setting of 64 on a grid and of finer ones around it, and its discomfort.

    All drive from the same eight states. More than a person could do: the passenger's own number
    is read, not asked for.
    """
    x0 = scenarios(8, key=jax.random.key(TUNING_SEED))
    best = min(itertools.product(*GRID.values()), key=lambda s: tuning_cost(s, x0))
    finer = itertools.product(*([w / FINER, w, w * FINER] if w else [0.0, 0.1] for w in best))
    costs = {setting: tuning_cost(setting, x0) for setting in finer}
    best = min(costs, key=lambda s: costs[s])
    return best, costs[best]


def lane_case(*, key: Any, states: int = 100) -> dict[str, np.ndarray]:
    """Learn σ from 50, 100 and 400 answers; drive with what 400 taught, and with the hand's best.

    The learned quadratic drives from a quarter of the states only.

    Returns
    -------
    dict
        "accuracy" (answers, learners) on 500 fresh pairs; "won" (learners, 3): share of the
        states from which the passenger prefers the learned σ to the hand-tuned one, with its 95 %
        interval; "discomfort" (3,): means of both learners' drives and the hand-tuned ones;
        "peaks" (3, 3): their mean peak acceleration, jerk and time; "excess" (3,): the largest
        violation of a limit; "setting" (3,) of the hand-tuned one; "curves" (3, signals): the
        weights of the separable σ.
    """
    setting, _ = tuned_by_hand()
    streams = generator(key).spawn(3)
    data, test = lane_pairs(max(ANSWERS), key=streams[0]), lane_pairs(500, key=streams[1])
    x0 = scenarios(states, key=streams[2])
    share = np.zeros((len(ANSWERS), len(LANE_LEARNERS)))
    for i, n in enumerate(ANSWERS):
        part = data.subset(np.arange(n))
        models = [fit_separable(part), fit_quadratic(part)]
        share[i] = [accuracy(model, test) for model in models]
    few = x0[: -(-states // 4)]
    starts, costs = (x0, few, x0), (*models, by_hand(*setting))
    runs = [controlled_drives(cost, start)[0] for cost, start in zip(costs, starts, strict=True)]
    rates = [win_rate(PASSENGER, run, runs[-1][: len(run)]) for run in runs[:-1]]
    return {
        "accuracy": share,
        "won": np.array([[rate.rate, rate.low, rate.high] for rate in rates]),
        "discomfort": np.array([discomfort(run).mean() for run in runs]),
        "peaks": np.array([[part.mean() for part in peaks(run)] for run in runs]),
        "excess": np.array([excess(run).max() for run in runs]),
        "setting": np.array(setting),
        "curves": np.asarray(models[0].model.c),
    }
