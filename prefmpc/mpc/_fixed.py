"""Limits on states that no input moves: settled by looking at x_0, before anything is solved."""

from __future__ import annotations

import numpy as np

from prefmpc.mpc._limits import ON_LIMIT, input_size, row_sizes, unmoved
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron, SecondOrderCone


class FixedRows:
    """The rows of Z and X_N that no input moves, for every x_0.

    Attributes
    ----------
    stage : bool array (N, m)
        Which rows of ``constraints`` no input moves at stage k.
    last : bool array (rows of ``terminal``,)

    Rows of ``constraints`` that are ``soft`` (m,) may be broken.
    """

    def __init__(
        self,
        system: LinearSystem,
        horizon: int,
        constraints: Polyhedron | None,
        terminal: Polyhedron | None,
        soft: np.ndarray | None = None,
    ) -> None:
        nx = system.nx
        none = Polyhedron(np.zeros((0, nx + system.nu)), np.zeros(0))
        Z, end = constraints or none, terminal or Polyhedron(np.zeros((0, nx)), np.zeros(0))
        H = Z.H[:, :nx]
        self.stage = unmoved(system.A, system.B, H, Z.H[:, nx:], horizon)
        self.last = unmoved(system.A, system.B, end.H, None, horizon + 1)[-1]
        maps, rows, limits = [np.zeros((0, nx))], [np.zeros((0, nx))], [np.zeros(0)]
        power = np.eye(nx)
        stages, last = [np.zeros(0, int)], np.full(self.last.sum(), horizon)
        for k, mask in enumerate(self.stage if soft is None else self.stage & ~soft):
            if mask.any():
                maps.append(H[mask] @ power)
                rows.append(H[mask])
                limits.append(Z.h[mask])
                stages.append(np.full(mask.sum(), k))
            power = power @ system.A
        maps.append(end.H[self.last] @ power)
        rows.append(end.H[self.last])
        limits.append(end.h[self.last])
        self._map, self._rows = np.concatenate(maps), np.concatenate(rows)
        self._limits, self._stages = np.concatenate(limits), np.concatenate([*stages, last])
        self._plant = system.A, system.B, input_size(system.u_min, system.u_max)

    def broken(self, x0: np.ndarray, pushed: np.ndarray | None = None) -> bool:
        """Say whether one of them is broken from x0 (nx,), by more than counts as on the limit.

        ``pushed`` (N + 1, nx) is what a disturbance adds to the states, if there is one.
        """
        if not len(self._limits):
            return False
        beyond = self._map @ x0 - self._limits
        if pushed is not None:
            beyond += (self._rows * pushed[self._stages]).sum(axis=1)
        if not (beyond > 0).any():
            return False
        sizes = row_sizes(*self._plant, x0, self._rows, self._limits)
        return bool((beyond > ON_LIMIT * sizes).any())


class FixedCone:
    """The stages (N,) at which no input moves the outputs that a cone sees."""

    def __init__(self, system: LinearSystem, horizon: int, cone: SecondOrderCone) -> None:
        rows = np.concatenate([cone.F, cone.c[None]]) @ system.C
        self.stage = np.all(unmoved(system.A, system.B, rows, None, horizon), axis=1)
        self._cone, self._C = cone, system.C
        self._plant = system.A, system.B, input_size(system.u_min, system.u_max)

    def broken(self, x0: np.ndarray) -> bool:
        """Say whether it is broken there from x0 (nx,), by more than counts as on the limit."""
        cone, (A, B, u_size) = self._cone, self._plant
        step = np.abs(A) @ np.abs(x0) + np.abs(B) @ u_size
        y_size = np.abs(self._C) @ np.maximum(np.abs(x0), step)
        size = np.linalg.norm(np.abs(cone.F) @ y_size + np.abs(cone.g)) + np.abs(cone.c) @ y_size
        x = x0
        for fixed in self.stage:
            y = self._C @ x
            beyond = np.linalg.norm(cone.F @ y + cone.g) - cone.c @ y - cone.d
            if fixed and not beyond <= ON_LIMIT * max(abs(cone.d), float(size)):
                return True
            x = A @ x
        return False
