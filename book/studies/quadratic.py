"""The first case study of arXiv 2511.22502: the person is a quadratic cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from prefmpc._pytree import stacked
from prefmpc._random import generator
from prefmpc.evaluation import accuracy
from prefmpc.learning.training import FitResult, Selection, best_restart, fit
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.loops import ClosedLoops, closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import Preference, QuadraticPreference
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory, phi
from prefmpc.systems.linear import LinearSystem, oscillating_masses

RADIUS = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])
"""Half-widths of the uniform distribution of x(0) in metres, then in metres per second."""

QUADRATIC_Q = np.diag([40.0, 40.0, 40.0, 5.0, 5.0, 5.0])
QUADRATIC_R = np.diag([0.2, 0.2])
QUADRATIC_HORIZON = 10
SIZES = (20, 60, 100, 400, 1000)

COLUMNS = ("train %", "test %", "time s", "mean φ", "max φ", "min φ")
PAPER_TABLE_I: dict[str, tuple[float | None, ...]] = {
    "From Π": (None, None, None, 1.000, 4.426, 0.054),
    "Random": (None, 82.6, None, 1.833, 10.532, 0.106),
    "σ₂₀": (100.0, 92.0, 1.13, 1.355, 5.491, 0.086),
    "σ₆₀": (100.0, 94.8, 1.13, 1.108, 4.598, 0.059),
    "σ₁₀₀": (98.0, 95.0, 1.16, 1.230, 5.192, 0.059),
    "σ₄₀₀": (100.0, 99.4, 1.53, 1.043, 4.536, 0.057),
    "σ₁₀₀₀": (100.0, 99.8, 1.87, 1.013, 4.404, 0.056),
}
ROWS = tuple(PAPER_TABLE_I)


@dataclasses.dataclass(frozen=True)
class QuadraticDraw:
    """One draw of case study 1.

    Attributes
    ----------
    system : LinearSystem
    pool : Trajectory
        The 50 training trajectories.
    train : dict of int to Comparisons, by size
    test : Comparisons
        500 pairs.
    fits : dict of int to FitResult, by size
    phi : dict of str to array (200,)
        φ₃₀ of each closed loop, by row of Table I, divided by the mean of the row "From Π".
    loops : dict of str to Trajectory
        The closed loops themselves, leading dimension 200.
    table : array (7, 6)
        Rows `ROWS`, columns `COLUMNS`; NaN where the paper has a dash.
    """

    system: LinearSystem
    pool: Trajectory
    train: dict[int, Comparisons]
    test: Comparisons
    fits: dict[int, FitResult]
    phi: dict[str, np.ndarray]
    loops: dict[str, Trajectory]
    table: np.ndarray


def quadratic_data(
    *, key: Any, sizes: tuple[int, ...] = SIZES, shared_pool: bool = False
) -> tuple[LinearSystem, Trajectory, dict[int, Comparisons], Comparisons]:
    """Return the plant, the training pool, the training data by size, and the test data.

    The paper does not say whether test pairs come from the 50 training trajectories
    (``shared_pool``) or from others (default).
    """
    streams = generator(key).spawn(3 + len(sizes))
    system = oscillating_masses()
    preference = the_person()

    def make_pool(pool_key: Any) -> Trajectory:
        return lqr_pool(system, 50, QUADRATIC_HORIZON, key=pool_key, radius=RADIUS, saturate=False)

    pool = make_pool(streams[0])
    test_pool = pool if shared_pool else make_pool(streams[1])
    test = Comparisons.random(test_pool, preference, 500, key=streams[2])
    train = {
        n: Comparisons.random(pool, preference, n, key=k)
        for n, k in zip(sizes, streams[3:], strict=True)
    }
    return system, pool, train, test


def error_rates(models: QuadraticCost, comparisons: Comparisons) -> np.ndarray:
    """Return 1 − accuracy on ``comparisons`` for every model of a stack (c,)."""
    return np.array([1 - accuracy(models[i], comparisons) for i in range(models.batch_shape[0])])


def the_person() -> QuadraticPreference:
    """Return Π of case study 1."""
    return QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)


def ask_in_pairs(pool: Trajectory, person: Preference) -> Comparisons:
    """Ask about the trajectories 0 and 1, 2 and 3, … of a pool: none comes twice."""
    first = np.arange(0, len(pool), 2)
    return Comparisons(pool, first, first + 1, person(pool[first], pool[first + 1]))


def stacked_loops(
    system: LinearSystem, models: Sequence[QuadraticCost], x0: Any, *, horizon: int, steps: int
) -> Trajectory:
    """Return the closed loops (c, m) of c models from the states x0 (m, nx).

    Raises a RuntimeError if an MPC problem on the way is not solved.
    """
    stack = stacked(models)
    return solved(closed_loops(system, stack, x0, horizon=horizon, steps=steps))


def solved(runs: ClosedLoops) -> Trajectory:
    """Return the trajectories, or raise a RuntimeError if an MPC problem was not solved."""
    if not runs.solved.all():
        raise RuntimeError("a closed loop met an MPC problem that was not solved")
    return runs.trajectories


def quadratic_case(
    *,
    key: Any,
    selection: Selection = "leaky_test_accuracy",
    restarts: int = 20,
    tol: float = 1e-3,
    shared_pool: bool = False,
    loops: int = 200,
    steps: int = 30,
) -> QuadraticDraw:
    """Run case study 1 once: data, five training sets, 200 closed loops for each controller."""
    key_data, key_fit, key_states, key_random = generator(key).spawn(4)
    system, pool, train, test = quadratic_data(key=key_data, shared_pool=shared_pool)
    fit_keys = key_fit.spawn(len(SIZES))
    leaked = test if selection == "leaky_test_accuracy" else None
    fits = {
        n: fit(train[n], key=k, restarts=restarts, selection=selection, test=leaked, tol=tol)
        for n, k in zip(SIZES, fit_keys, strict=True)
    }
    true = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    learned = [true, *(fits[n].model for n in SIZES)]
    x0 = random_states(RADIUS, key=key_states, shape=(loops,))
    many = stacked_loops(system, learned, x0, horizon=QUADRATIC_HORIZON, steps=steps)
    # Every simulation of the row "Random" has a controller of its own.
    random = QuadraticCost.random(system.nx, system.nu, key=key_random, shape=(loops,))
    each = closed_loops(system, random, x0[:, None], horizon=QUADRATIC_HORIZON, steps=steps)

    names = ["From Π", *ROWS[2:]]
    runs = {name: many[i] for i, name in enumerate(names)}
    runs["Random"] = solved(each)[:, 0]
    raw = {name: np.asarray(phi(runs[name], QUADRATIC_Q, QUADRATIC_R)) for name in ROWS}
    performance = {name: values / raw["From Π"].mean() for name, values in raw.items()}

    table = np.full((len(ROWS), len(COLUMNS)), np.nan)
    for i, name in enumerate(ROWS):
        values = performance[name]
        table[i, 3:] = values.mean(), values.max(), values.min()
    table[1, 1] = 100 * (1 - error_rates(random, test).mean())
    for i, n in enumerate(SIZES, start=2):
        result = fits[n]
        table[i, :3] = (
            100 * accuracy(result.model, train[n]),
            100 * accuracy(result.model, test),
            result.seconds / restarts,
        )
    return QuadraticDraw(system, pool, train, test, fits, performance, runs, table)


VARIANTS = (
    "paper",
    "validation split",
    "training loss",
    "one start",
    "test pairs from the training pool",
)
"""Ways to choose the model that the book compares; "paper" is the paper's own."""


