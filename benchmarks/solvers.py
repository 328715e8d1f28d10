"""The controllers with constraints: do they agree, and how long does a solve take? ``make bench``.

1. 500 random problems with coupled constraints, input bounds and a terminal set: `LinearMPC`
   (OSQP) against `ConvexMPC` (Clarabel).
2. Time of a re-solve from another x(0), six states, median and 99th percentile: the quadratic
   through OSQP, the same and networks through Clarabel.
"""

from __future__ import annotations

from collections import Counter

import jax
import numpy as np

from prefmpc import (
    ConvexMPC,
    ICNNCost,
    LinearMPC,
    Polyhedron,
    QuadraticCost,
    oscillating_masses,
    random_states,
)
from prefmpc.studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

PROBLEMS, STATES = 500, 25
HORIZONS = (10, 12, 20, 40)
RESOLVES = 200


def agreement() -> None:
    """Solve random problems with both, and print how far they are apart."""
    system, rng = oscillating_masses(), np.random.default_rng(5)
    statuses: Counter[tuple[str, str]] = Counter()
    apart, costs, residual = [0.0], [0.0], [0.0]
    for _ in range(PROBLEMS // STATES):
        A, B = rng.normal(size=(6, 6)), rng.normal(size=(2, 2))
        cost = QuadraticCost(A @ A.T + 0.1 * np.eye(6), B @ B.T + 0.1 * np.eye(2))
        sets = {
            "constraints": Polyhedron(rng.normal(size=(3, 8)), rng.uniform(0.4, 1.5, 3)),
            "terminal": Polyhedron(rng.normal(size=(2, 6)), rng.uniform(0.02, 1, 2)),
        }
        qp, cone = LinearMPC(system, cost, 5, **sets), ConvexMPC(system, cost, 5, **sets)
        for x0 in rng.uniform(-0.5, 0.5, (STATES, 6)):
            a, b = qp.solve(x0), cone.solve(x0)
            statuses[a.status, b.status] += 1
            if a.success and b.success:
                apart.append(np.abs(a.u - b.u).max())
                costs.append(abs(a.cost - b.cost) / (1 + abs(a.cost)))
                residual.append(b.residual)
    print(f"1. {PROBLEMS} random problems, LinearMPC and ConvexMPC say:")
    for (a, b), count in statuses.items():
        print(f"   {count:4d}  {a}, {b}")
    print(
        f"   largest difference of u {max(apart):.1e}, of the cost {max(costs):.1e} (relative); "
        f"largest residual of ConvexMPC {max(residual):.1e}\n"
    )


def times() -> None:
    """Print the table of solve times."""
    system = oscillating_masses()
    quadratic = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    scale = np.concatenate([[0.3] * 3, [1.0] * 5])
    states = random_states(RADIUS, key=jax.random.key(1), shape=(RESOLVES,))

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
    print(f"2. ms for a re-solve, median / 99th percentile of {RESOLVES}")
    print("   " + " " * 20 + "".join(f"{f'N = {N}':>14s}" for N in HORIZONS))
    for name, make in controllers.items():
        row = []
        for N in HORIZONS:
            controller = make(N)
            solutions = [controller.solve(x0) for x0 in states]
            assert all(solution.success for solution in solutions)
            median, slow = np.quantile([1e3 * s.seconds for s in solutions], [0.5, 0.99])
            row.append(f"{f'{median:.1f} / {slow:.1f}':>14s}")
        print(f"   {name:20s}" + "".join(row), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    agreement()
    times()
