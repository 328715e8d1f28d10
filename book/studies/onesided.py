"""A person whom no quadratic can represent: what is on the wall's side counts ten times."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import scipy.linalg

from prefmpc._random import generator
from prefmpc.evaluation import accuracy, simulate
from prefmpc.learning.convex import fit_map
from prefmpc.learning.priors import bryson
from prefmpc.learning.training import fit
from prefmpc.models.networks import ICNNCost
from prefmpc.models.quadratic import QuadraticCost, SumCost
from prefmpc.mpc import ConvexMPC
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import by_criterion
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.condensed import responses
from studies.quadratic import QUADRATIC_HORIZON, RADIUS, ask_in_pairs, stacked_loops

WALL_SIDE, FREE_SIDE, EFFORT = 100.0, 10.0, 0.2
REACH = np.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
"""What the states of the swinging masses reach, in m and m/s, for Bryson's rule."""

FORCES = np.array([1.0, 1.0])

LEARNERS = (
    "quadratic, full",
    "quadratic, diagonal",
    "quadratic, recipe",
    "quadratic with an offset",
    "network",
    "quadratic + network",
)
CONTROLLERS = ("best quadratic", *LEARNERS[3:], "knows the person")
"""What `onesided_case` runs in closed loop; the first is the most accurate of three."""
ONESIDED_SIZES = (100, 400, 1000)


def one_sided(trajectory: Trajectory) -> np.ndarray:
    """Return Σ_k Σ_i w(p_i)·p_i² + 0.2 ‖u_k‖², with w = 100 where p_i > 0 and 10 elsewhere."""
    p, u = np.asarray(trajectory.x)[..., :-1, :3], np.asarray(trajectory.u)
    weight = np.where(p > 0, WALL_SIDE, FREE_SIDE)
    return (weight * p**2).sum((-1, -2)) + EFFORT * (u**2).sum((-1, -2))


ONE_SIDED = by_criterion(one_sided)
"""The person."""


def option_pairs(size: int, *, key: Any, person: Any = ONE_SIDED) -> Comparisons:
    """Ask about ``size`` pairs of two new trajectories with the same x(0): nothing comes twice."""
    streams = generator(key).spawn(2)
    starts = random_states(RADIUS, key=streams[0], shape=(size,))
    pool = lqr_pool(
        oscillating_masses(),
        2 * size,
        QUADRATIC_HORIZON,
        key=streams[1],
        x0=np.repeat(starts, 2, axis=0),
        saturate=False,
    )
    return ask_in_pairs(pool, person)


def fit_network(data: Comparisons, *, key: Any, base: QuadraticCost | None = None) -> Any:
    """Learn a network of eight units, or the sum of one and a quadratic that starts at ``base``.

    The units are squared ReLUs without bias, so that σ is least at the origin. The best of four
    starts by the cross-entropy of held-out answers.
    """
    pool, streams = data.trajectories, generator(key).spawn(2)
    size = [np.abs(signal).max((0, 1)) for signal in (pool.x, pool.u)]
    starts: Any = ICNNCost.random(
        np.concatenate(size),
        key=streams[0],
        widths=(8,),
        shape=(4,),
        floor=0.01,
        activation="squared_relu",
        bias=False,
    )
    if base is not None:
        starts = SumCost([jax.tree.map(lambda leaf: np.stack([leaf] * 4), base), starts])
    options: dict[str, Any] = {"l2": 1e-4, "adam_steps": 1000, "max_iterations": 100, "tol": 1e-2}
    return fit(data, starts, key=streams[1], **options).model


def with_constant(trajectory: Trajectory) -> Trajectory:
    """Append the state 1, so that a quadratic can have a centre of its own."""
    ones = np.ones((*np.shape(trajectory.x)[:-1], 1))
    return Trajectory(np.concatenate([trajectory.x, ones], axis=-1), trajectory.u)


def extended(data: Comparisons) -> Comparisons:
    """Return the same pairs and answers, with the state 1 appended."""
    return Comparisons(with_constant(data.trajectories), data.first, data.second, data.labels)


def constant_system(system: LinearSystem) -> LinearSystem:
    """Return the plant with one more state, which stays as it is."""
    A = scipy.linalg.block_diag(system.A, 1.0)
    B = np.concatenate([system.B, np.zeros((1, system.nu))])
    return LinearSystem(A, B, dt=system.dt, u_min=system.u_min, u_max=system.u_max)


def fit_offset(data: Comparisons) -> QuadraticCost:
    """Learn a quadratic with a centre of its own: σ of (x, 1)."""
    return fit_map(extended(data), bryson(np.append(REACH, 0.3), FORCES)).model