def quadratic_variants(*, key: Any, restarts: int = 20, loops: int = 200) -> dict[str, np.ndarray]:
    """Run case study 1 for one key with every way of choosing among the restarts.

    Returns a table (7, 6) by the names of `VARIANTS`, columns as in `QuadraticDraw` without the
    times (NaN): those belong to a machine, not to a draw. The first one is the table of
    `quadratic_case` for the same key. Trains each set of starts once on all pairs and once on the
    pairs left by the validation split.
    """
    case = quadratic_case(key=key, restarts=restarts, loops=loops)
    key_data, key_fit, key_states, _ = generator(key).spawn(4)
    _, _, _, inner = quadratic_data(key=key_data, shared_pool=True)
    chosen: dict[str, list[Any]] = {name: [] for name in VARIANTS}
    for n, k in zip(SIZES, key_fit.spawn(len(SIZES)), strict=True):
        result = case.fits[n]
        for name, score in {
            "training loss": result.training_loss,
            "one start": np.arange(restarts),
            "test pairs from the training pool": error_rates(result.models, inner),
        }.items():
            index = best_restart(score, result.status, result.training_loss)
            chosen[name].append(result.models[index])
        chosen["paper"].append(result.model)
        held_out = fit(case.train[n], key=k, restarts=restarts, selection="validation")
        chosen["validation split"].append(held_out.model)

    tables = np.repeat(case.table[None], len(VARIANTS), axis=0)
    tables[:, :, COLUMNS.index("time s")] = np.nan
    x0 = random_states(RADIUS, key=key_states, shape=(loops,))
    everyone = [model for name in VARIANTS for model in chosen[name]]
    runs = stacked_loops(case.system, everyone, x0, horizon=QUADRATIC_HORIZON, steps=30)
    best = np.asarray(phi(case.loops["From Π"], QUADRATIC_Q, QUADRATIC_R)).mean()
    values = np.asarray(phi(runs, QUADRATIC_Q, QUADRATIC_R)) / best
    values = values.reshape(len(VARIANTS), len(SIZES), loops)
    tables[:, 2:, 3:] = np.stack([values.mean(-1), values.max(-1), values.min(-1)], axis=-1)
    for v, name in enumerate(VARIANTS):
        test = inner if name == VARIANTS[-1] else case.test
        for i, n in enumerate(SIZES):
            tables[v, 2 + i, 0] = 100 * accuracy(chosen[name][i], case.train[n])
            tables[v, 2 + i, 1] = 100 * accuracy(chosen[name][i], test)
    return dict(zip(VARIANTS, tables, strict=True))


