"""What accuracy does not tell: both case studies measured in several ways, one draw a call."""

from __future__ import annotations

from typing import Any

import numpy as np

from prefmpc._pytree import stacked
from prefmpc._random import generator
from prefmpc.evaluation import accuracy, regret, win_rate
from prefmpc.learning.training import best_restart, fit
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc import BatchedMPC
from prefmpc.mpc.loops import closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import (
    Preference,
    SettlingTimePreference,
    erring,
    logistic,
)
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.quadratic import (
    QUADRATIC_HORIZON,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    error_rates,
    quadratic_data,
    the_person,
)
from studies.settling import SETTLING_HORIZON, diagonal_weights

SIZES = (20, 100, 400)
RATES = (0.05, 0.1, 0.2)
RANDOM = 10


BASELINES = ("random weights", "smaller ‖p(0)‖²")
BASELINE_COLUMNS = ("case 1, mixed", "case 1, same x(0)", "case 2, mixed", "case 2, same x(0)")
LEAK_COLUMNS = ("best, test", "best, fresh", "first, test", "first, fresh")
MODELS = (
    "From Π",
    *(f"random {i}" for i in range(RANDOM)),
    *(f"{kind}, n = {n}" for n in SIZES for kind in ("recipe", "converged", "same x(0)")),
    *(f"{100 * rate:g} % wrong, n = {n}" for n in SIZES[1:] for rate in RATES),
    *(f"unsure, n = {n}" for n in SIZES[1:]),
)
MODEL_COLUMNS = ("mixed %", "same x(0) %", "regret %", "wins %")
"""Accuracy on pairs of both kinds; mean regret φ₃₀ − min φ₃₀ in percent of the mean minimum; share
of states from which Π prefers the closed loop to that of a random controller."""


def starts_repeated(key: Any, starts: int, copies: int) -> np.ndarray:
    """Return states (starts · copies, nx): each random state ``copies`` times in a row."""
    return np.repeat(random_states(RADIUS, key=key, shape=(starts,)), copies, axis=0)


def first_position(trajectory: Trajectory) -> np.ndarray:
    """Return ‖p(0)‖²: a rule that looks at nothing that a controller does."""
    return (np.asarray(trajectory.x)[..., 0, :3] ** 2).sum(-1)


def same_start_data(
    system: LinearSystem, horizon: int, preference: Preference, size: int, rng: Any, **pool: Any
) -> Comparisons:
    """Return ``size`` pairs with the same x(0), of ``starts`` times ``copies`` trajectories."""
    starts, copies = pool.pop("starts"), pool.pop("copies")
    x0 = starts_repeated(rng, starts, copies)
    trajectories = lqr_pool(
        system, starts * copies, horizon, key=rng, x0=x0, saturate=False, **pool
    )
    return Comparisons.random(trajectories, preference, size, key=rng, same_start=True)


def unsure_scale(
    pool: Trajectory,
    error: float = 0.1,
    *,
    Q: np.ndarray = QUADRATIC_Q,
    R: np.ndarray = QUADRATIC_R,
) -> float:
    """Return the scale of `logistic` at which a person errs on ``error`` of random pairs of φ."""
    cost = np.asarray(phi(pool, Q, R))
    gap = np.abs(cost[:, None] - cost)[np.triu_indices(len(pool), 1)]
    low, high = 1e-6 * gap.max(), 1e3 * gap.max()
    for _ in range(60):
        middle = np.sqrt(low * high)
        wrong = (0.5 * (1 - np.tanh(gap / middle / 2))).mean()
        low, high = (middle, high) if wrong < error else (low, middle)
    return float(middle)


def baselines(*, key: Any) -> np.ndarray:
    """Return the accuracies (2, 4) in percent: rows `BASELINES`, columns `BASELINE_COLUMNS`."""
    rng = generator(key)
    cases = (
        (oscillating_masses(), QUADRATIC_HORIZON, the_person(), None),
        (oscillating_masses(u_max=np.inf), SETTLING_HORIZON, SettlingTimePreference(), True),
    )
    models = QuadraticCost.random(6, 2, key=rng, shape=(50,))
    table = []
    for system, horizon, preference, diagonal in cases:
        weights = [diagonal_weights(rng, n) if diagonal else None for n in (50, 200)]
        mixed = lqr_pool(
            system, 50, horizon, key=rng, radius=RADIUS, weights=weights[0], saturate=False
        )
        tests = [
            Comparisons.random(mixed, preference, 500, key=rng),
            same_start_data(
                *(system, horizon, preference, 500, rng), starts=50, copies=4, weights=weights[1]
            ),
        ]
        for test in tests:
            guess = 1 - error_rates(models, test).mean()
            table.append((guess, accuracy(first_position, test)))
    return 100 * np.array(table).T


