"""The second case study of arXiv 2511.22502: the person wants the output to settle soon."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import numpy as np

from prefmpc._random import generator
from prefmpc.evaluation import accuracy
from prefmpc.learning.training import FitResult, fit
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.loops import closed_loops
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import (
    Preference,
    SettlingTimePreference,
    by_criterion,
    lexicographic,
)
from prefmpc.preferences.pools import lqr_pool, random_states
from prefmpc.preferences.trajectories import Trajectory, max_input, settling_time
from prefmpc.systems.linear import LinearSystem, oscillating_masses
from studies.quadratic import RADIUS, error_rates, solved, stacked_loops

EPSILON = 0.1
SETTLING_HORIZON = 15
SETTLING_SIZES = (20, 100, 400, 1000)
SETTLING_STEPS = 30

Variant = Literal["with Πᵤ", "without Πᵤ"]
SETTLING_VARIANTS: tuple[Variant, ...] = ("with Πᵤ", "without Πᵤ")
SETTLING_COLUMNS = ("train %", "test %", "time s", "median κ", "max κ", "mean max|u|")

NEVER = np.inf
PAPER_TABLE_II: dict[Variant, dict[str, tuple[float | None, ...]]] = {
    "with Πᵤ": {
        "Random": (None, 83.17, None, 10, 21, 0.52),
        "σ₂₀": (100.0, 90.60, 1.35, 16, NEVER, 0.51),
        "σ₁₀₀": (100.0, 93.60, 1.43, 9, 14, 3.21),
        "σ₄₀₀": (95.25, 94.80, 1.91, 9, 17, 2.38),
        "σ₁₀₀₀": (95.20, 94.20, 2.75, 8, 11, 2.38),
    },
    "without Πᵤ": {
        "Random": (None, None, None, 10, 21, 0.52),
        "σ₂₀": (None, None, None, 10, 16, 1.53),
        "σ₁₀₀": (None, None, None, 7, 9, 3.06),
        "σ₄₀₀": (None, None, None, 5, 9, 5.48),
        "σ₁₀₀₀": (None, None, None, 5, 6, 6.38),
    },
}
SETTLING_ROWS = ("Random", "Random, diagonal", "σ₂₀", "σ₁₀₀", "σ₄₀₀", "σ₁₀₀₀")
"""The paper's rows, and "Random" with the weights that the data were made with."""


@dataclasses.dataclass(frozen=True)
class SettlingDraw:
    """One draw of case study 2.

    Attributes
    ----------
    system : LinearSystem
        Without input bounds.
    pool : Trajectory
        The 50 training trajectories.
    train, test : dict of str to Comparisons
        By variant; ``train[variant]`` is a dict by size.
    fits : dict of str to dict of int to FitResult
    loops : dict of str to dict of str to Trajectory
        Closed loops, leading dimension 200, by variant and row.
    table : array (2, 6, 6)
        Variants `SETTLING_VARIANTS`, rows `SETTLING_ROWS`, columns `SETTLING_COLUMNS`; NaN where
        there is nothing to say, inf where a response never settles.
    data_kappa : float
        Median settling time of the training pool.
    """

    system: LinearSystem
    pool: Trajectory
    train: dict[Variant, dict[int, Comparisons]]
    test: dict[Variant, Comparisons]
    fits: dict[Variant, dict[int, FitResult]]
    loops: dict[Variant, dict[str, Trajectory]]
    table: np.ndarray
    data_kappa: float


def settling_preference(variant: Variant, epsilon: float = EPSILON) -> SettlingTimePreference:
    """Return Π of a variant; without Πᵤ, pairs with equal settling times are left out."""
    if variant == "with Πᵤ":
        return SettlingTimePreference(epsilon)
    return SettlingTimePreference(epsilon, tie_break=None, ties="drop")


