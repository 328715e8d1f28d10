"""Times of learning a quadratic σ: ``make bench``. Every ratio is against a peer in the same run.

1. `fit_map` at n = 1000, warm, against (a) our fastest twenty restarts: second moments, one
   compiled call; (b) the recipe as published: one restart after another on the trajectories,
   compiled and warm, with jaxopt's L-BFGS-B as it comes; (c) the same with the line search
   compiled as a loop, which jaxopt does when told to; (d) the recipe's own global minimum by
   `fit_global`.
2. The first call of a process, compilation included.
3. A million comparisons: time and memory.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxopt import LBFGSB
from speed import median_seconds, python_seconds, stage_by_stage

import prefmpc
from prefmpc import studies, training

PREPARE = """
import time, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import prefmpc
from prefmpc import studies
prior = prefmpc.bryson(studies.RADIUS, [1, 1])
pool = prefmpc.lqr_pool(
    prefmpc.oscillating_masses(), POOL, 10, key=jax.random.key(0), radius=studies.RADIUS
)
person = prefmpc.QuadraticPreference(studies.QUADRATIC_Q, studies.QUADRATIC_R)
"""

COLD = (
    PREPARE.replace("POOL", "50")
    + """
data = prefmpc.Comparisons.random(pool, person, 1000, key=jax.random.key(1))
began = time.perf_counter()
assert prefmpc.fit_map(data, prior).success
print(time.perf_counter() - began)
"""
)

MILLION = (
    PREPARE.replace("POOL", "2000")
    + """
import resource
rng = np.random.default_rng(0)
n = 1_000_000
first = rng.integers(0, len(pool), n)
second = (first + rng.integers(1, len(pool), n)) % len(pool)
cost = prefmpc.phi(pool, studies.QUADRATIC_Q, studies.QUADRATIC_R)
labels = (cost[first] <= cost[second]) ^ (rng.uniform(size=n) < 0.1)  # one in ten is wrong
data = prefmpc.Comparisons(pool, first, second, labels)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert prefmpc.fit_map(data, prior).success
began = time.perf_counter()
result = prefmpc.fit_map(data, prior)
seconds = time.perf_counter() - began
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(result.iterations, after / 1024, before / 1024, seconds)
"""
)


def recipe(comparisons: prefmpc.Comparisons, **options: Any) -> Callable[[Any], Any]:
    """Return one restart of the recipe, compiled, on trajectories, with jaxopt's L-BFGS-B."""
    first, second = comparisons.pairs
    labels = jnp.asarray(comparisons.labels)

    def loss(model: prefmpc.QuadraticCost) -> Any:
        z = jax.vmap(lambda a, b: stage_by_stage(model, b) - stage_by_stage(model, a))(
            first, second
        )
        ridge = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(model))
        return optax.sigmoid_binary_cross_entropy(z, labels).mean() + 1e-6 * ridge

    solver = LBFGSB(loss, maxiter=1000, history_size=10, tol=1e-3, **options)

    @jax.jit
    def train(start: prefmpc.QuadraticCost) -> Any:
        bounds = start.bounds()
        warm = training._projected_adam(loss, start, *bounds, 200, 0.01)
        return solver.run(warm, bounds=bounds).params

    return train


def main() -> None:
    """Print one line a measurement."""
    jax.config.update("jax_enable_x64", True)
    key = jax.random.key(0)
    _, _, train, _ = studies.quadratic_data(key=key)
    data = train[1000]
    prior = prefmpc.bryson(studies.RADIUS, [1, 1])
    starts = prefmpc.QuadraticCost.random(6, 2, key=key, shape=(20,))

    def one_after_another(one: Callable[[Any], Any]) -> Callable[[], None]:
        def work() -> None:
            for i in range(20):
                jax.block_until_ready(one(starts[i]))

        return work

    peers: dict[str, tuple[Callable[[], Any], int]] = {
        "20 restarts at once, second moments": (
            lambda: prefmpc.fit(data, key=key, selection="training_loss"),
            7,
        ),
        "20 restarts one by one on trajectories, jaxopt as it comes": (
            one_after_another(recipe(data)),
            3,
        ),
        "the same, line search compiled as a loop": (
            one_after_another(recipe(data, implicit_diff=False, unroll=False)),
            3,
        ),
        "fit_global: the recipe's own minimum": (lambda: prefmpc.fit_global(data), 7),
    }
    ours = median_seconds(lambda: prefmpc.fit_map(data, prior), repeats=51)
    print(f"fit_map, n = 1000, warm: {1e3 * ours:.1f} ms (wanted: at most 3)")
    for name, (work, repeats) in peers.items():
        theirs = median_seconds(work, repeats=repeats)
        print(f"  {name}: {1e3 * theirs:.0f} ms, {theirs / ours:.0f} times as long")
    for n in studies.SIZES:
        seconds = median_seconds(lambda n=n: prefmpc.fit_map(train[n], prior), repeats=51)
        result = prefmpc.fit_map(train[n], prior)
        print(f"  n = {n:4d}: {1e3 * seconds:.1f} ms, {result.iterations} Newton steps")
    print(f"fit_map, first call of a process: {python_seconds(COLD):.2f} s (wanted: under 2)")

    run = subprocess.run(
        [sys.executable, "-c", MILLION], check=True, capture_output=True, text=True
    )
    steps, after, before, seconds = (float(word) for word in run.stdout.split())
    print(
        f"a million comparisons, warm: {seconds:.2f} s for {steps:.0f} Newton steps (wanted: 5 s)"
    )
    print(
        f"  peak memory {after:.0f} MB, {after - before:.0f} MB of it for learning (wanted: 2000)"
    )


if __name__ == "__main__":
    main()