DISTINCT_ROWS = ("pairs may repeat", "distinct pairs")
DISTINCT_COLUMNS = ("test %", "test % in the pool", "mean φ")


def distinct_case(*, key: Any, size: int = 1000, loops: int = 200) -> np.ndarray:
    """Return what it changes at n = 1000 if no two questions are about the same pair: one draw.

    50 trajectories make 1225 pairs; 1000 draws of them with repetition see about 680 different
    ones. A table (2, 3): rows `DISTINCT_ROWS`, columns `DISTINCT_COLUMNS`: accuracy on test pairs
    of new trajectories and of the training trajectories, and the average φ₃₀ of 200 closed loops
    relative to the MPC that knows the weights. The model has the best accuracy on the first test.
    """
    key_data, key_pairs, key_fit, key_states = generator(key).spawn(4)
    seed = int(key_data.integers(2**32))
    system, pool, train, test = quadratic_data(key=np.random.default_rng(seed), sizes=(size,))
    *_, inner = quadratic_data(key=np.random.default_rng(seed), sizes=(size,), shared_pool=True)
    preference = the_person()
    pairs = np.stack(np.triu_indices(len(pool), 1), axis=1)
    chosen = key_pairs.permuted(key_pairs.choice(pairs, size, replace=False), axis=1)
    labels = preference(pool[chosen[:, 0]], pool[chosen[:, 1]])
    distinct = Comparisons(pool, chosen[:, 0], chosen[:, 1], labels)
    start = int(key_fit.integers(2**32))
    models = [
        fit(data, key=np.random.default_rng(start), selection="leaky_test_accuracy", test=test)
        for data in (train[size], distinct)
    ]
    known = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    x0 = random_states(RADIUS, key=key_states, shape=(loops,))
    controllers = [known, *(r.model for r in models)]
    runs = stacked_loops(system, controllers, x0, horizon=QUADRATIC_HORIZON, steps=30)
    values = np.asarray(phi(runs, QUADRATIC_Q, QUADRATIC_R)).mean(axis=1)
    accuracies = [[100 * accuracy(r.model, t) for t in (test, inner)] for r in models]
    return np.column_stack([accuracies, values[1:] / values[0]])