def person_loops(system: LinearSystem, x0: np.ndarray, steps: int) -> Trajectory:
    """Run the MPC that minimises `one_sided` itself: what the best learner could do."""
    N = QUADRATIC_HORIZON
    Phi, Gamma = responses(system, N)
    Phi, Gamma = Phi[:, :3], Gamma[:, :3].reshape(3 * N, -1)
    L = 2 * WALL_SIDE * np.linalg.norm(Gamma, 2) ** 2 + 2 * EFFORT
    low, high = np.tile(system.u_min, N), np.tile(system.u_max, N)
    x, states, inputs = x0, [x0], []
    for _ in range(steps):
        free = np.einsum("kpx,mx->mkp", Phi, x).reshape(len(x), -1)
        U = V = np.zeros((len(x), Gamma.shape[1]))
        for i in range(400):  # accelerated projected gradient
            p = free + V @ Gamma.T
            slope = 2 * (np.where(p > 0, WALL_SIDE, FREE_SIDE) * p) @ Gamma + 2 * EFFORT * V
            before, U = U, np.clip(V - slope / L, low, high)
            V = U + i / (i + 3) * (U - before)
        inputs.append(U[:, : system.nu])
        x = x @ system.A.T + inputs[-1] @ system.B.T
        states.append(x)
    return Trajectory(np.stack(states, axis=1), np.stack(inputs, axis=1))


def onesided_case(
    *, key: Any, sizes: tuple[int, ...] = ONESIDED_SIZES, loops: int = 200, steps: int = 30
) -> dict[str, np.ndarray]:
    """Learn from the one-sided person in every way, and control with what was learned.

    Returns
    -------
    dict
        "accuracy" (sizes, learners): share of 1000 fresh pairs with the same x(0) that the model
        answers as the person does; "cost" (sizes, controllers): mean `one_sided` of closed loops
        relative to the MPC that knows the person; "won" (sizes, controllers): share of the loops
        that the person prefers to those of the best quadratic from the same x(0); "best" (sizes,):
        which quadratic was best.
    """
    streams = generator(key).spawn(4)
    system = oscillating_masses()
    test = option_pairs(1000, key=streams[0])
    everything = option_pairs(max(ONESIDED_SIZES), key=streams[1])
    x0 = random_states(RADIUS, key=streams[2], shape=(loops,))
    known = one_sided(person_loops(system, x0, steps))
    fits = dict(zip(ONESIDED_SIZES, streams[3].spawn(len(ONESIDED_SIZES)), strict=True))
    share = np.zeros((len(sizes), len(LEARNERS)))
    cost, won = np.zeros((2, len(sizes), len(CONTROLLERS)))
    for i, n in enumerate(sizes):
        models = learn(everything.subset(np.arange(n)), test, key=fits[n])
        share[i] = [
            accuracy(model, extended(test) if name == LEARNERS[3] else test)
            for name, model in models.items()
        ]
        values = [*controlled(system, models, LEARNERS[np.argmax(share[i, :3])], x0, steps), known]
        cost[i] = [value.mean() / known.mean() for value in values]
        won[i] = [np.mean(value < values[0]) for value in values]
    return {"accuracy": share, "cost": cost, "won": won, "best": np.argmax(share[:, :3], axis=1)}


def learn(data: Comparisons, test: Comparisons, *, key: Any) -> dict[str, Any]:
    """Return what each of `LEARNERS` learns; only the recipe sees ``test``."""
    streams = generator(key).spawn(3)
    prior = bryson(REACH, FORCES)
    full, diagonal = (fit_map(data, prior, structure=s).model for s in ("full", "diagonal"))
    recipe = fit(data, key=streams[0], selection="leaky_test_accuracy", test=test).model
    network = fit_network(data, key=streams[1])
    both = fit_network(data, key=streams[2], base=diagonal)
    return dict(
        zip(LEARNERS, (full, diagonal, recipe, fit_offset(data), network, both), strict=True)
    )


def controlled(
    system: LinearSystem, models: dict[str, Any], best: str, x0: np.ndarray, steps: int
) -> list[np.ndarray]:
    """Return `one_sided` (m,) of the closed loops of all `CONTROLLERS` but the last."""
    N = QUADRATIC_HORIZON
    plain = stacked_loops(system, [models[best]], x0, horizon=N, steps=steps)[0]
    starts = np.concatenate([x0, np.ones((len(x0), 1))], axis=1)
    offset = models[LEARNERS[3]]
    moved = stacked_loops(constant_system(system), [offset], starts, horizon=N, steps=steps)[0]
    networks = [
        simulate(system, ConvexMPC(system, models[name], N), x0, steps) for name in LEARNERS[4:]
    ]
    return [one_sided(run) for run in (plain, moved, *networks)]
