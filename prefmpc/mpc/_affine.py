"""The quadratic program of a linear controller as a function of the state, written out in full."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from prefmpc.mpc._options import OptionProgram
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.steady import SteadyState

TINY = 1e-14
"""Entries of a condensed row below this share of its largest are rounding."""


@dataclasses.dataclass(frozen=True)
class AffineProgram:
    """min ½ zᵀPz + (q + F p)ᵀz over lower ≤ rows z − E p ≤ upper; the first input is S z + T p.

    p is the state and, where there can be one, the set point (x_r, u_r), a constant disturbance,
    the input before. The first ``equations`` rows are the dynamics; these determine as many
    entries of z, after which come ``inputs`` ones.
    """

    P: Any
    q: np.ndarray
    F: np.ndarray
    rows: Any
    lower: np.ndarray
    upper: np.ndarray
    E: np.ndarray
    S: np.ndarray
    T: np.ndarray
    equations: int
    inputs: int

    @classmethod
    def of(cls, controller: LinearMPC, *, disturbance: bool = False) -> AffineProgram:
        """Return the sparse form, found by asking the controller for its limits."""
        program, system = controller._program, controller.system
        nx, nu, N = system.nx, system.nu, controller.horizon
        stepped = isinstance(program, OptionProgram) and program.options.increment is not None
        sizes = [nx, *((0, 0) if controller._ingredients else (nx, nu)), nx * disturbance]
        ends = np.cumsum(sizes)
        size = int(ends[-1]) + nu * stepped
        n, m = program.rows.shape[1], program.rows.shape[0]
        at = np.arange(program.equations, program.equations + nu)

        def parts(p: np.ndarray) -> np.ndarray:
            x, x_r, u_r, d, before = np.split(p, ends)
            held = SteadyState(x_r, u_r, system.C @ x_r) if len(x_r) else None
            push = np.tile(d, (N, 1)) if len(d) else None
            limits = program.limited(before) if isinstance(program, OptionProgram) else None
            bounds = program.bounds(x, held, push, limits)
            origin = np.zeros(n) if bounds.origin is None else bounds.origin
            both = bounds.lower * bounds.unit, bounds.upper * bounds.unit
            return np.concatenate([*both, origin[at] * program.du])

        base = parts(np.zeros(size))
        with np.errstate(invalid="ignore"):
            slopes = np.stack([parts(p) - base for p in np.eye(size)], axis=1)
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        lower, upper, _ = np.split(base, [m, 2 * m])
        E = np.where(np.isfinite(upper)[:, None], slopes[m : 2 * m], slopes[:m])
        S = np.zeros((nu, n))
        S[np.arange(nu), at] = program.du
        nothing = np.zeros((n, size))
        linear = getattr(program, "q", None)
        q = np.zeros(n) if linear is None else linear
        fixed = q, nothing, sp.csr_array(program.rows), lower, upper, E, S
        return cls(sp.csr_array(program.P), *fixed, slopes[2 * m :], program.equations, N * nu)

    @property
    def condition(self) -> float:
        """Condition of the part of P that belongs to inputs, which come first, by eigenvalues."""
        values = np.linalg.eigvalsh(self.P.toarray()[: self.inputs, : self.inputs])
        return float(values[-1] / values[0]) if values[0] > 0 else np.inf

    def condensed(self) -> AffineProgram:
        """Return the program without the dynamics and the states, each variable with curvature 1.

        Entries that grow with an unstable plant are finite but may be large: see `condition`.
        """
        k = self.equations
        rows = self.rows.toarray()
        states, rest = rows[:k, :k], rows[:k, k:]
        one = np.concatenate([-rest, self.E[:k], self.lower[:k, None]], axis=1)
        found = scipy.linalg.solve_triangular(states, one, lower=True)
        free = rows.shape[1] - k
        W, Z, z0 = np.split(found, [free, free + self.E.shape[1]], axis=1)
        W = np.concatenate([W, np.eye(free)])
        Z, z0 = (np.concatenate([part, np.zeros((free, part.shape[1]))]) for part in (Z, z0))
        P = W.T @ (self.P @ W)
        curvature = np.diag(P)
        W = W / np.sqrt(np.where(curvature > 0, curvature, 1.0))
        P = W.T @ (self.P @ W)
        G, base = rows[k:] @ W, (rows[k:] @ z0)[:, 0]
        length = np.abs(G).max(axis=1, initial=0.0)
        G = np.where(np.abs(G) > TINY * length[:, None], G, 0.0)
        length = np.where(length > 0, length, 1.0)
        E = self.E[k:] - rows[k:] @ Z
        return AffineProgram(
            sp.csr_array((P + P.T) / 2),
            W.T @ (self.q + (self.P @ z0)[:, 0]),
            W.T @ (self.F + self.P @ Z),
            sp.csr_array(G / length[:, None]),
            (self.lower[k:] - base) / length,
            (self.upper[k:] - base) / length,
            np.where(np.abs(E) > TINY * np.abs(E).max(initial=0.0), E, 0.0) / length[:, None],
            self.S @ W,
            self.T + self.S @ Z,
            0,
            self.inputs,
        )

    def merged(self) -> AffineProgram:
        """Return the same with one row where two bound the same from both sides."""
        whole = np.concatenate([self.rows.toarray(), self.E], axis=1) + 0.0
        lower, upper = self.lower.copy(), self.upper.copy()
        seen: dict[bytes, int] = {}
        kept = []
        for i, row in enumerate(whole):
            same, turned = seen.get(row.tobytes()), seen.get((-row + 0.0).tobytes())
            if same is not None:
                lower[same], upper[same] = max(lower[same], lower[i]), min(upper[same], upper[i])
            elif turned is not None:
                lower[turned] = max(lower[turned], -upper[i])
                upper[turned] = min(upper[turned], -lower[i])
            else:
                seen[row.tobytes()] = i
                kept.append(i)
        return dataclasses.replace(
            self, rows=self.rows[kept], lower=lower[kept], upper=upper[kept], E=self.E[kept]
        )

    def at(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the linear cost and the limits for the parameters p."""
        shift = self.E @ p
        return self.q + self.F @ p, self.lower + shift, self.upper + shift
