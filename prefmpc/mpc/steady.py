"""Steady states: where a plant can rest so that its output is where it is wanted."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, flag, instance, sequence, shaped, single
from prefmpc._pytree import bypass_init
from prefmpc.mpc._target import Target, input_sizes
from prefmpc.mpc.solution import MPCSolution, check_dimension
from prefmpc.mpc.terminal import stage_constraints
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem, System
from prefmpc.systems.sets import Polyhedron

REACHED = 1e-6
STEPS = 50
EXACT = 1e-9
SMALL = 1e-7
"""Of the linear plants near a nonlinear one singular values below this share are zero."""


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
    disturbance: ArrayLike | None = None,
) -> SteadyState:
    """Return the steady state with the output y_r and, if there are several, the smallest.

    The norm of (x, u) is in units of half the range of each input, and of what that moves; inputs
    without limits have the unit with which they move y as much. By linear algebra for a linear
    plant, and a quadratic program where limits are met; a sequence of these for a nonlinear one.

    Parameters
    ----------
    y_r : array (ny,)
    constraints : Polyhedron, optional
        Over the stacked (x, u); the steady state must satisfy them, and the input bounds.
    start : (x, u), optional
        For a nonlinear plant: where to start from. For a linear one: the value of what no input
        moves and what stays by itself, such as a constant disturbance among the states; it is
        taken from this x. Default: the origin, hence no disturbance.
    nearest : bool
        Return the steady state whose output is nearest to y_r, if it cannot be reached.
    disturbance : array (nx,), optional
        Of a linear plant: what is added to every next state, x = A x + B u + d.

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
    search: Any = _held if isinstance(system, LinearSystem) else _search
    if disturbance is not None:
        if not isinstance(system, LinearSystem):
            raise ValueError("disturbance must be None for a system that is not linear")
        d = np.asarray(finite_array("disturbance", disturbance, ndim=1))
        search = partial(_held, push=np.asarray(shaped("disturbance", d, (system.nx,))))
    found = search(system, wanted, Z, x, u)
    if found is None:
        within = " within the constraints" if len(Z.h) else ""
        within += " and with this disturbance" if disturbance is not None else ""
        raise ValueError(
            f"y_r must have a steady state, but none was found{within} near y_r = {wanted}"
        )
    if nearest or _reached(system, found, wanted):
        return found
    free = search(system, wanted, None, x, u)
    held = free is not None and _reached(system, free, wanted)
    why = (
        f"lies outside of the constraints: holding it takes x = {free.x}, u = {free.u}"
        if held and free is not None
        else "is no output that the plant can hold"
    )
    raise ValueError(
        f"y_r must be reachable, but {wanted} {why}; nearest is {found.y} (nearest=True takes it)"
    )


def check_reference(
    reference: Any,
    system: System,
    constraints: Polyhedron | None,
    ingredients: bool,
    push: np.ndarray | None = None,
) -> None:
    """Raise a ValueError unless the set point fits plant, constraints and terminal set.

    ``push`` (nx,) is added to every next state.
    """
    instance("reference", reference, SteadyState)
    check_dimension("reference", reference.x.size, system.nx)
    check_dimension("reference", reference.u.size, system.nu)
    if ingredients:
        raise ValueError("reference must be None with TerminalIngredients, made for the origin")
    z, Z = np.concatenate([reference.x, reference.u]), stage_constraints(system, constraints)
    room = REACHED * np.maximum(np.abs(Z.h), np.abs(Z.H) @ np.abs(z))
    if not (Z.H @ z <= Z.h + room).all():
        raise ValueError(f"reference must satisfy the constraints, got x, u = {z}")
    after = np.asarray(system.step(reference.x, reference.u))
    drift = np.abs((after if push is None else after + push) - reference.x)
    size: Any = 1 + np.abs(z).max()
    if isinstance(system, LinearSystem):
        rows = np.concatenate([system.A, system.B], axis=1)
        size = np.abs(reference.x) + np.abs(rows) @ np.abs(z)
        if not (drift <= REACHED * size).all():  # where only rounding is left of all terms
            size = _typical(system, reference)[: system.nx]
    if not (drift <= REACHED * size).all():
        raise ValueError(
            f"reference must be a steady state{'' if push is None else ' with this disturbance'}, "
            f"but its next state moves by {drift.max()}"
        )


