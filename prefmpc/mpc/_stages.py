"""The quadratic program of a linear controller, in units in which all is of order one."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse as sp

from prefmpc._units import cost_units, free_response, matters, power_of_two
from prefmpc.mpc._fixed import FixedRows
from prefmpc.mpc._limits import per_unit
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron

FLOOR = 1e-3
"""Residuals are relative to the sizes of their terms, but to no smaller share of the unit."""

ENOUGH = 1e-9
"""An upper bound on the residual that is good enough to be called the residual."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """What changes between two solves: the limits of all rows, the unit of the plan, its origin.

    The first nx rows are −x_0, as lower and upper limit. The plan is ``unit`` z + ``origin``.
    ``q`` is a linear cost in these units, None without one.
    """

    lower: np.ndarray
    upper: np.ndarray
    unit: float
    origin: np.ndarray | None
    q: np.ndarray | None = None


class StageProgram:
    """min ½ zᵀPz over lower ≤ rows z ≤ upper with z = (x_0 … x_N, u_0 … u_{N−1}) in own units.

    The rows are the dynamics, the input bounds, Z and X_N; those of Z and X_N that no input moves
    are `FixedRows`, and left out.
    """

    def __init__(
        self,
        system: LinearSystem,
        weights: tuple[np.ndarray, np.ndarray],
        horizon: int,
        constraints: Polyhedron | None,
        terminal: Polyhedron | None,
        final: np.ndarray | None,
        soft: np.ndarray | None = None,
    ) -> None:
        self.fixed = FixedRows(system, horizon, constraints, terminal, soft)
        Q, R = weights
        units = cost_units(system.A, system.B, Q, R, final=final, steps=horizon)
        self.dx, self.du = dx, du = units
        self._N, self._nx, self._nu = horizon, system.nx, system.nu
        self._A, self._B = system.A * dx / dx[:, None], system.B * du / dx[:, None]
        self._Q, self._R = 2 * Q * dx * dx[:, None], 2 * R * du * du[:, None]
        end = np.zeros_like(Q) if final is None else final
        self._last = 2 * end * dx * dx[:, None]
        self._aside = ~matters(self._A, self._Q + self._last)
        self._some_aside = bool(self._aside.any())
        self._still = np.zeros(horizon * system.nu)
        stages = sp.eye_array(horizon)
        P = [sp.kron(stages, self._Q), sp.csc_array(self._last), sp.kron(stages, self._R)]
        self.P = sp.csc_matrix(sp.block_diag(P))
        limits, self._low, self._high = self._limits(system, constraints, terminal)
        self._far = beyond(self._low, self._high)
        steps = sp.eye_array(horizon + 1)
        back = sp.eye_array(horizon + 1, k=-1)
        forcing = [sp.csc_array((system.nx, horizon * system.nu)), sp.kron(stages, self._B)]
        dynamics = sp.hstack(
            [sp.kron(back, self._A) - sp.kron(steps, np.eye(system.nx)), sp.vstack(forcing)]
        )
        self.equations, self.inputs = (horizon + 1) * system.nx, horizon * system.nu
        self._ready(sp.vstack([dynamics, limits]))

    def _ready(self, rows: Any) -> None:
        """Take over all rows, and prepare what judges an answer."""
        self.rows, limits = sp.csc_matrix(rows), sp.csr_array(rows)[self.equations :]
        self._limits_by_rows = sp.csr_matrix(limits)
        self._limits_by_columns = sp.csr_matrix(limits.T)
        conditions = sp.block_array([[self.P, self.rows.T], [self.rows, None]])
        self._conditions = sp.csr_matrix(conditions)

    def _limits(
        self, system: LinearSystem, constraints: Polyhedron | None, terminal: Polyhedron | None
    ) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return rows over z, each with a largest entry of 1, and their lower and upper limits."""
        N, nx, nu = self._N, self._nx, self._nu
        states, inputs = (N + 1) * nx, N * nu
        bounded = np.tile(np.isfinite(system.u_min) | np.isfinite(system.u_max), N)
        box = sp.hstack([sp.csr_array((inputs, states)), sp.eye_array(inputs)]).tocsr()[bounded]
        rows = [box]
        lower, upper = ([np.tile(b / self.du, N)[bounded]] for b in (system.u_min, system.u_max))
        sets = []
        if constraints is not None:
            H, h = per_unit(constraints.H * np.concatenate([self.dx, self.du]), constraints.h)
            stages = sp.hstack([sp.eye_array(N), sp.csr_array((N, 1))])
            parts = [sp.kron(stages, H[:, :nx]), sp.kron(sp.eye_array(N), H[:, nx:])]
            sets.append((sp.hstack(parts).tocsr(), np.tile(h, N), self.fixed.stage.ravel()))
        if terminal is not None:
            H, h = per_unit(terminal.H * self.dx, terminal.h)
            before, after = sp.csr_array((len(h), N * nx)), sp.csr_array((len(h), inputs))
            sets.append((sp.hstack([before, sp.csr_array(H), after]).tocsr(), h, self.fixed.last))
        for H, h, fixed in sets:
            rows.append(H[~fixed])
            lower.append(np.full((~fixed).sum(), -np.inf))
            upper.append(h[~fixed])
        return sp.vstack(rows), np.concatenate(lower), np.concatenate(upper)

    def bounds(
        self,
        x0: np.ndarray,
        reference: Any,
        push: np.ndarray | None = None,
        limits: tuple[np.ndarray, np.ndarray, float] | None = None,
    ) -> Bounds:
        """Return the limits for the state x0 (nx,), of deviations from the reference if any.

        The reference has x (nx,) and u (nu,), or x (N + 1, nx) and u (N, nu); ``push`` (N, nx) is
        added to the next states; ``limits`` are those of the rows after the dynamics and how far
        0 is beyond them, if they change. The unit is how far z = 0 is from x_0, from following
        the reference and from the limits, so that small plans are as exact as large ones: a power
        of 2. What σ does not see, such as a position far away, is part of the origin, with what
        becomes of it without inputs.
        """
        low, high, far = (self._low, self._high, self._far) if limits is None else limits
        x, origin = x0 / self.dx, None
        force = None if push is None else push / self.dx
        if reference is not None:
            r, u = reference.x / self.dx, reference.u / self.du
            if r.ndim == 2:
                force = (0.0 if force is None else force) + r[:-1] @ self._A.T - r[1:]
                force = force + u @ self._B.T
                x, origin = x - r[0], np.concatenate([r.ravel(), u.ravel()])
            else:
                x, origin = x - r, np.concatenate([np.tile(r, self._N + 1), np.tile(u, self._N)])
                if force is not None:
                    force = force + self._A @ r + self._B @ u - r
        if self._some_aside and (aside := x * self._aside).any():
            x = x - aside
            drift = np.concatenate([free_response(self._A, aside, self._N).ravel(), self._still])
            origin = drift if origin is None else origin + drift
        if origin is not None:
            shift = self._limits_by_rows @ self._whole(origin)
            low, high = low - shift, high - shift
            far = beyond(low, high)
        size = max(float(np.abs(x).max()), far)
        if force is not None:
            size = max(size, float(np.abs(force).max()))
        unit = power_of_two(size)
        lower, upper = np.zeros((2, self.rows.shape[0]))
        lower[: x.size] = upper[: x.size] = x / -unit
        if force is not None:
            lower[x.size : self.equations] = upper[x.size : self.equations] = force.ravel() / -unit
        with np.errstate(over="ignore"):
            lower[self.equations :], upper[self.equations :] = low / unit, high / unit
        return Bounds(lower, upper, unit, origin)

    def _whole(self, plan: np.ndarray) -> np.ndarray:
        """Return z for a plan of states and inputs."""
        return plan

    def split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (N + 1, nx) and the inputs (N, nu) of z."""
        X, U = z[: self.equations], z[self.equations : self.equations + self.inputs]
        return X.reshape(-1, self._nx), U.reshape(-1, self._nu)

    def objective(self, z: np.ndarray) -> float:
        """Return σ."""
        return 0.5 * float(z @ (self.P @ z))

    def residual(self, bounds: Bounds, z: np.ndarray, y: np.ndarray) -> float:
        """Return the largest violation of the optimality conditions; NaN if z or y are.

        Of the dynamics and of stationarity for each signal, relative to its size along the plan:
        a state that is large must not hide another one.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            quick = self._at_most(bounds, z, y)
            return quick if quick <= ENOUGH else self._relative(bounds, z, y)

    def _at_most(self, bounds: Bounds, z: np.ndarray, y: np.ndarray) -> float:
        """Return what the residual cannot exceed; all that an exact answer has to pass."""
        left = self._conditions @ np.concatenate([z, y])
        slope, at = left[: len(z)], left[len(z) :]
        if bounds.q is not None:
            slope = slope + bounds.q
        beyond = np.maximum(at - bounds.upper, bounds.lower - at)
        told = y.nonzero()[0]
        w, at = y[told], at[told]
        w *= np.where(w > 0, bounds.upper[told] - at, at - bounds.lower[told])
        worst = np.abs(slope).max(), beyond.max(), np.abs(w).max(initial=0.0)
        return float(np.max(worst)) / FLOOR

    def _relative(self, bounds: Bounds, z: np.ndarray, y: np.ndarray) -> float:
        X, U = self.split(z)
        slopes = X @ self._Q, U @ self._R
        slopes[0][-1] = X[-1] @ self._last
        L, w = y[: self.equations].reshape(-1, self._nx), y[self.equations :]
        from_limits = self.split(self._limits_by_columns @ w)
        from_dynamics = L[1:] @ self._B
        on_x, on_u = slopes[0] - L + from_limits[0], slopes[1] + from_dynamics + from_limits[1]
        on_x[:-1] += L[1:] @ self._A
        defect = X + bounds.lower[: self.equations].reshape(X.shape)
        defect[1:] -= X[:-1] @ self._A.T + U @ self._B.T
        at, low, high = self._limits_by_rows @ z, *self._of_limits(bounds)
        room = np.where(w > 0, high - at, at - low)[w != 0]
        beyond = np.maximum(at - high, low - at) / np.maximum(FLOOR, np.abs(at))
        worth = np.maximum(FLOOR, self.objective(z))
        parts = [
            _relative(on_x, slopes[0], L),
            _relative(on_u, slopes[1], from_dynamics),
            _relative(defect, X, X),
            beyond.max(initial=0.0),
            np.abs(w[w != 0] * room).max(initial=0.0) / worth,
        ]
        return float(np.max(parts))

    def doubt(self, bounds: Bounds, y: np.ndarray) -> float:
        """Return what y lacks as a proof that there is no plan; NaN if it is none.

        All plans with ‖z‖∞ · doubt < 1 are ruled out.
        """
        limit = np.where(y > 0, bounds.upper, bounds.lower)
        gap = -float(limit[y != 0] @ y[y != 0])
        return float(np.abs(self.rows.T @ y).sum() / gap) if gap > 0 else np.nan

    def _of_limits(self, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
        return bounds.lower[self.equations :], bounds.upper[self.equations :]


def beyond(low: np.ndarray, high: np.ndarray) -> float:
    """Return how far 0 is beyond the limits, 0 within."""
    return max(float(low.max(initial=0.0)), -float(high.min(initial=0.0)))


def _relative(miss: np.ndarray, first: np.ndarray, second: np.ndarray) -> Any:
    """Return the largest miss (k, n) relative to the largest size of each column's terms."""
    sizes = np.maximum(np.abs(first).max(axis=0), np.abs(second).max(axis=0))
    return (np.abs(miss).max(axis=0) / np.maximum(sizes, FLOOR)).max()


def pushed_states(A: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Return what disturbances (N, nx) add to the states x_0 … x_N."""
    out = [np.zeros(len(A))]
    for d in push:
        out.append(A @ out[-1] + d)
    return np.stack(out)
