"""Following a set point: steady-state targets, and a controller of deviations from them."""

from __future__ import annotations

import time

import numpy as np
from jax.typing import ArrayLike

from prefmpc.mpc._target import input_sizes, kept
from prefmpc.mpc.nonlinear import NonlinearMPC
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    Outcome,
    check_single_state,
    mpc_solution,
)
from prefmpc.mpc.steady import SteadyState, steady_state
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron

SAME = 1e-12
"""Relative changes of what no input moves up to this are rounding."""


class ReferenceTracker(Controller):
    """Steer the output to a set point: σ sees the deviations from the steady state of y_r.

    Implements the remark on references (x_r, u_r) of arXiv 2511.22502, section II-B. Change the
    set point at any time with `track`. What no input of a linear plant moves, such as a constant
    disturbance among the states, is taken from the state at hand: when it has changed, so does
    the steady state, and y_r is reached without an offset.

    Parameters
    ----------
    controller : LinearMPC or NonlinearMPC
        Without terminal ingredients: these are made for the origin.
    y_r : array (ny,)
        The first set point.
    constraints : Polyhedron, optional
        Over (x, u); what a steady state must satisfy, in general those of the controller.
    nearest : bool
        Follow the nearest output that can be held, where y_r cannot.

    Raises
    ------
    ValueError
        If y_r has no steady state within the constraints, see `steady_state`.
    """

    def __init__(
        self,
        controller: LinearMPC | NonlinearMPC,
        y_r: ArrayLike,
        *,
        constraints: Polyhedron | None = None,
        nearest: bool = False,
    ) -> None:
        if not isinstance(controller, (LinearMPC, NonlinearMPC)):
            raise ValueError(
                f"controller must be a LinearMPC or a NonlinearMPC, got {type(controller).__name__}"
            )
        self.controller, self._sets, self._nearest = controller, constraints, nearest
        system = controller.system
        self._kept = np.zeros((0, system.nx))
        if isinstance(system, LinearSystem):
            A, B = system.A, system.B
            self._kept = kept(A, B, input_sizes(A, B, system.C, system.u_min, system.u_max))
        self._y_r = y_r
        self.reference: SteadyState = self._target(y_r, None)

    def track(self, y_r: ArrayLike) -> SteadyState:
        """Follow another set point from now on; return its steady state."""
        self.reference = self._target(y_r, (self.reference.x, self.reference.u))
        self._y_r = y_r
        return self.reference

    def _target(self, y_r: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None) -> SteadyState:
        return steady_state(
            self.controller.system,
            y_r,
            constraints=self._sets,
            start=start,
            nearest=self._nearest,
        )

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0 (nx,) and the set point that is followed now."""
        if len(self._kept):
            began, x = time.perf_counter(), check_single_state(x0, self.controller.system.nx)
            change = np.abs(self._kept @ (x - self.reference.x))
            if (change > SAME * (np.abs(self._kept) @ np.abs(x))).any():
                try:
                    self.reference = self._target(self._y_r, (x, self.reference.u))
                except ValueError as error:
                    system, N = self.controller.system, self.controller.horizon
                    return mpc_solution(system, N, Outcome("infeasible", str(error)), began)
        return self.controller.solve(x0, reference=self.reference)

    def applied(self, u: np.ndarray) -> None:
        """Take note of an input that the plant received."""
        self.controller.applied(u)

    def reset(self) -> None:
        """Forget the last plan; the set point stays."""
        self.controller.reset()
