"""Small plants, models and data that are in order: what the valid calls are made of."""

from __future__ import annotations

import jax
import numpy as np

import prefmpc as p

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)

SYSTEM = p.LinearSystem([[1, 0.5], [0, 0.9]], [[0], [1]], dt=0.1, u_min=-1, u_max=1)
COST = p.QuadraticCost(np.eye(2), [[1.0]])
POOL = p.Trajectory(RNG.standard_normal((6, 4, 2)), RNG.standard_normal((6, 3, 1)))
# Two controllers from the same two states.
LOOPS = p.Trajectory(np.ones((2, 2, 4, 2)), RNG.standard_normal((2, 2, 3, 1)))
DATA = p.Comparisons(POOL, [0, 1, 2, 3], [1, 2, 3, 4], [1, 0, 0.5, 1])
LIMITS = p.Polyhedron.box([-5, -5, -1], [5, 5, 1])
PRIOR = p.WishartPrior(np.eye(2), [[1.0]])
PERSON = p.QuadraticPreference(np.eye(2), [[1.0]])
ICNN = p.ICNNCost.random([1.0, 1, 1], key=KEY, widths=(2,), floor=0.1)


def linear(x, u):
    return SYSTEM.A @ x + SYSTEM.B @ u


def still(x):
    return 0.0 * x[..., :1]


def half(first, second):
    return np.full(first.batch_shape, 0.5)


CAR = p.NonlinearSystem(linear, nx=2, nu=1, dt=0.1)
BOUNDS = {"u_min": np.array([-1.0]), "u_max": np.array([1.0])}
PLANT = {"A": SYSTEM.A, "B": SYSTEM.B, "C": np.eye(2), "dt": 0.1, **BOUNDS}
LAYERS = {"b": [np.zeros(2)], "c": np.ones(2), "scale": np.ones(3), "over": "stage"}
DRAWN = {"scale": np.ones(3), "key": KEY, "widths": (2,), "steps": 2, "shape": (2,), "floor": 0.0}
MPC = {"system": SYSTEM, "cost": COST, "horizon": 3, "constraints": LIMITS}
LOOP = {
    **{"system": SYSTEM, "horizon": 3, "constraints": LIMITS, "x0": np.ones((2, 2))},
    **{"steps": 2, "terminal": None, "tol": 1e-8},
}
SHARED = {"structure": "full", "outputs": np.eye(2)}
NEWTON = {**SHARED, "max_iterations": 50, "tol": 1e-8}
SIDES = {"first": POOL[:2], "second": POOL[2:4]}
