"""Which signals does σ need: states, outputs, or only x(0) and the inputs?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from prefmpc._random import generator
from prefmpc.evaluation import accuracy
from prefmpc.learning.convex import fit_map
from prefmpc.learning.priors import WishartPrior, bryson
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.models.signals import Signal, SignalCost, select
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import by_criterion
from prefmpc.preferences.pools import random_states, random_weights
from prefmpc.preferences.trajectories import Trajectory, phi, rollout
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.condensed import (
    blind_to_before,
    condensed_weights,
    learned_weights,
    trajectory_rows,
    weight_loops,
)
from studies.onesided import FORCES, REACH
from studies.quadratic import (
    QUADRATIC_HORIZON,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    ask_in_pairs,
    stacked_loops,
)

N = QUADRATIC_HORIZON
SIGNALS_SIZES = (20, 100, 400, 1000, 4000)
PEOPLE = {"states": QUADRATIC_Q, "outputs": np.diag([40.0, 40.0, 40.0, 0.0, 0.0, 0.0])}
"""Q of somebody who also minds velocities (case study 1), and of somebody who does not."""

CASES = (
    ("LQR", "states"),
    ("LQR", "outputs"),
    ("random inputs", "states"),
    ("moving starts", "states"),
)
"""Where the trajectories of the training pairs come from, and who answers."""

MOVING = np.array([0.3, 0.3, 0.3, 0.3, 0.3, 0.3])
"""Half-widths of x(0) where masses may move at the start, as on the way of a closed loop."""

LEARNERS = ("(X, U)", "(Y, U)", "(Y, ΔY, U)", "(x₀, U), told the plant", "(x₀, U)")
TESTS = ("same x(0)", "other x(0)", "random inputs")
"""Fresh LQR pairs from one start and from two, and fresh pairs with random inputs from one."""

ALONE = ("Bryson's rule", "Bryson's rule for outputs", "no input")
"""Controllers that ask nobody."""

SHARP = 10.0
"""Scale of all priors but one; a signal at its limit costs ten units of log-odds in each step."""

NAIVE_SCALE, NAIVE_STRENGTH = 100.0, 0.1
"""Of the prior of (x₀, U) without the plant, the best of eight on draws that are not reported."""

SMALL = 1e-4
"""R of the view (x₀, U); its input u_0 is one of its states too, and is weighed there."""

GAINS = 500
"""Random LQR controllers that the trajectories of one pool are made with."""

JERK = 20.0
"""Weight on ‖u_k − u_{k−1}‖² of the person who minds jerky inputs."""

JERK_SIZES = (100, 1000, 4000)
JERK_LEARNERS = ("(X, U)", "(X, ΔU, U)")


def plant_weights(system: LinearSystem, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the weights W (26, 26) over (x_0, U) that are σ(X, U) on the plant's trajectories."""
    known = np.r_[: system.nx, system.nx + system.nu : system.nx + (N + 1) * system.nu]
    W = condensed_weights(trajectory_rows(system, ["x"], N), Q, R)
    return W[np.ix_(known, known)]


def fresh_pairs(
    size: int,
    *,
    key: Any,
    inputs: str = "LQR",
    same_start: bool = True,
    radius: np.ndarray = RADIUS,
) -> Trajectory:
    """Return 2·size new trajectories; the pairs are 0 and 1, 2 and 3, … The input before is 0.

    ``inputs`` is "LQR" (two of `GAINS` random controllers, drawn as in the paper) or "random
    inputs", uniform in the bounds at every step.
    """
    streams = generator(key).spawn(2)
    system = oscillating_masses()
    x0 = random_states(radius, key=streams[0], shape=(size if same_start else 2 * size,))
    x0 = np.repeat(x0, 2, axis=0) if same_start else x0
    rest = np.zeros((2 * size, system.nu))
    if inputs == "LQR":
        gains = random_gains(system, min(2 * size, GAINS), key=streams[1])
        first = streams[1].integers(len(gains), size=size)
        second = (first + streams[1].integers(1, len(gains), size)) % len(gains)
        chosen = gains[np.stack([first, second], axis=1).ravel()]
        run = rollout(system, x0, chosen, N)
        return Trajectory(run.x, run.u, run.y, u_before=rest)
    u = streams[1].uniform(-1.0, 1.0, (2 * size, N, system.nu)) * system.u_max
    x = [x0]
    for k in range(N):
        x.append(system.step(x[-1], u[:, k]))
    X = np.stack(x, axis=1)
    return Trajectory(X, u, system.output(X[:, :-1]), u_before=rest)


