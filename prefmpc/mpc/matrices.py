"""The matrices of a controller, for other packages."""

from __future__ import annotations

import numpy as np

from prefmpc._checks import instance
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.terminal import terminal_set
from prefmpc.systems.sets import Polyhedron


def matrices(controller: LinearMPC) -> dict[str, np.ndarray]:
    """Return the matrices of a `LinearMPC` by name, to build the same problem elsewhere.

    ============ ============= ================================ ==========================
    here         shape         python-control (control.optimal) do-mpc
    ============ ============= ================================ ==========================
    A, B         (nx, nx + nu) ss(A, B, C, 0, dt)               set_rhs("x", A @ x + B @ u)
    C            (ny, nx)      C of ss                          set_expression("y", C @ x)
    Q, R         (nx, nx)      quadratic_cost(sys, Q, R)        set_objective(lterm=...)
    P            (nx, nx)      terminal_cost=...                set_objective(mterm=...)
    u_min, u_max (nu,)         input_range_constraint(sys, ...) bounds["lower", "_u", "u"]
    H, h         (m, nx + nu)  LinearConstraint(H, -inf, h)     set_nl_cons("Z", ..., ub=h)
    H_N, h_N     (m_N, nx)     terminal_constraints=...         terminal_bounds
    ============ ============= ================================ ==========================

    ``horizon`` is do-mpc's n_horizon and one less than python-control's timepts; ``dt`` is do-mpc's
    t_step. σ does not weigh x_N: without terminal ingredients P is zero, and do-mpc's mterm must be
    0 · x, not lterm again. do-mpc's set_rterm adds a cost of increments, which is none of σ.

    Returns
    -------
    dict of str to array
        A, B, C, Q, R, P, u_min, u_max, H, h, H_N, h_N; without a set its H has no rows.
    """
    instance("controller", controller, LinearMPC)
    system, nx = controller.system, controller.system.nx
    P, end = terminal_set(controller._terminal, nx)
    out = {name: np.array(getattr(system, name)) for name in ("A", "B", "C", "u_min", "u_max")}
    out |= {"Q": np.array(controller.cost.Q), "R": np.array(controller.cost.R)}
    out["P"] = np.zeros((nx, nx)) if P is None else np.array(P)
    none = Polyhedron(np.zeros((0, nx + system.nu)), np.zeros(0))
    Z = controller._constraints or none
    last = end if isinstance(end, Polyhedron) else Polyhedron(np.zeros((0, nx)), np.zeros(0))
    return out | {"H": Z.H.copy(), "h": Z.h.copy(), "H_N": last.H.copy(), "h_N": last.h.copy()}
