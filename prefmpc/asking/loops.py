"""Closed loops to ask about and to judge by: many σ from many x(0)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from prefmpc._pytree import bypass_init
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.loops import closed_loops
from prefmpc.mpc.steady import SteadyState
from prefmpc.preferences.trajectories import Trajectory, failed
from prefmpc.systems.linear import RICCATI, LinearSystem
from prefmpc.systems.sets import Polyhedron

Loops = Callable[[Any, np.ndarray], Trajectory]
"""(a stack of c σ, x0 (m, nx)) ↦ trajectories with leading shape (c, m)."""

Controller = Literal["lqr", "mpc"] | Loops

CONTROLLERS = 12
STATES = 12
"""So many samples of the posterior and so many x(0) make the closed loops of one question."""

DOUBLINGS = 60


def lqr_loops(system: LinearSystem, costs: QuadraticCost, x0: np.ndarray, steps: int) -> Trajectory:
    """Return closed loops (c, m) of u = clip(−K x, u_min, u_max), K the LQR gain of each cost.

    Raises a ValueError if a cost has no stabilising gain.
    """
    K = gains(system, costs.Q, costs.R)
    feedback = -K.swapaxes(-1, -2)
    x = np.empty((len(K), len(x0), steps + 1, system.nx))
    u = np.empty((len(K), len(x0), steps, system.nu))
    x[..., 0, :] = x0
    for k in range(steps):
        u[..., k, :] = np.clip(x[..., k, :] @ feedback, system.u_min, system.u_max)
        x[..., k + 1, :] = system.step(x[..., k, :], u[..., k, :])
    return bypass_init(Trajectory, x=x, u=u, y=system.output(x[..., :-1, :]))


def gains(system: LinearSystem, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return LQR gains K (c, nu, nx) for Q (c, nx, nx) and R (c, nu, nu).

    Riccati's equation is solved for all at once by the structure-preserving doubling algorithm;
    where its residual is too large, one by one.
    """
    A, B = system.A, system.B
    eye = np.eye(system.nx)
    with np.errstate(all="ignore"):
        a = np.broadcast_to(A, Q.shape)
        g, P = B @ np.linalg.solve(R, np.broadcast_to(B.T, (len(R), *B.T.shape))), Q
        for _ in range(DOUBLINGS):
            both = np.linalg.solve(eye + g @ P, np.concatenate([a, g], axis=-1))
            inner, middle = both[..., : system.nx], both[..., system.nx :]
            change = a.swapaxes(-1, -2) @ P @ inner
            g = g + a @ middle @ a.swapaxes(-1, -2)
            a = a @ inner
            P = P + change
            if not np.abs(change).max() > 1e-13 * np.abs(P).max():
                break
        PA = P @ A
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ PA)
        miss = np.abs(Q + A.T @ P @ (A - B @ K) - P).max((-2, -1)) / np.abs(P).max((-2, -1))
    for i in np.flatnonzero(~(miss < RICCATI)):
        try:
            K[i] = system.lqr(Q[i], R[i])[0]
        except ValueError as error:
            raise ValueError(
                f"system cannot be controlled with weights that the answers leave possible: {error}"
            ) from None
    return K


def loops_of(
    system: Any,
    controller: Controller,
    steps: int,
    horizon: int,
    constraints: Polyhedron | None,
) -> Loops:
    """Return the function that simulates a stack of σ from many x(0).

    Closed loops of an MPC problem that was not solved hold NaN.
    """
    if callable(controller):
        return lambda models, x0: _checked(controller(models, x0), x0)
    if controller == "lqr":
        return lambda models, x0: lqr_loops(system, models, x0, steps)

    def mpc(models: QuadraticCost, x0: np.ndarray) -> Trajectory:
        count, parts = models.batch_shape[0], []
        for begin in range(0, count, CONTROLLERS):  # of one size, so that it compiles once
            part = models[np.minimum(np.arange(begin, begin + CONTROLLERS), count - 1)]
            runs = closed_loops(
                system, part, x0, horizon=horizon, steps=steps, constraints=constraints
            )
            parts.append(runs.trajectories)
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)

    return mpc


def loops_about(
    references: list[SteadyState], system: LinearSystem, constraints: Polyhedron | None, make: Any
) -> Loops:
    """Return loops to set points: the k-th of m x(0) belongs to the k-th of r set points, k mod r.

    Parameters
    ----------
    make : function
        (system, constraints) ↦ loops to the origin; it is given what is left of both about each
        set point.
    """
    r, own = len(references), []
    for at in references:
        limits = {"u_min": system.u_min - at.u, "u_max": system.u_max - at.u}
        moved = LinearSystem(system.A, system.B, system.C, dt=system.dt, **limits)
        sets = constraints
        if sets is not None:
            sets = Polyhedron(sets.H, sets.h - sets.H @ np.concatenate([at.x, at.u]))
        own.append(make(moved, sets))

    def loops(models: Any, x0: np.ndarray) -> Trajectory:
        parts = []
        for k, at in enumerate(references):
            runs = jax.tree.map(np.asarray, own[k](models, x0[k::r] - at.x))
            lead = runs.batch_shape
            fields = {"x": runs.x + at.x, "u": runs.u + at.u, "y": runs.y + at.y}
            goals = {"x_r": at.x, "u_r": at.u, "y_r": at.y}
            fields |= {n: np.broadcast_to(v, (*lead, v.size)) for n, v in goals.items()}
            parts.append(bypass_init(Trajectory, **fields))
        order = np.argsort(np.concatenate([np.arange(len(x0))[k::r] for k in range(r)]))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1)[:, order], *parts)

    return loops


def _checked(trajectory: Any, x0: np.ndarray) -> Trajectory:
    if not isinstance(trajectory, Trajectory) or trajectory.batch_shape[1:] != (len(x0),):
        got = getattr(trajectory, "batch_shape", type(trajectory).__name__)
        raise ValueError(
            "controller must return a Trajectory with leading shape (models, states) = "
            f"(…, {len(x0)}), got {got}"
        )
    return jax.tree.map(np.asarray, trajectory)


def finite_loops(trajectory: Trajectory) -> np.ndarray:
    """Return which closed loops (c, m) are finite; a ValueError if for no x(0) two are."""
    good = ~failed(trajectory)
    if not (good.sum(axis=0) >= 2).any():
        raise ValueError(
            "controller must bring at least two closed loops from one x0 to an end, got "
            f"{int(good.sum())} of {good.size} that are finite: is x0 feasible, is the system "
            "stabilisable?"
        )
    return good