def diagonal_weights(key: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw the LQR weights of the data: U[5, 20] on the positions, U[0.1, 1] on the rest."""
    rng = generator(key)
    low, high = np.array([5.0] * 3 + [0.1] * 5), np.array([20.0] * 3 + [1.0] * 5)
    diagonal = rng.uniform(low, high, (size, 8))
    return diagonal[:, :6, None] * np.eye(6), diagonal[:, 6:, None] * np.eye(2)


def settling_data(
    *, key: Any, sizes: tuple[int, ...] = SETTLING_SIZES
) -> tuple[
    LinearSystem, Trajectory, dict[Variant, dict[int, Comparisons]], dict[Variant, Comparisons]
]:
    """Return the plant, the training pool, and training and test data by variant.

    Both variants ask about the same pairs; without Πᵤ the ties are missing.
    """
    streams = generator(key).spawn(4)
    system = oscillating_masses(u_max=np.inf)

    def make_pool(rng: Any) -> Trajectory:
        weights = diagonal_weights(rng, 50)
        return lqr_pool(
            system, 50, SETTLING_HORIZON, key=rng, radius=RADIUS, weights=weights, saturate=False
        )

    pool, test_pool = make_pool(streams[0]), make_pool(streams[1])
    seeds = streams[2].integers(0, 2**32, len(sizes) + 1)

    def ask(source: Trajectory, variant: Variant, size: int, seed: int) -> Comparisons:
        rng = np.random.default_rng(seed)
        return Comparisons.random(source, settling_preference(variant), size, key=rng)

    train = {
        v: {n: ask(pool, v, n, s) for n, s in zip(sizes, seeds, strict=False)}
        for v in SETTLING_VARIANTS
    }
    test = {v: ask(test_pool, v, 500, seeds[-1]) for v in SETTLING_VARIANTS}
    return system, pool, train, test


def settling_case(
    *, key: Any, restarts: int = 20, tol: float = 1e-3, loops: int = 200
) -> SettlingDraw:
    """Run case study 2 once: data, four training sets with and without Πᵤ, closed loops."""
    key_data, key_fit, key_states, key_random = generator(key).spawn(4)
    system, pool, train, test = settling_data(key=key_data)
    seeds = key_fit.integers(0, 2**32, len(SETTLING_SIZES))
    fits = {
        v: {
            n: fit(
                train[v][n],
                key=np.random.default_rng(seed),
                restarts=restarts,
                selection="leaky_test_accuracy",
                test=test[v],
                tol=tol,
            )
            for n, seed in zip(SETTLING_SIZES, seeds, strict=True)
        }
        for v in SETTLING_VARIANTS
    }
    x0 = random_states(RADIUS, key=key_states, shape=(loops,))
    learned = [fits[v][n].model for v in SETTLING_VARIANTS for n in SETTLING_SIZES]
    # Every simulation of the rows "Random" has a controller of its own.
    coupled = QuadraticCost.random(system.nx, system.nu, key=key_random, shape=(loops,))
    diagonal = QuadraticCost(*diagonal_weights(key_random, loops))
    N, steps = SETTLING_HORIZON, SETTLING_STEPS
    many = stacked_loops(system, learned, x0, horizon=N, steps=steps)
    pairs = jax.tree.map(lambda *leaves: np.concatenate(leaves), coupled, diagonal)
    states = np.tile(x0, (2, 1))[:, None]
    each = solved(closed_loops(system, pairs, states, horizon=N, steps=steps))

    random = {
        "Random": each[:loops, 0],
        "Random, diagonal": each[loops:, 0],
    }
    runs: dict[Variant, dict[str, Trajectory]] = {}
    table = np.full((2, len(SETTLING_ROWS), len(SETTLING_COLUMNS)), np.nan)
    for v, variant in enumerate(SETTLING_VARIANTS):
        offset = v * len(SETTLING_SIZES)
        runs[variant] = dict(random)
        for i, name in enumerate(SETTLING_ROWS[2:]):
            runs[variant][name] = many[offset + i]
        for r, name in enumerate(SETTLING_ROWS):
            kappa = settling_time(runs[variant][name], EPSILON)
            table[v, r, 3:] = np.median(kappa), kappa.max(), max_input(runs[variant][name]).mean()
        for r, models in enumerate((coupled, diagonal)):
            table[v, r, 1] = 100 * (1 - error_rates(models, test[variant]).mean())
        for i, n in enumerate(SETTLING_SIZES):
            result = fits[variant][n]
            table[v, 2 + i, :3] = (
                100 * accuracy(result.model, train[variant][n]),
                100 * accuracy(result.model, test[variant]),
                result.seconds / restarts,
            )
    data_kappa = float(np.median(settling_time(pool, EPSILON)))
    return SettlingDraw(system, pool, train, test, fits, runs, table, data_kappa)


RESOLUTIONS = (1, 2, 4)
TIES_ROWS = (*(f"κ in units of {r}" for r in RESOLUTIONS), "Πᵤ with its arguments swapped")
TIES_COLUMNS = ("ties %", "κ with", "max|u| with", "κ without", "max|u| without")


def coarse_preference(resolution: int, *, tie_break: bool, swapped: bool = False) -> Preference:
    """Return Π_κ of a person who reads a clock with steps of ``resolution`` samples.

    With ``tie_break`` Πᵤ decides among equal readings (``swapped``: for the larger input, which is
    what the paper's formula says), else such pairs are left out.
    """

    def reading(trajectory: Trajectory) -> np.ndarray:
        return np.floor(settling_time(trajectory, EPSILON) / resolution)

    def effort(trajectory: Trajectory) -> Any:
        return -max_input(trajectory) if swapped else max_input(trajectory)

    if tie_break:
        return lexicographic(by_criterion(reading), by_criterion(effort))
    return lexicographic(by_criterion(reading), lambda first, second: np.full(len(first), np.nan))


def ties_case(*, key: Any, size: int = 1000, loops: int = 200) -> np.ndarray:
    """Return what Πᵤ changes when it has more, and fewer, ties to break: one draw.

    A table (4, 5): rows `TIES_ROWS`, columns `TIES_COLUMNS`: share of ties among the pairs,
    median κ and mean max‖u‖∞ of 200 closed loops with and without Πᵤ.
    """
    key_data, key_states, key_fit = generator(key).spawn(3)
    seeds = key_fit.integers(0, 2**32, 2)
    system, pool, _, _ = settling_data(key=key_data, sizes=())
    x0 = random_states(RADIUS, key=key_states, shape=(loops,))
    cases = [(r, False) for r in RESOLUTIONS] + [(1, True)]
    models, ties = [], []
    for resolution, swapped in cases:
        for tie_break in (True, False):
            person = coarse_preference(resolution, tie_break=tie_break, swapped=swapped)
            pairs = np.random.default_rng(seeds[0])
            data = Comparisons.random(pool, person, size, key=pairs)
            start = np.random.default_rng(seeds[1])
            models.append(fit(data, key=start, selection="training_loss").model)
        ties.append(100 * (1 - len(data) / size))
    runs = stacked_loops(system, models, x0, horizon=SETTLING_HORIZON, steps=SETTLING_STEPS)
    kappa = np.median(settling_time(runs, EPSILON), axis=1).reshape(-1, 2)
    force = max_input(runs).mean(axis=1).reshape(-1, 2)
    return np.column_stack([ties, kappa[:, 0], force[:, 0], kappa[:, 1], force[:, 1]])