def with_reference(solution: MPCSolution, reference: SteadyState | None) -> MPCSolution:
    """Return the same solution with the set point, if there is one, as a part of its plan."""
    if reference is None:
        return solution
    T = solution.trajectory
    at = {"x_r": reference.x, "u_r": reference.u, "y_r": reference.y}
    return dataclasses.replace(
        solution, trajectory=bypass_init(Trajectory, x=T.x, u=T.u, y=T.y, **at)
    )


def _typical(system: LinearSystem, held: SteadyState) -> np.ndarray:
    """Return sizes (nx + nu,) of x and u next to which a share of `REACHED` is nothing."""
    z = np.abs(np.concatenate([held.x, held.u]))
    units = input_sizes(system.A, system.B, system.C, system.u_min, system.u_max)
    return np.maximum(z, units * (z / units).max())


def _reached(system: System, found: SteadyState, wanted: np.ndarray) -> bool:
    """Say whether the output is the wanted one, each to a share of the size that it can have."""
    if isinstance(system, LinearSystem):
        typical = _typical(system, found)[: system.nx]
        size = np.maximum(np.abs(wanted), np.abs(system.C) @ typical)
    else:
        size = 1 + np.abs(wanted).max() + np.zeros(wanted.size)
    return bool((np.abs(found.y - wanted) <= REACHED * size).all())


def _held(
    system: Any,
    wanted: np.ndarray,
    Z: Polyhedron | None,
    x: np.ndarray,
    u: np.ndarray,
    push: np.ndarray | None = None,
) -> SteadyState | None:
    """Return what a linear plant can hold, with what no input moves as in x."""
    A, B, C = system.A, system.B, system.C
    sizes = input_sizes(A, B, C, system.u_min, system.u_max)
    right = np.zeros(len(A)) if push is None else -push
    z = Target(A, B, C, right, wanted, sizes, keep=x).solve(Z)
    return None if z is None else _point(system, z, Z)


def _point(system: System, z: np.ndarray, Z: Polyhedron | None) -> SteadyState:
    x, u = z[: system.nx], z[system.nx :]
    # Rounding must not lead out of the bounds.
    u = u if Z is None else np.clip(u, system.u_min, system.u_max)
    return SteadyState(x, u, np.asarray(system.output(x)))


def _search(
    system: Any, wanted: np.ndarray, Z: Polyhedron | None, x: np.ndarray, u: np.ndarray
) -> SteadyState | None:
    """Find what a nonlinear plant can hold, by taking it as linear near the last answer."""
    sizes = None
    for _ in range(STEPS):
        try:
            near = system.linearise(x, np.clip(u, system.u_min, system.u_max))
        except ValueError:
            return None
        A, B, C = near.A, near.B, near.C
        y, x_next = np.asarray(system.output(x)), np.asarray(system.step(x, u))
        if not np.isfinite(x_next).all():
            return None
        if sizes is None:
            sizes = input_sizes(A, B, C, system.u_min, system.u_max)
        right = A @ x + B @ u - x_next
        z = Target(A, B, C, right, wanted - y + C @ x, sizes, rank=SMALL).solve(Z)
        if z is None:
            return None
        change = np.abs(z - np.concatenate([x, u])) / sizes
        x, u = z[: x.size], z[x.size :]
        gap = np.abs(np.asarray(system.step(x, u)) - x) / sizes[: x.size]
        size = 1 + np.abs(z / sizes).max()
        if gap.max() <= EXACT * size and change.max() <= REACHED * size:
            return _point(system, z, Z)
    return None
