"""Steady states: where a plant can rest so that its output is where it is wanted."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, flag, instance, sequence, shaped, single
from prefmpc._pytree import bypass_init
from prefmpc.mpc._cone import TIGHT, ConeProgram
from prefmpc.mpc.solution import MPCSolution, check_dimension
from prefmpc.mpc.terminal import stage_constraints
from prefmpc.nonlinear import NonlinearSystem
from prefmpc.sets import Polyhedron
from prefmpc.systems import LinearSystem, System
from prefmpc.trajectories import Trajectory

REACHED = 1e-6
STEPS = 50
SMALL = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class SteadyState:
    """A set point (x_r, u_r) that the plant can hold, x_r = f(x_r, u_r), and its output y_r."""

    x: np.ndarray
    u: np.ndarray
    y: np.ndarray


def steady_state(
    system: System,
    y_r: ArrayLike,
    *,
    constraints: Polyhedron | None = None,
    start: tuple[ArrayLike, ArrayLike] | None = None,
    nearest: bool = False,
) -> SteadyState:
    """Return the steady state with the output y_r and, if there are several, the least ‖(x, u)‖.

    A quadratic program for a linear plant, a sequence of them for a nonlinear one.

    Parameters
    ----------
    y_r : array (ny,)
    constraints : Polyhedron, optional
        Over the stacked (x, u); the steady state must satisfy them, and the input bounds.
    start : (x, u), optional
        For a nonlinear plant: where to start from. Default: the origin.
    nearest : bool
        Return the steady state whose output is nearest to y_r, if it cannot be reached.

    Raises
    ------
    ValueError
        If no steady state has this output, or none within the constraints; the message says
        which, and names the nearest output.
    """
    instance("system", system, System)
    single("system", system)
    nearest = flag("nearest", nearest)
    wanted = np.asarray(shaped("y_r", finite_array("y_r", y_r, ndim=1), (system.ny,)))
    x, u = np.zeros(system.nx), np.clip(np.zeros(system.nu), system.u_min, system.u_max)
    if start is not None:
        given = sequence("start", start)
        if len(given) != 2:
            raise ValueError(f"start must be (x, u), got {len(given)} entries")
        x = np.asarray(shaped("start[0]", finite_array("start[0]", given[0], ndim=1), (system.nx,)))
        u = np.asarray(shaped("start[1]", finite_array("start[1]", given[1], ndim=1), (system.nu,)))
    Z = stage_constraints(system, constraints)
    found = _search(system, wanted, Z, x, u)
    if found is None:
        raise ValueError(f"y_r must have a steady state, but none was found near y_r = {wanted}")
    miss = np.abs(found.y - wanted).max()
    if nearest or miss <= REACHED * (1 + np.abs(wanted).max()):
        return found
    free = _search(system, wanted, Polyhedron(np.zeros((0, Z.dim)), np.zeros(0)), x, u)
    held = free is not None and np.abs(free.y - wanted).max() <= REACHED * (
        1 + np.abs(wanted).max()
    )
    why = (
        f"lies outside of the constraints: holding it takes x = {free.x}, u = {free.u}"
        if held and free is not None
        else "is no output that the plant can hold"
    )
    raise ValueError(
        f"y_r must be reachable, but {wanted} {why}; nearest is {found.y} (nearest=True takes it)"
    )


def check_reference(
    reference: Any, system: System, constraints: Polyhedron | None, ingredients: bool
) -> None:
    """Raise a ValueError unless the set point fits plant, constraints and terminal set."""
    instance("reference", reference, SteadyState)
    check_dimension("reference", reference.x.size, system.nx)
    check_dimension("reference", reference.u.size, system.nu)
    if ingredients:
        raise ValueError("reference must be None with TerminalIngredients, made for the origin")
    z = np.concatenate([reference.x, reference.u])
    if not stage_constraints(system, constraints).contains(z, tol=REACHED):
        raise ValueError(f"reference must satisfy the constraints, got x, u = {z}")
    drift = np.abs(np.asarray(system.step(reference.x, reference.u)) - reference.x).max()
    if not drift <= REACHED * (1 + np.abs(z).max()):
        raise ValueError(f"reference must be a steady state, but its next state moves by {drift}")


def with_reference(solution: MPCSolution, reference: SteadyState | None) -> MPCSolution:
    """Return the same solution with the set point, if there is one, as a part of its plan."""
    if reference is None:
        return solution
    T = solution.trajectory
    at = {"x_r": reference.x, "u_r": reference.u, "y_r": reference.y}
    return dataclasses.replace(
        solution, trajectory=bypass_init(Trajectory, x=T.x, u=T.u, y=T.y, **at)
    )


def _search(
    system: System, wanted: np.ndarray, Z: Polyhedron, x: np.ndarray, u: np.ndarray
) -> SteadyState | None:
    """Solve quadratic programs, each with the plant linear near the last answer."""
    for _ in range(STEPS):
        near = _linear(system, x, u)
        y, x_next = np.asarray(system.output(x)), np.asarray(system.step(x, u))
        if near is None or not np.isfinite(x_next).all():
            return None
        A, B, C = near
        move = _program(system, (A, B, C), wanted - y, x - x_next, Z, np.concatenate([x, u]))
        if move is None:
            return None
        x, u = x + move[: x.size], u + move[x.size :]
        gap = np.abs(np.asarray(system.step(x, u)) - x).max()
        size = 1 + np.abs(np.concatenate([x, u])).max()
        if gap <= SMALL * size and (
            isinstance(system, LinearSystem) or np.abs(move).max() <= REACHED * size
        ):
            return SteadyState(x, u, np.asarray(system.output(x)))
    return None


def _linear(system: System, x: np.ndarray, u: np.ndarray) -> Any:
    if isinstance(system, LinearSystem):
        return system.A, system.B, system.C
    assert isinstance(system, NonlinearSystem)
    try:
        near = system.linearise(x, np.clip(u, system.u_min, system.u_max))
    except ValueError:
        return None
    return near.A, near.B, near.C


def _program(
    system: System, near: Any, miss: np.ndarray, drift: np.ndarray, Z: Polyhedron, z: np.ndarray
) -> np.ndarray | None:
    """Return the move (dx, du): least ‖C dx − miss‖² with A dx + B du − dx = drift, z + d ∈ Z."""
    import clarabel

    A, B, C = near
    nx, n = system.nx, system.nx + system.nu
    E = np.concatenate([C, np.zeros((len(C), system.nu))], axis=1)
    # The second term decides among several; it is too small to move y.
    P = 2 * (E.T @ E + SMALL * np.eye(n))
    q = 2 * (SMALL * z - E.T @ miss)
    rest = np.concatenate([A - np.eye(nx), B], axis=1)
    cones = [clarabel.ZeroConeT(nx), clarabel.NonnegativeConeT(len(Z.h))]
    b = np.concatenate([drift, Z.h - Z.H @ z])
    rows = sp.csc_matrix(np.concatenate([rest, Z.H]))
    found = ConeProgram(sp.csc_matrix(P), q, rows, b, cones, TIGHT).solve(b)
    return found.z if found.status == "solved" else None
