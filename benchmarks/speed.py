"""Times of what a reader waits for: ``make bench``. Ratios are against a peer in the same run.

1. Twenty restarts at n = 1000: one vmapped call on second moments, against the same recipe as the
   paper words it: one restart after another, on the trajectories, compiled and warm.
2. How many compilations serve the five sizes of Table I.
3. Table I, one draw, from a cold process.
4. ``import prefmpc`` over the time that importing jax, optax and jaxopt takes.
5. 200 closed loops of 30 steps: one compiled call, against a loop over OSQP.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import prefmpc
from prefmpc import studies, training
from prefmpc._lbfgsb import minimise

REPEATS = 7


def median_seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the median wall time of ``work`` after one warm-up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def python_seconds(code: str, repeats: int = 3) -> float:
    """Return the median of the seconds that ``code`` prints in a process of its own."""
    runs = [
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
        for _ in range(repeats)
    ]
    return float(np.median([float(run.stdout.split()[-1]) for run in runs]))


def recipe_on_trajectories(comparisons: prefmpc.Comparisons) -> Callable[[Any], Any]:
    """Return one restart of the recipe, compiled, with σ evaluated on the trajectories."""
    first, second = comparisons.pairs
    labels = jnp.asarray(comparisons.labels)

    def loss(model: prefmpc.QuadraticCost) -> Any:
        z = jax.vmap(lambda T: stage_by_stage(model, T))(second) - jax.vmap(
            lambda T: stage_by_stage(model, T)
        )(first)
        ridge = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(model))
        return optax.sigmoid_binary_cross_entropy(z, labels).mean() + 1e-6 * ridge

    @jax.jit
    def train(start: prefmpc.QuadraticCost) -> Any:
        bounds = start.bounds()
        warm = training._projected_adam(loss, start, *bounds, 200, 0.01)
        return minimise(loss, warm, bounds, max_iterations=1000, tol=1e-3)

    return train


def stage_by_stage(model: prefmpc.QuadraticCost, T: prefmpc.Trajectory) -> Any:
    """σ as the sum over time of eq. (10), step by step."""
    x, u = T.x[:-1], T.u
    return jnp.einsum("ki,ij,kj->", x, model.Q, x) + jnp.einsum("ki,ij,kj->", u, model.R, u)


def main() -> None:
    """Print one line a measurement."""
    jax.config.update("jax_enable_x64", True)
    key = jax.random.key(0)
    system, _, train, _ = studies.quadratic_data(key=key)

    def twenty() -> Any:
        return prefmpc.fit(train[1000], key=key, selection="training_loss")

    ours = median_seconds(twenty)
    starts = prefmpc.QuadraticCost.random(6, 2, key=key, shape=(20,))
    one = recipe_on_trajectories(train[1000])

    def serially() -> None:
        for i in range(20):
            jax.block_until_ready(one(starts[i]))

    theirs = median_seconds(serially, repeats=3)
    print(f"20 restarts, n = 1000, warm: {ours:.3f} s (wanted: under 0.5 s)")
    print(f"  one after another on trajectories: {theirs:.2f} s, {theirs / ours:.1f} times as long")

    before = training._train._cache_size()
    for n in studies.SIZES:
        prefmpc.fit(train[n], key=key, selection="training_loss")
    print(
        f"new compilations for the sizes {studies.SIZES}: {training._train._cache_size() - before}"
    )

    cold = python_seconds(
        "import time; began = time.perf_counter(); import jax\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "from prefmpc import studies; studies.quadratic_case(key=jax.random.key(0))\n"
        "print(time.perf_counter() - began)"
    )
    print(f"Table I, one draw, cold process: {cold:.1f} s (wanted: under 25 s)")
    extra = python_seconds(
        "import warnings; warnings.simplefilter('ignore'); import time, jax, optax, jaxopt\n"
        "began = time.perf_counter(); import prefmpc; print(time.perf_counter() - began)"
    )
    print(f"import prefmpc after jax, optax and jaxopt: {extra:.3f} s (wanted: under 0.3 s)")

    cost = prefmpc.QuadraticCost(studies.QUADRATIC_Q, studies.QUADRATIC_R)
    x0 = prefmpc.random_states(studies.RADIUS, key=key, shape=(200,))
    batched = median_seconds(lambda: prefmpc.closed_loops(system, cost, x0, horizon=10, steps=30))
    controller = prefmpc.LinearMPC(system, cost, 10)
    looped = median_seconds(lambda: prefmpc.simulate(system, controller, x0, 30), repeats=1)
    print(f"200 closed loops of 30 steps: {1e3 * batched:.0f} ms")
    print(f"  loop over OSQP: {1e3 * looped:.0f} ms, {looped / batched:.0f} times as long")


if __name__ == "__main__":
    main()
