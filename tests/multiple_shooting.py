"""The book's two nonlinear control problems, written again for CasADi and IPOPT.

Nothing is shared with `prefmpc` but the problem: states are unknowns of their own (multiple
shooting), and plants, cost and integrator are CasADi expressions. For tests and benchmarks.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

LENGTH, LIMIT = 2.7, 4.0  # wheelbase in m, lateral acceleration in m/s²
CAR_Q, CAR_R = np.diag([1.0, 10, 0.1, 1]), np.diag([10, 0.1])
CAR_LOW, CAR_HIGH = [-0.5, 10.0], [0.5, 30.0]  # steering angle in rad, speed in m/s
LANE = np.array([3.5, 0, 0, 20])
PENDULUM_Q, PENDULUM_R = np.diag([1.0, 10, 0.1, 0.1]), np.array([[0.01]])


def lane_changes(count, rng):
    """States of the car before and in a lane change."""
    return np.array([0, 0, 0, 20]) + rng.uniform(-1, 1, (count, 4)) * [2, 0.05, 0.01, 3]


def swing_ups(count, rng):
    """States of the pendulum, at any angle."""
    return rng.uniform(-1, 1, (count, 4)) * [1, np.pi, 2, 5]


class Shooting:
    """min Σ stage(x_k, u_k) with x_{k+1} from Runge and Kutta, bounds on u, rows(x, u) ≤ 0."""

    def __init__(self, flow, stage, rows, dt, u_min, u_max, horizon, rest):
        self.size = (4, len(u_min), horizon)
        self.rest, nx, nu, N = rest, *self.size
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        k1 = flow(x, u)
        k2 = flow(x + dt / 2 * k1, u)
        k3 = flow(x + dt / 2 * k2, u)
        k4 = flow(x + dt * k3, u)
        self.step = ca.Function("step", [x, u], [x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
        X, U, start = ca.SX.sym("X", nx, N + 1), ca.SX.sym("U", nu, N), ca.SX.sym("s", nx)
        defects, limits, total = [X[:, 0] - start], [], 0
        for k in range(N):
            defects.append(X[:, k + 1] - self.step(X[:, k], U[:, k]))
            limits.append(rows(X[:, k], U[:, k]))
            total += stage(X[:, k], U[:, k])
        limits, defects = ca.vertcat(*limits), ca.vertcat(*defects)
        problem = {"x": ca.veccat(X, U), "p": start, "f": total, "g": ca.vertcat(defects, limits)}
        quiet = {"print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 1000}
        options = {"print_time": False, "ipopt": quiet}
        self.solver = ca.nlpsol("solver", "ipopt", problem, options)
        free = np.full(nx * (N + 1), np.inf)
        self.bounds = {
            "lbx": np.concatenate([-free, np.tile(u_min, N)]),
            "ubx": np.concatenate([free, np.tile(u_max, N)]),
            "lbg": np.concatenate([np.zeros(nx * (N + 1)), np.full(limits.numel(), -np.inf)]),
            "ubg": 0,
        }

    def __call__(self, x0):
        """Return status, cost and inputs (N, nu), from the resting input held over the horizon."""
        nx, nu, N = self.size
        x = [np.asarray(x0)]
        for _ in range(N):
            x.append(np.asarray(self.step(x[-1], self.rest)).ravel())
        guess = np.concatenate([np.concatenate(x), np.tile(self.rest, N)])
        found = self.solver(x0=guess, p=x0, **self.bounds)
        U = np.asarray(found["x"]).ravel()[nx * (N + 1) :].reshape(N, nu)
        return self.solver.stats()["return_status"], float(found["f"]), U


def lane_change(horizon):
    """Return the lane change of a car at 20 m/s, with its limits."""

    def flow(x, u):
        return ca.vertcat(x[3] * ca.sin(x[1]), x[3] * ca.tan(x[2]) / LENGTH, u[0], u[1])

    def lateral(x):
        return x[3] ** 2 * ca.tan(x[2]) / LENGTH

    def stage(x, u):
        e = ca.vertcat(x[0], x[1], lateral(x), x[3]) - LANE
        return ca.bilin(CAR_Q, e, e) + ca.bilin(CAR_R, u, u)

    def rows(x, u):
        a = lateral(x)
        return ca.vertcat(x[2:] - CAR_HIGH, CAR_LOW - x[2:], a - LIMIT, -a - LIMIT)

    return Shooting(flow, stage, rows, 0.2, [-0.4, -4], [0.4, 2], horizon, np.zeros(2))


def swing_up(horizon):
    """Return the pendulum on a cart, σ with the minimum upright."""

    def flow(x, u):
        mass = ca.blockcat([[1.2, 0.1 * ca.cos(x[1])], [ca.cos(x[1]), 0.5]])
        push = ca.vertcat(u[0] + 0.1 * x[3] ** 2 * ca.sin(x[1]), 9.81 * ca.sin(x[1]))
        return ca.vertcat(x[2:], ca.solve(mass, push))

    def stage(x, u):
        return ca.bilin(PENDULUM_Q, x, x) + ca.bilin(PENDULUM_R, u, u)

    return Shooting(
        flow, stage, lambda x, u: ca.SX(0, 1), 0.05, [-10.0], [10.0], horizon, np.zeros(1)
    )