def random_gains(system: LinearSystem, count: int, *, key: Any) -> np.ndarray:
    """Return LQR gains (count, nu, nx) for random weights."""
    Q, R = random_weights(system.nx, system.nu, key=key, shape=(count,))
    return np.stack([system.lqr(q, r)[0] for q, r in zip(Q, R, strict=True)])


def asked(pool: Trajectory, criterion: Any) -> Comparisons:
    """Ask somebody who wants ``criterion`` small about the pairs of `fresh_pairs`."""
    return ask_in_pairs(pool, by_criterion(criterion))


def person(who: str) -> Any:
    """Return what one of `PEOPLE` minimises."""
    return lambda T: np.asarray(phi(T, PEOPLE[who], QUADRATIC_R))


def jerk_person(trajectory: Trajectory) -> np.ndarray:
    """Return φ of case study 1 plus `JERK`·Σ‖u_k − u_{k−1}‖²."""
    steps = select(trajectory, ["du"]).x[..., :-1, :]
    return person("states")(trajectory) + JERK * np.asarray((steps**2).sum((-1, -2)))


def prior_of(learner: str) -> WishartPrior:
    """Return what each learner believes: Bryson's rule, in one form or another."""
    system = oscillating_masses()
    rule = bryson(REACH, FORCES, scale=SHARP)
    places, speeds = REACH[:3], REACH[3:]
    if learner == "(x₀, U), told the plant":
        return WishartPrior(plant_weights(system, rule.Q, rule.R), SMALL * np.eye(system.nu))
    if learner == "(x₀, U)":
        size = np.concatenate([REACH, np.tile(FORCES, N)])
        weights = np.diag(NAIVE_SCALE / size**2)
        return WishartPrior(weights, SMALL * np.eye(system.nu), NAIVE_STRENGTH)
    limits = {
        "(X, U)": REACH,
        "(Y, U)": places,
        "(Y, ΔY, U)": np.concatenate([places, speeds * system.dt]),
        "(X, ΔU, U)": np.concatenate([REACH, FORCES]),
    }[learner]
    return bryson(limits, FORCES, scale=SHARP)


SEEN: dict[str, tuple[Signal, ...]] = {
    "(X, U)": ("x",),
    "(Y, U)": ("y",),
    "(Y, ΔY, U)": ("y", "dy"),
    "(X, ΔU, U)": ("x", "du"),
    "(x₀, U), told the plant": ("x0",),
    "(x₀, U)": ("x0",),
}
"""What each learner sees besides the inputs."""


def learn(learner: str, data: Comparisons) -> SignalCost:
    """Return the σ that one learner makes of the answers."""
    view = select(data.trajectories, SEEN[learner])
    seen = Comparisons(view, data.first, data.second, data.labels)
    return SignalCost(fit_map(seen, prior_of(learner)).model, SEEN[learner])


def loops_of(
    system: LinearSystem, costs: Sequence[SignalCost], x0: np.ndarray, steps: int
) -> Trajectory:
    """Return the closed loops (c, m) of every σ, with the plant's model where σ needs it."""
    weights = []
    for cost in costs:
        if cost.signals == ("x0",):
            W = blind_to_before(learned_weights(cost.model, system.nx), system)
        else:
            Z = trajectory_rows(system, cost.signals, N)
            W = condensed_weights(Z, np.asarray(cost.model.Q), np.asarray(cost.model.R))
        weights.append(W)
    return weight_loops(system, weights, x0, steps)


