"""Part "solvers": do the controllers with constraints agree, and how long does a solve take?

1. 100 random problems with coupled constraints, input bounds and a terminal set: `LinearMPC`
   (OSQP) against `ConvexMPC` (Clarabel).
2. Time of a re-solve from another x(0), six states, median and 99th percentile: the quadratic
   through OSQP, the same and networks through Clarabel.
3. 10,000 random quadratic programs, about a third of them infeasible: the batch of
   `prefmpc.mpc._batched_qp` against Clarabel, one after the other.
4. 10,000 random MPC problems on plants with spectral radii from 0.5 to 2: `BatchedMPC` against
   Clarabel on the sparse form, whose answers are refined until they are exact.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import numpy as np
from measure import show

from prefmpc import (
    ConvexMPC,
    ICNNCost,
    LinearMPC,
    Polyhedron,
    QuadraticCost,
    oscillating_masses,
    random_states,
)
from prefmpc.mpc._batched_qp import STATUSES
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from random_mpc import KINDS, SHAPES, compared, random_problems
from random_programs import answers, by_clarabel, random_programs

PLANTS, STATES = 4, 25
HORIZONS = (10, 40)
RESOLVES = 100
PROGRAMS, VARIABLES, ROWS = 10_000, 24, 60
MPC_PLANTS, MPC_STATES = 16, 15


def agreement(plants: int, count: int) -> dict[str, Any]:
    """Solve random problems with both, and say how far they are apart."""
    system, rng = oscillating_masses(), np.random.default_rng(5)
    statuses: Counter[tuple[str, str]] = Counter()
    apart, costs, residual = [0.0], [0.0], [0.0]
    for _ in range(plants):
        A, B = rng.normal(size=(6, 6)), rng.normal(size=(2, 2))
        cost = QuadraticCost(A @ A.T + 0.1 * np.eye(6), B @ B.T + 0.1 * np.eye(2))
        sets = {
            "constraints": Polyhedron(rng.normal(size=(3, 8)), rng.uniform(0.4, 1.5, 3)),
            "terminal": Polyhedron(rng.normal(size=(2, 6)), rng.uniform(0.02, 1, 2)),
        }
        qp, cone = LinearMPC(system, cost, 5, **sets), ConvexMPC(system, cost, 5, **sets)
        for x0 in rng.uniform(-0.5, 0.5, (count, 6)):
            a, b = qp.solve(x0), cone.solve(x0)
            statuses[a.status, b.status] += 1
            if a.success and b.success:
                apart.append(np.abs(a.u - b.u).max())
                costs.append(abs(a.cost - b.cost) / (1 + abs(a.cost)))
                residual.append(b.residual)
    rows = [{"LinearMPC": a, "ConvexMPC": b, "count": n} for (a, b), n in statuses.items()]
    columns = {"LinearMPC": "LinearMPC", "ConvexMPC": "ConvexMPC", "count": "problems"}
    show(f"1. {plants * count} random problems with constraints: verdicts", rows, columns)
    found = {"u": max(apart), "cost": max(costs), "residual": max(residual)}
    print(
        f"  largest difference of u {found['u']:.1e}, of the cost {found['cost']:.1e} (relative); "
        f"largest residual of ConvexMPC {found['residual']:.1e}"
    )
    return {"rows": rows, "largest_difference": found}


def times(horizons: tuple[int, ...], resolves: int) -> dict[str, Any]:
    """Time solves from many states."""
    system = oscillating_masses()
    quadratic = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    scale = np.concatenate([[0.3] * 3, [1.0] * 5])
    states = random_states(RADIUS, key=jax.random.key(1), shape=(resolves,))

    def network(activation: str, widths: tuple[int, ...]) -> ICNNCost:
        options = {"widths": widths, "activation": activation, "floor": 0.01}
        return ICNNCost.random(scale, key=jax.random.key(2), **options)

    controllers = {
        "quadratic, OSQP": lambda N: LinearMPC(system, quadratic, N),
        "quadratic, Clarabel": lambda N: ConvexMPC(system, quadratic, N),
        "ReLU 8-8": lambda N: ConvexMPC(system, network("relu", (8, 8)), N),
        "squared ReLU 8": lambda N: ConvexMPC(system, network("squared_relu", (8,)), N),
        "softplus 8-8": lambda N: ConvexMPC(system, network("softplus", (8, 8)), N),
    }
    rows = []
    for name, make in controllers.items():
        for N in horizons:
            controller = make(N)
            solutions = [controller.solve(x0) for x0 in states]
            assert all(solution.success for solution in solutions)
            middle, slow = np.quantile([s.seconds for s in solutions], [0.5, 0.99])
            worst = max(float(s.residual) for s in solutions)
            row = {"name": name, "N": N, "seconds": float(middle), "slow_seconds": float(slow)}
            rows.append(row | {"largest_residual": worst})
    columns = {"name": "", "N": "N", "seconds": "ms", "slow_seconds": "99 % below, ms"}
    columns["largest_residual"] = "largest residual"
    show(f"2. A solve from another state, median of {resolves}", rows, columns)
    return {"rows": rows}


def programs(count: int) -> dict[str, Any]:
    """Solve random programs by the batch and by Clarabel, and count the verdicts."""
    data = random_programs(count, VARIABLES, ROWS, np.random.default_rng(1))
    jax.block_until_ready(answers(*data))  # compiles
    began = time.perf_counter()
    found = jax.block_until_ready(answers(*data))
    ours = time.perf_counter() - began
    U, statuses = np.asarray(found.U)[:, 0], STATUSES[np.asarray(found.status)[:, 0]]
    verdicts: Counter[tuple[str, str]] = Counter()
    apart, theirs = 0.0, 0.0
    for i, program in enumerate(zip(*data, strict=True)):
        began = time.perf_counter()
        status, v = by_clarabel(*program)
        theirs += time.perf_counter() - began
        verdicts[str(statuses[i]), status] += 1
        if statuses[i] == status == "solved":
            apart = max(apart, float(np.abs(U[i] - v).max()))
    rows = [{"ours": a, "Clarabel": b, "count": n} for (a, b), n in verdicts.items()]
    columns = {"ours": "ours", "Clarabel": "Clarabel", "count": "problems"}
    show(f"3. {count} random programs, {VARIABLES} variables: verdicts", rows, columns)
    print(
        f"  largest difference of x {apart:.1e}; {1e6 * ours / count:.0f} µs each side by side, "
        f"{1e6 * theirs / count:.0f} µs each by Clarabel"
    )
    seconds = {"ours": ours, "Clarabel": theirs}
    finite = bool(np.isfinite(U[statuses == "solved"]).all())
    return {"rows": rows, "largest_difference": apart, "seconds": seconds, "finite": finite}


def mpc_problems(shapes: tuple[Any, ...], plants: int, states: int) -> dict[str, Any]:
    """Solve random MPC problems by the batch and by Clarabel, and count the verdicts."""
    rows, ours, sound = [], 0.0, True
    for shape in shapes:
        for kind in KINDS:
            rng = np.random.default_rng([KINDS.index(kind), *shape])
            problems = random_problems(shape, kind, plants, states, rng)
            problems.ours()  # compiles
            began = time.perf_counter()
            answer = problems.ours()
            ours += time.perf_counter() - began
            found = compared(problems, answer)
            sound &= found.sound
            pairs = Counter(found.verdicts)
            rows.append(
                {
                    "shape": list(shape),
                    "kind": kind,
                    "verdicts": [[*pair, n] for pair, n in pairs.items()],
                    "largest_difference": max(found.differences, default=0.0),
                    "compared": len(found.differences),
                    "active": found.active,
                    "clarabel_seconds": found.seconds,
                }
            )
    total: Counter[tuple[str, str]] = Counter()
    for row in rows:
        total.update({(a, b): n for a, b, n in row["verdicts"]})
    shown = [{"ours": a, "Clarabel": b, "count": n} for (a, b), n in total.most_common()]
    columns = {"ours": "ours", "Clarabel": "Clarabel", "count": "problems"}
    show(
        f"4. {total.total()} random MPC problems, N up to {max(s[2] for s in shapes)}",
        shown,
        columns,
    )
    apart = max(row["largest_difference"] for row in rows)
    theirs = sum(row["clarabel_seconds"] for row in rows)
    solved = sum(n for (_, b), n in total.items() if b == "solved")
    share = total["solved", "solved"] / max(solved, 1)
    print(
        f"  of those that Clarabel solves {share:.2%} solved, largest difference of u {apart:.1e}, "
        f"in {sum(row['compared'] for row in rows)} of them known to all digits; "
        f"{1e6 * ours / total.total():.0f} µs each side by side, "
        f"{1e6 * theirs / total.total():.0f} µs each by Clarabel"
    )
    seconds = {"ours": ours, "Clarabel": theirs}
    found_all = {"rows": rows, "verdicts": shown, "largest_difference": apart, "sound": sound}
    return found_all | {"seconds": seconds, "share_solved": share}


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part."""
    if mini:
        return {
            "agreement": agreement(1, 5),
            "times": times((5,), 2),
            "programs": programs(50),
            "mpc": mpc_problems(SHAPES[:1], 2, 4),
        }
    return {
        "agreement": agreement(PLANTS, STATES),
        "times": times(HORIZONS, RESOLVES),
        "programs": programs(PROGRAMS),
        "mpc": mpc_problems(SHAPES, MPC_PLANTS, MPC_STATES),
    }