def measures_case(
    *, key: Any, sizes: tuple[int, ...] = SIZES, loops: int = 200
) -> dict[str, np.ndarray]:
    """Learn in many ways from one draw of case study 1, and measure each model in four ways.

    Parameters
    ----------
    sizes : the first few of `SIZES`; what comes of them does not depend on the others.

    Returns
    -------
    dict
        "baselines" (2, 4), see `baselines`; "leak" (3, 4): accuracies in percent, rows ``sizes``,
        columns `LEAK_COLUMNS`, of the restart with the best accuracy on the test set and of the
        first one; "models" (n_models, 4): those rows of `MODELS` that were learned, columns
        `MODEL_COLUMNS`.
    """
    streams = generator(key).spawn(6)
    seed = int(streams[0].integers(2**32))
    system, pool, train, test = quadratic_data(key=np.random.default_rng(seed), sizes=sizes)
    fresh_pool = lqr_pool(
        system, 100, QUADRATIC_HORIZON, key=streams[1], radius=RADIUS, saturate=False
    )
    fresh = Comparisons.random(fresh_pool, the_person(), 2000, key=streams[1])
    same = same_start_data(
        *(system, QUADRATIC_HORIZON, the_person(), 500, streams[2]), starts=50, copies=4
    )
    rng = streams[3]
    models: dict[str, QuadraticCost] = {"From Π": QuadraticCost(QUADRATIC_Q, QUADRATIC_R)}
    random = QuadraticCost.random(system.nx, system.nu, key=rng, shape=(RANDOM,))
    models |= {f"random {i}": random[i] for i in range(RANDOM)}

    leak = []
    alike_pool = {"starts": 10, "copies": 5}
    for n in sizes:
        start = rng.integers(2**32)

        def train_on(data: Comparisons, start: int = int(start), **options: Any) -> Any:
            options = {"selection": "training_loss"} | options
            return fit(data, key=np.random.default_rng(start), **options)

        result = train_on(train[n], selection="leaky_test_accuracy", test=test)
        by_loss = best_restart(result.training_loss, result.status, result.training_loss)
        leak.append(
            [100 * accuracy(model, data) for model in (result.model, result.models[0])
             for data in (test, fresh)]
        )  # fmt: skip
        models[f"recipe, n = {n}"] = result.models[by_loss]
        far = train_on(train[n], restarts=4, tol=1e-7, max_iterations=5000)
        models[f"converged, n = {n}"] = far.model
        alike = same_start_data(system, QUADRATIC_HORIZON, the_person(), n, rng, **alike_pool)
        models[f"same x(0), n = {n}"] = train_on(alike).model
        if n == SIZES[0]:
            continue
        unsure = logistic(lambda T: phi(T, QUADRATIC_Q, QUADRATIC_R), unsure_scale(pool))
        people = {f"{100 * rate:g} % wrong, n = {n}": erring(the_person(), rate) for rate in RATES}
        for name, person in (people | {f"unsure, n = {n}": unsure}).items():
            answers = Comparisons.random(pool, person, n, key=rng).sampled(key=rng)
            models[name] = train_on(answers).model

    x0 = random_states(RADIUS, key=streams[4], shape=(loops,))
    ordered = [models[name] for name in MODELS if name in models]
    stack = stacked(ordered)
    runs = closed_loops(system, stack, x0, horizon=QUADRATIC_HORIZON, steps=30)
    best = BatchedMPC(system, models["From Π"], 30).solve(x0)
    if not (runs.solved.all() and best.success):
        raise RuntimeError("an MPC problem was not solved")
    table = np.empty((len(ordered), len(MODEL_COLUMNS)))
    table[:, 0] = 100 * (1 - error_rates(stack, test))
    table[:, 1] = 100 * (1 - error_rates(stack, same))
    lost = regret(models["From Π"], runs.trajectories, best.trajectory)
    table[:, 2] = 100 * lost.mean(axis=1) / np.asarray(best.cost).mean()
    rival = runs.trajectories[1 + np.arange(loops) % RANDOM, np.arange(loops)]
    table[:, 3] = [
        100 * win_rate(the_person(), runs.trajectories[i], rival).rate for i in range(len(ordered))
    ]
    return {"baselines": baselines(key=streams[5]), "leak": np.array(leak), "models": table}
