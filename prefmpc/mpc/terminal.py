"""Where the horizon ends: a terminal cost and terminal sets that make a learned σ stable."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.optimize import linprog

from prefmpc._checks import instance, nonnegative, positive_int, single
from prefmpc.models import QuadraticCost
from prefmpc.mpc.solution import check_dimension, check_problem
from prefmpc.sets import Ellipsoid, Polyhedron
from prefmpc.systems import LinearSystem, System


@dataclasses.dataclass(frozen=True, eq=False)
class TerminalIngredients:
    """A feedback for the time after the horizon, what it costs, and where it may take over.

    Attributes
    ----------
    P : array (nx, nx)
        x_NᵀPx_N is the cost of u = −K x from x_N on, for ever.
    K : array (nu, nx)
        The LQR gain for the weights of σ.
    polyhedron : Polyhedron
        The largest set on which u = −K x satisfies the constraints for ever.
    ellipsoid : Ellipsoid
        The largest sublevel set of xᵀPx on which it does.
    """

    P: np.ndarray
    K: np.ndarray
    polyhedron: Polyhedron
    ellipsoid: Ellipsoid


def terminal_set(
    terminal: Any, nx: int, *, ellipsoid: bool = False
) -> tuple[np.ndarray | None, Polyhedron | Ellipsoid | None]:
    """Return P of the terminal cost, None without ingredients, and X_N, None if that is all of ℝⁿ.

    Raises a ValueError unless ``terminal`` is None, a Polyhedron, TerminalIngredients or, where
    these will do, an Ellipsoid, and fits nx states.
    """
    P = None
    if isinstance(terminal, TerminalIngredients):
        P, terminal = terminal.P, terminal.polyhedron
        check_dimension("terminal", len(P), nx)
    if ellipsoid and isinstance(terminal, Ellipsoid):
        check_dimension("terminal", terminal.dim, nx)
        return P, terminal if np.isfinite(terminal.level) else None
    check_polyhedron("terminal", terminal, nx)
    return P, terminal


def check_polyhedron(name: str, given: Any, dim: int) -> None:
    """Raise a ValueError unless ``given`` is None or a Polyhedron of that dimension."""
    if given is not None:
        instance(name, given, Polyhedron)
        check_dimension(name, given.dim, dim)


def stage_constraints(system: System, constraints: Polyhedron | None) -> Polyhedron:
    """Return Z over the stacked (x, u): the input bounds, and ``constraints`` if there are some.

    Raises a ValueError if these do not fit.
    """
    box = Polyhedron.box(system.u_min, system.u_max)
    H = np.concatenate([np.zeros((len(box.h), system.nx)), box.H], axis=1)
    check_polyhedron("constraints", constraints, system.nx + system.nu)
    if constraints is None:
        return Polyhedron(H, box.h)
    return Polyhedron(np.concatenate([H, constraints.H]), np.concatenate([box.h, constraints.h]))


def terminal_ingredients(
    system: LinearSystem,
    cost: QuadraticCost,
    *,
    constraints: Polyhedron | None = None,
    max_steps: int = 200,
    tol: float = 1e-9,
) -> TerminalIngredients:
    """Return terminal cost and sets with which MPC with the cost σ is stable.

    With x_NᵀPx_N added to σ and x_N in either set, the value function decreases by at least the
    first stage cost in each step (Remark 1 of arXiv 2511.22502 and the texts that it cites): the
    plan, shifted by one step and ended by u = −K x_N, is feasible and that much cheaper.

    Parameters
    ----------
    system : LinearSystem
        Its input bounds are part of Z.
    cost : QuadraticCost
        A single one. Q must see every undamped mode of A.
    constraints : Polyhedron, optional
        Over (x, u), as for `LinearMPC`; the origin must be inside of Z.
    max_steps : int
        The polyhedron is found as the states that keep to Z for 1, 2, … steps, until one more
        step changes nothing.
    tol : float
        Rows that are redundant to within ``tol`` are left out.

    Raises
    ------
    ValueError
        If something does not fit, the origin is not inside of Z, no stabilising LQR exists, or
        the polyhedron is not found within ``max_steps``.
    """
    check_problem(system, cost)
    single("system", system)
    single("cost", cost)
    max_steps, tol = positive_int("max_steps", max_steps), nonnegative("tol", tol)
    Z = stage_constraints(system, constraints)
    if (Z.h <= 0).any():
        raise ValueError(
            f"constraints must hold the origin inside: all h > 0, got {Z.h.min():g} in row "
            f"{int(Z.h.argmin())} (the input bounds come first; an input that is locked by equal "
            "ones has no place in B here)"
        )
    K, P = system.lqr(cost.Q, cost.R)
    closed = system.A - system.B @ K
    rows = Z.H[:, : system.nx] - Z.H[:, system.nx :] @ K  # what u = −K x leaves of Z
    # A row that the feedback never meets bounds nothing.
    rows, heights = rows[kept := np.abs(rows).max(axis=1) > 0], Z.h[kept]
    reach = np.einsum("ri,ri->r", rows, np.linalg.solve(P, rows.T).T)
    level = float((heights**2 / reach).min()) if len(rows) else np.inf
    polyhedron = _maximal_invariant(closed, rows, heights, max_steps, tol)
    return TerminalIngredients(P, K, polyhedron, Ellipsoid(P, level))


def _maximal_invariant(
    closed: np.ndarray, rows: np.ndarray, heights: np.ndarray, max_steps: int, tol: float
) -> Polyhedron:
    """Return the largest set with rows @ x ≤ heights for x and all that follows from x⁺ = closed x.

    The algorithm of Gilbert and Tan: add the rows of one more step until they are redundant.
    """
    if not len(rows):
        return Polyhedron(np.zeros((0, len(closed))), np.zeros(0))
    H, h, power = rows, heights, np.eye(len(closed))
    for _ in range(max_steps):
        power = power @ closed
        new = [
            (row, height)
            for row, height in zip(rows @ power, heights, strict=True)
            if _largest(row, H, h) > height * (1 + tol)
        ]
        if not new:
            return _without_redundant_rows(H, h, tol)
        H = np.concatenate([H, [row for row, _ in new]])
        h = np.concatenate([h, [height for _, height in new]])
    raise ValueError(
        f"max_steps must suffice to find the terminal polyhedron, it still grew after {max_steps}"
    )


def _largest(row: np.ndarray, H: np.ndarray, h: np.ndarray) -> float:
    """Return max row @ x over H x ≤ h; infinite if there is none."""
    answer = linprog(-row, A_ub=H, b_ub=h, bounds=(None, None), method="highs")
    return -float(answer.fun) if answer.status == 0 else np.inf


def _without_redundant_rows(H: np.ndarray, h: np.ndarray, tol: float) -> Polyhedron:
    keep = np.ones(len(h), dtype=bool)
    for i in range(len(h)):
        keep[i] = False
        if _largest(H[i], H[keep], h[keep]) > h[i] * (1 + tol):
            keep[i] = True
    return Polyhedron(H[keep], h[keep])