def signals_case(
    *,
    key: Any,
    loops: int = 50,
    steps: int = 30,
) -> dict[str, np.ndarray]:
    """Learn from each view of the same answers, and control with what was learned.

    Returns
    -------
    dict
        "accuracy" (cases, sizes, learners, tests) and "regret" (cases, sizes, learners): the
        person's own cost of the closed loops relative to the MPC that knows the person, less 1;
        "alone" (cases, 3) the same for `ALONE`, "alone accuracy" (cases, 2, tests); "jerk
        accuracy" and "jerk regret" (sizes, learners) for the person who minds jerky inputs.
    """
    streams = generator(key).spawn(7)
    system = oscillating_masses()
    most = max(SIGNALS_SIZES)
    pools = {
        "LQR": fresh_pairs(most, key=streams[0]),
        "random inputs": fresh_pairs(most, key=streams[1], inputs="random inputs"),
        "moving starts": fresh_pairs(most, key=streams[6], radius=MOVING),
    }
    tests = [
        fresh_pairs(500, key=streams[2]),
        fresh_pairs(500, key=streams[3], same_start=False),
        fresh_pairs(500, key=streams[4], inputs="random inputs"),
    ]
    x0 = random_states(RADIUS, key=streams[5], shape=(loops,))
    share = np.zeros((len(CASES), len(SIGNALS_SIZES), len(LEARNERS), len(TESTS)))
    lost = np.zeros(share.shape[:-1])
    alone = np.zeros((len(CASES), len(ALONE)))
    alone_share = np.zeros((len(CASES), 2, len(TESTS)))
    for c, (source, who) in enumerate(CASES):
        data = {n: asked(pools[source][: 2 * n], person(who)) for n in SIGNALS_SIZES}
        checks = [asked(test, person(who)) for test in tests]
        costs = [learn(name, data[n]) for n in SIGNALS_SIZES for name in LEARNERS]
        share[c] = _shares(costs, checks).reshape(share[c].shape)
        known, rules = QuadraticCost(PEOPLE[who], QUADRATIC_R), alone_rules(system)
        free = rollout(system, x0, np.zeros((system.nu, system.nx)), steps)
        values = [*person(who)(loops_of(system, costs, x0, steps)), person(who)(free)]
        direct = stacked_loops(system, [known, *rules], x0, horizon=N, steps=steps)
        best, *by_rule = person(who)(direct).mean(axis=1)
        ratio = np.array([value.mean() for value in values]) / best - 1
        lost[c] = ratio[:-1].reshape(lost[c].shape)
        alone[c] = *(np.array(by_rule) / best - 1), ratio[-1]
        alone_share[c] = _shares(rules, checks)
    jerk_share, jerk_lost = _jerk(system, pools["LQR"], tests[0], x0, steps)
    return {
        **{"accuracy": share, "regret": lost, "alone": alone, "alone accuracy": alone_share},
        **{"jerk accuracy": jerk_share, "jerk regret": jerk_lost},
    }


def _shares(costs: Sequence[Any], checks: Sequence[Comparisons]) -> np.ndarray:
    return np.array([[accuracy(cost, check) for check in checks] for cost in costs])


def alone_rules(system: LinearSystem) -> list[QuadraticCost]:
    """Return Bryson's rule for (X, U) and for (Y, U), both as weights on states."""
    rule = bryson(REACH, FORCES)
    ny = system.ny
    return [QuadraticCost(Q, rule.R) for Q in (rule.Q, system.C.T @ rule.Q[:ny, :ny] @ system.C)]


def _jerk(
    system: LinearSystem, pool: Trajectory, test: Trajectory, x0: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    check = asked(test, jerk_person)
    data = {n: asked(pool[: 2 * n], jerk_person) for n in JERK_SIZES}
    shape = len(JERK_SIZES), len(JERK_LEARNERS)
    costs = [learn(name, data[n]) for n in JERK_SIZES for name in JERK_LEARNERS]
    runs = loops_of(system, [jerk_cost(), *costs], x0, steps)
    best, *values = jerk_person(runs).mean(axis=1)
    return _shares(costs, [check]).reshape(shape), (np.array(values) / best - 1).reshape(shape)


def jerk_cost() -> SignalCost:
    """Return `jerk_person` as a σ of (X, ΔU, U)."""
    Q = np.zeros((8, 8))
    Q[:6, :6], Q[6:, 6:] = QUADRATIC_Q, JERK * np.eye(2)
    return SignalCost(QuadraticCost(Q, QUADRATIC_R), ("x", "du"))
