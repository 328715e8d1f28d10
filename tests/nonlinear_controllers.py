"""The plants and controllers of the tests of `NonlinearMPC`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import multiple_shooting as casadi
import numpy as np

from prefmpc import (
    LinearSystem,
    NonlinearMPC,
    Polyhedron,
    QuadraticCost,
    SignalCost,
    cart_pendulum,
    kinematic_bicycle,
    oscillating_masses,
    steady_state,
)
from studies import QUADRATIC_Q, QUADRATIC_R

KEY = jax.random.key(2700)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
N = 10
COUPLED = Polyhedron(
    [[1, 0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, -1, 0, 0.5]],
    [0.5, 0.8, 0.6],
)
TERMINAL = Polyhedron.box([-0.5] * 6, [0.5] * 6)
SETS = {"constraints": COUPLED, "terminal": TERMINAL}


def cold(controller, x0, **options):
    controller.reset()
    return controller.solve(x0, **options)


# ---- the two nonlinear plants ----

CAR, PENDULUM = kinematic_bicycle(), cart_pendulum()
LANE = steady_state(CAR, casadi.LANE, start=([3.5, 0, 0, 20], [0, 0]))
E = np.eye(6)
LIMITS = Polyhedron(
    np.concatenate([E[2:4], -E[2:4]]), [*casadi.CAR_HIGH, *(-b for b in casadi.CAR_LOW)]
)


def lateral(x, u):
    a = x[3] ** 2 * jnp.tan(x[2]) / casadi.LENGTH
    return jnp.stack([a - casadi.LIMIT, -a - casadi.LIMIT])


def car(**options):
    cost = SignalCost(QuadraticCost(casadi.CAR_Q, casadi.CAR_R), "y")
    return NonlinearMPC(CAR, cost, N, constraints=LIMITS, path=lateral, **options)


def pendulum(horizon=N, **options):
    cost = QuadraticCost(casadi.PENDULUM_Q, casadi.PENDULUM_R)
    return NonlinearMPC(PENDULUM, cost, horizon, **options)


CARRIAGE = LinearSystem([[1, 0.1], [0, 1]], [[0], [0.1]], dt=0.1, u_min=-10, u_max=10)
