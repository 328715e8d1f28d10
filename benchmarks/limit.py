"""Part "limit": how far from what the machine can do? Arithmetic and traffic, counted by hand.

Rates of this machine come first: a large product of float64 matrices, a large copy, and the small
product (200×20)(20×20) in a compiled loop, of which `closed_loops` consists. A floor is the
arithmetic at the rate of the large product or the traffic at that of the copy, whichever takes
longer; the second, tighter one has the rate of the small product.

Closed loops, in each step for m states with n = N·nu inputs: 2m·nx·n for the unconstrained plan,
2m·nx·(nx + nu) + 2m·ny·nx for the plant; in each active-set iteration 2 products of 2m·n² and one
more for each conjugate-gradient step, taken as the number of active rows. The whole batch takes
part until its last state is done: ``flops``. ``needed`` counts only the iterations that each state
has itself. Traffic: what comes out; everything else stays in the cache.

Learning, in each Newton step for n comparisons of p weights: 2n·p·(p + 1) for Hessian and gradient,
3n·p for weighing the data and 2n·p for the step's log-odds; the data are read twice, and about ten
arrays of n numbers once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import learning
import numpy as np
from loops import HORIZON, MINI, Case, Sizes
from measure import median, show

import prefmpc
from prefmpc.learning import _newton, _problem
from prefmpc.learning.losses import padded_size
from prefmpc.mpc.batched import controllers, starts
from prefmpc.mpc.loops import _program

SMALL = (200, 20)
LOOPED = 2000
"""Small products one after the other in a compiled loop."""


def rates(large: int, copied: int, repeats: int) -> dict[str, float]:
    """Measure flop/s and bytes/s, by JAX (all threads) and by NumPy (as many as it is given)."""
    rng = np.random.default_rng(0)
    A, long = rng.normal(size=(large, large)), rng.normal(size=copied)
    product, add_one = jax.jit(jnp.matmul), jax.jit(lambda a: a + 1.0, donate_argnums=0)
    A_jax, kept, room = jnp.asarray(A), [jnp.asarray(long)], np.empty_like(long)
    rotation = np.linalg.qr(rng.normal(size=(SMALL[1],) * 2))[0]  # so that nothing grows
    small = jnp.asarray(rng.normal(size=SMALL))

    @jax.jit
    def one_by_one(V: Any) -> Any:
        return jax.lax.fori_loop(0, LOOPED, lambda _, V: V @ rotation, V)

    def in_place() -> Any:  # into the same memory: no new pages
        kept.append(add_one(kept.pop()))
        return kept[0]

    def measured(work: Callable[[], Any], amount: float) -> float:
        return amount / median(lambda: jax.block_until_ready(work()), repeats)

    flops, moved = 2.0 * large**3, 2.0 * long.nbytes
    one_product = 2.0 * SMALL[0] * SMALL[1] ** 2
    return {
        "flops_jax": measured(lambda: product(A_jax, A_jax), flops),
        "flops_numpy": measured(lambda: A @ A, flops),
        "bytes_jax": measured(in_place, moved),
        "bytes_numpy": measured(lambda: np.copyto(room, long), moved),
        "flops_small": measured(lambda: one_by_one(small), LOOPED * one_product),
    }


def loop_counts(case: Case, tol: float) -> dict[str, float]:
    """Count arithmetic and traffic of the closed loops by the formulas above."""
    system, m, n = case.system, len(case.x0), HORIZON * case.system.nu
    nx, nu, ny = system.nx, system.nu, system.ny
    solver = prefmpc.BatchedMPC(system, case.cost, HORIZON, tol=tol)
    x = case.x0
    flops = needed = products = 0.0
    for _ in range(case.sizes.steps):
        answer = solver.solve(x)
        active = (np.abs(answer.trajectory.u).reshape(m, n) >= system.u_max[0] - 1e-9).sum(1)
        rounds, deepest = int(answer.iterations.max()), int(active.max())
        own = answer.iterations * (2 + active)
        fixed = 2.0 * m * (nx * n + nx * (nx + nu) + ny * nx)
        products += rounds * (2 + deepest)
        flops += fixed + 2.0 * m * n**2 * rounds * (2 + deepest)
        needed += fixed + 2.0 * n**2 * own.sum()
        x = answer.trajectory.x[:, 1]
    return {
        "flops": flops,
        "needed_flops": needed,
        "bytes": case.sizes.steps * m * (nx + nu + ny + 2) * 8.0,
        "products": products,
    }


def floors(counts: dict[str, float], speed: dict[str, float], seconds: float) -> dict[str, float]:
    """Say how long it has to take at least, and how many times as long it does."""
    arithmetic, traffic = (
        counts["flops"] / speed["flops_jax"],
        counts["bytes"] / max(speed["bytes_jax"], speed["bytes_numpy"]),
    )
    small = counts["flops"] / speed["flops_small"]
    return {
        "floor_seconds": max(arithmetic, traffic),
        "times_floor": seconds / max(arithmetic, traffic),
        "small_floor_seconds": max(small, traffic),
        "times_small_floor": seconds / max(small, traffic),
    }


def loops(case: Case, speed: dict[str, float], repeats: int) -> dict[str, Any]:
    """The closed loops of part "loops": floors, and where the time goes."""
    tol, steps = 1e-6, case.sizes.steps
    many = controllers(case.system, case.cost, None, None)
    begin, _ = starts(case.x0, case.system.nx, many)
    run, arguments = _program(HORIZON, steps), (*many, many.systems, begin, tol)
    nothing = jax.jit(lambda *leaves: leaves[-1] + 1.0)
    counts = loop_counts(case if repeats > 1 else dataclasses.replace(case, x0=case.x0[:1]), tol)
    seconds = median(case.ours(tol), repeats)
    program = median(lambda: jax.block_until_ready(run(*arguments)), repeats)
    dispatch = median(lambda: jax.block_until_ready(nothing(*arguments)), repeats)
    return {
        "name": "closed loops",
        "seconds": seconds,
        "program_seconds": program,
        "dispatch_seconds": dispatch,
        **counts,
        **floors(counts, speed, seconds),
        "microseconds_per_product": 1e6 * program / max(counts["products"], 1),
    }


def learning_step(n: int, speed: dict[str, float], repeats: int) -> dict[str, Any]:
    """`fit_map` from n comparisons: floors, and where the time goes."""
    data, prior = learning.data_of(learning.pool_of(200), n), prefmpc.bryson(*learning.PRIOR)
    _, entries = _problem.check([data], [prior], "full", None)
    size = padded_size(n)
    problems = _problem.build(data, [prior], entries, None, size)
    p = len(entries.rows)
    steps = prefmpc.fit_map(data, prior).iterations
    seconds = median(lambda: prefmpc.fit_map(data, prior), repeats)
    build = median(lambda: _problem.build(data, [prior], entries, None, size), repeats)
    newton = median(lambda: _newton.solve(problems, 1e-8, 100), repeats)
    flops = steps * size * (2.0 * p * (p + 1) + 5 * p)
    counts = {"flops": flops, "bytes": steps * size * 8.0 * (2 * p + 10)}
    return {
        "name": f"fit_map, n = {n}",
        "seconds": seconds,
        "program_seconds": newton,
        "build_seconds": build,
        "newton_steps": steps,
        **counts,
        **floors(counts, speed, newton),
    }


def compiled_flops(case: Case) -> float:
    """Return what XLA counts for the closed loops, the body of each loop once."""
    many = controllers(case.system, case.cost, None, None)
    begin, _ = starts(case.x0, case.system.nx, many)
    run = _program(HORIZON, case.sizes.steps)
    return float(run.lower(*many, many.systems, begin, 1e-6).cost_analysis()["flops"])


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    case = Case.of(MINI if mini else Sizes())
    repeats = 1 if mini else 7
    speed = rates(100, 1000, 1) if mini else rates(2000, 20_000_000, repeats)
    rows = [loops(case, speed, repeats), learning_step(20 if mini else 2**18, speed, repeats)]
    unit = {"flops": "Gflop/s", "bytes": "GB/s"}
    print("\nRates of this machine")
    for name, rate in speed.items():
        print(f"  {name:12s} {rate / 1e9:8.2f} {unit[name.partition('_')[0]]}")
    columns = {"name": "", "seconds": "ms", "program_seconds": "ms of it compiled"}
    columns |= {"floor_seconds": "floor, ms", "times_floor": "× floor"}
    columns |= {"small_floor_seconds": "floor by small products, ms", "times_small_floor": "× it"}
    show("Measured, and the floors", rows, columns)
    first, second = rows
    print(
        f"  closed loops: {first['flops'] / 1e6:.0f} Mflop in {first['products']:.0f} products, "
        f"{first['microseconds_per_product']:.1f} µs each; {first['needed_flops'] / 1e6:.0f} Mflop "
        f"if each state worked for itself alone; a call of a compiled program that does nothing: "
        f"{1e3 * first['dispatch_seconds']:.2f} ms"
    )
    print(
        f"  fit_map: {1e3 * second['build_seconds']:.1f} ms for the moments and their differences, "
        f"{second['newton_steps']} Newton steps"
    )
    once = compiled_flops(case)
    print(
        f"  XLA counts {once / 1e6:.1f} Mflop with every loop's body once, the dual method and all"
    )
    return {"rates": speed, "rows": rows, "xla_flops_bodies_once": once}
