"""Where the horizon ends: a terminal cost and terminal sets that make a learned σ stable."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.optimize import linprog

from prefmpc._checks import instance, nonnegative, positive_int, single
from prefmpc._pytree import bypass_init
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.solution import check_dimension, check_problem
from prefmpc.systems.linear import LinearSystem, System
from prefmpc.systems.sets import Ellipsoid, Polyhedron

ROUNDING = 1e-14
WIDE = 1e6
"""States so many times beyond where the closest limit is are of no interest."""


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
    if tol >= 1:
        raise ValueError(f"tol must be below 1, got {tol}")
    Z = stage_constraints(system, constraints)
    if (Z.h <= 0).any():
        raise ValueError(
            f"constraints must hold the origin inside: all h > 0, got {Z.h.min():g} in row "
            f"{int(Z.h.argmin())} (the input bounds come first; an input that is locked by equal "
            "ones has no place in B here)"
        )
    K, P = system.lqr(cost.Q, cost.R)
    closed = system.A - system.B @ K
    Hx, Hu = Z.H[:, : system.nx], Z.H[:, system.nx :]
    rows = Hx - Hu @ K  # what u = −K x leaves of Z
    # A row that the feedback meets by rounding alone bounds nothing.
    kept = (np.abs(rows) > ROUNDING * (np.abs(Hx) + np.abs(Hu) @ np.abs(K))).any(axis=1)
    kept &= np.isfinite(Z.h)
    rows, heights = rows[kept], Z.h[kept]
    # In units in which P has ones on its diagonal and every limit is 1.
    dx = 1 / np.sqrt(np.where(np.diag(P) > 0, np.diag(P), 1.0))
    # There, eigenvalues tell whether P is positive definite; in the user's units they need not.
    unit_P = Ellipsoid(P * dx * dx[:, None]).P
    unit_rows = rows * dx / heights[:, None]
    reach = np.einsum("ri,ri->r", unit_rows, np.linalg.solve(unit_P, unit_rows.T).T)
    level = 1 / float(reach.max()) if len(rows) else np.inf
    H, of = _maximal_invariant(closed * dx / dx[:, None], unit_rows, max_steps, tol)
    polyhedron = Polyhedron(H / dx * heights[of][:, None], heights[of])
    ellipsoid = bypass_init(Ellipsoid, P=unit_P / dx / dx[:, None], level=level)
    return TerminalIngredients(P, K, polyhedron, ellipsoid)


def _maximal_invariant(
    closed: np.ndarray, rows: np.ndarray, max_steps: int, tol: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return H of the largest set H x ≤ 1 with rows @ x ≤ 1 for x and all x⁺ = closed x after it.

    Also the row from which each row of H comes. The algorithm of Gilbert and Tan: add the rows of
    one more step until they are redundant.
    """
    H, of, power = rows, np.arange(len(rows)), np.eye(len(closed))
    if not len(rows):
        return H, of
    for _ in range(max_steps):
        power = power @ closed
        later = rows @ power
        new = np.array([_largest(row, H) > 1 + tol for row in later])
        if not new.any():
            keep = _needed(H, tol)
            return H[keep], of[keep]
        H, of = np.concatenate([H, later[new]]), np.concatenate([of, np.flatnonzero(new)])
    raise ValueError(
        f"max_steps must suffice to find the terminal polyhedron, it still grew after {max_steps}"
    )


def _largest(row: np.ndarray, H: np.ndarray) -> float:
    """Return max row @ x over H x ≤ 1 and ‖x‖∞ ≤ `WIDE`, infinite if it is not found.

    A row is left out only if it is shown to be redundant: one too many does no harm.
    """
    unit = np.abs(H).max(axis=0)
    unit = np.where(unit > 0, unit, np.abs(row))
    unit = np.where(unit > 0, unit, 1.0)
    size = np.abs(row / unit).max()
    answer = linprog(
        -row / unit / size,
        A_ub=H / unit,
        b_ub=np.ones(len(H)),
        bounds=(-WIDE, WIDE),
        method="highs",
    )
    found = answer.status == 0 and np.isfinite(answer.fun)
    return -float(answer.fun) * float(size) if found else np.inf


def _needed(H: np.ndarray, tol: float) -> np.ndarray:
    """Say which rows of H x ≤ 1 are not redundant."""
    keep = np.ones(len(H), dtype=bool)
    for i in range(len(H)):
        keep[i] = False
        if _largest(H[i], H[keep]) > 1 + tol:
            keep[i] = True
    return keep
