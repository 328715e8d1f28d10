"""What may be asked for beside the paper's problem: soft limits, increments, blocks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, is_whole, sequence
from prefmpc.mpc._stages import Bounds, StageProgram, beyond
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron

OPEN = 1e9
"""So many units an input may be from one that is not known."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What was asked for, checked.

    Attributes
    ----------
    soft, curved : array (m,), optional
        What breaking each row of the constraints costs: soft·s + curved·s², inf for hard rows.
    increment : array (nu,), optional
        Largest size of u_k − u_{k−1}.
    same : bool array (N,)
        At which stages the input is that of the stage before.
    """

    soft: np.ndarray | None
    curved: np.ndarray | None
    increment: np.ndarray | None
    same: np.ndarray

    @classmethod
    def of(
        cls,
        system: LinearSystem,
        horizon: int,
        constraints: Polyhedron | None,
        soft: ArrayLike | None,
        soft_quadratic: ArrayLike,
        max_increment: ArrayLike | None,
        blocks: Sequence[int] | None,
    ) -> Options | None:
        """Return None if nothing was asked for. Raises a ValueError that names what is wrong."""
        weights = curved = increment = None
        curvature = np.asarray(finite_array("soft_quadratic", soft_quadratic))
        if soft is None and curvature.any():
            raise ValueError(
                "soft_quadratic must be 0 without soft, which says what rows it is for"
            )
        if soft is not None:
            if constraints is None:
                raise ValueError(
                    "soft must be None without constraints: it is a weight of their rows"
                )
            rows = len(constraints.h)
            weights = _vector("soft", finite_array("soft", soft, allow_inf=True), rows)
            curved = _vector("soft_quadratic", curvature, rows)
            if not (weights > 0).all():
                raise ValueError(f"soft must be positive, got {weights}")
            if not (curved >= 0).all():
                raise ValueError(f"soft_quadratic must be at least 0, got {curved}")
            weights, curved = (weights, curved) if np.isfinite(weights).any() else (None, None)
        if max_increment is not None:
            given = finite_array("max_increment", max_increment, allow_inf=True)
            increment = _vector("max_increment", given, system.nu)
            if not (increment > 0).all():
                raise ValueError(f"max_increment must be positive, got {increment}")
        same = np.zeros(horizon, dtype=bool)
        if blocks is not None:
            lengths = sequence("blocks", blocks)
            if not all(is_whole(length) and length >= 1 for length in lengths):
                raise ValueError(f"blocks must hold whole numbers of at least 1, got {blocks}")
            if sum(lengths) != horizon:
                raise ValueError(f"blocks must add up to the horizon {horizon}, got {sum(lengths)}")
            same[:] = True
            same[np.cumsum([0, *lengths[:-1]])] = False
        if weights is None and increment is None and not same.any():
            return None
        return cls(weights, curved, increment, same)


def _vector(name: str, value: Any, size: int) -> np.ndarray:
    array = np.asarray(value)
    if array.shape not in ((), (size,)):
        raise ValueError(f"{name} must be a number or have shape ({size},), got {array.shape}")
    return np.broadcast_to(array, (size,)).copy()


class OptionProgram(StageProgram):
    """The same program with slacks after the inputs, and rows for what inputs may do in a step."""

    def __init__(
        self,
        system: LinearSystem,
        weights: tuple[np.ndarray, np.ndarray],
        horizon: int,
        constraints: Polyhedron | None,
        terminal: Polyhedron | None,
        final: np.ndarray | None,
        options: Options,
    ) -> None:
        soft = None if options.soft is None else np.isfinite(options.soft)
        super().__init__(system, weights, horizon, constraints, terminal, final, soft)
        self.options = options
        self.q: np.ndarray | None = None
        self._slacks = slice(self.equations + self.inputs, None)
        self._first: slice | None = None
        rows = sp.csr_array(self.rows)
        if options.soft is not None and constraints is not None:
            rows = self._softened(rows, constraints, options.soft, options.curved)
        steps, low, high = self._steps(options)
        if len(low):
            width = rows.shape[1] - self.equations
            padded = sp.hstack([sp.csr_array((len(low), self.equations)), steps])
            padded = sp.hstack([padded, sp.csr_array((len(low), width - self.inputs))])
            if options.increment is not None:
                self._first = slice(len(self._low), len(self._low) + system.nu)
            rows = sp.vstack([rows, padded])
            self._low, self._high = (
                np.concatenate(parts) for parts in ((self._low, low), (self._high, high))
            )
        self._far = beyond(self._low, self._high)
        self._ready(rows)

    def _softened(self, rows: Any, Z: Polyhedron, soft: np.ndarray, curved: Any) -> Any:
        """Add a slack to each soft row that an input moves, and its cost; return all rows."""
        N, moved = self._N, ~self.fixed.stage.ravel()
        sizes = np.abs(Z.H * np.concatenate([self.dx, self.du])).max(axis=1, initial=0.0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        stage = np.tile(np.arange(len(Z.h)), N)[moved]
        # The rows of Z come after the dynamics and the input bounds.
        start = rows.shape[0] - len(stage) - int((~self.fixed.last).sum())
        which = np.flatnonzero(np.isfinite(soft[stage]))
        kind, count = stage[which], len(which)
        minus = -np.ones(count)
        column = sp.csr_array((minus, (start + which, np.arange(count))), (rows.shape[0], count))
        own = sp.hstack([sp.csr_array((count, rows.shape[1])), sp.eye_array(count)])
        curvature = sp.diags_array(2 * curved[kind] * sizes[kind] ** 2)
        self.P = sp.csc_matrix(sp.block_diag([self.P, curvature]))
        self.q = np.concatenate([np.zeros(rows.shape[1]), soft[kind] * sizes[kind]])
        self._low = np.concatenate([self._low, np.zeros(count)])
        self._high = np.concatenate([self._high, np.full(count, np.inf)])
        return sp.vstack([sp.hstack([rows, column]), own])

    def _steps(self, options: Options) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return rows over the inputs, and their limits: u_k − u_{k−1}."""
        nu, N = self._nu, self._N
        difference = sp.kron(sp.eye_array(N) - sp.eye_array(N, k=-1), sp.eye_array(nu))
        limit = np.full(nu, np.inf) if options.increment is None else options.increment / self.du
        high = np.where(options.same[:, None], 0.0, limit)
        high[0] = np.minimum(high[0], OPEN) if options.increment is not None else np.inf
        high = high.ravel()
        kept = np.isfinite(high)
        if options.increment is not None:
            kept[:nu] = True
        return sp.csr_array(difference)[kept], -high[kept], high[kept]

    def limited(self, before: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, float] | None:
        """Return the limits for the input before (nu,), None or NaN if that is not known."""
        if self._first is None or self.options.increment is None:
            return None
        known, room = np.zeros(self._nu), np.full(self._nu, OPEN)
        if before is not None and np.isfinite(before).all():
            known, room = before / self.du, np.minimum(self.options.increment / self.du, OPEN)
        low, high = self._low.copy(), self._high.copy()
        low[self._first], high[self._first] = known - room, known + room
        return low, high, beyond(low, high)

    def bounds(
        self,
        x0: np.ndarray,
        reference: Any,
        push: np.ndarray | None = None,
        limits: tuple[np.ndarray, np.ndarray, float] | None = None,
    ) -> Bounds:
        """Return the limits, and the cost of slacks."""
        out = super().bounds(x0, reference, push, limits)
        return out if self.q is None else dataclasses.replace(out, q=self.q / out.unit)

    def _whole(self, plan: np.ndarray) -> np.ndarray:
        return np.pad(plan, (0, self.P.shape[0] - len(plan)))

    def objective(self, z: np.ndarray) -> float:
        """Return σ, without what slacks cost."""
        z = z.copy()
        z[self._slacks] = 0.0
        return super().objective(z)

    def _relative(self, bounds: Bounds, z: np.ndarray, y: np.ndarray) -> float:
        residual = super()._relative(bounds, z, y)
        if bounds.q is None:
            return residual
        part = self._slacks
        pull = (self._limits_by_columns @ y[self.equations :])[part]
        slope = (self.P @ z)[part] + bounds.q[part]
        sizes = np.maximum(np.maximum(np.abs(slope), np.abs(pull)), bounds.q[part])
        return float(np.max([residual, np.max(np.abs(slope + pull) / sizes)]))
