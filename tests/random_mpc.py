"""Random MPC problems, on stable and unstable plants, with an oracle that keeps the states.

Clarabel solves the sparse form, in which nothing grows with the horizon; a factorisation of the
optimality conditions with the rows that it found active then gives the digits that it leaves out.
"""

from __future__ import annotations

import dataclasses
import time

import clarabel
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from prefmpc import BatchedMPC, LinearSystem, Polyhedron, QuadraticCost

KINDS = ("bounds", "coupled", "terminal")
SHAPES = (
    (2, 1, 5), (2, 2, 40), (3, 1, 10), (3, 1, 60), (3, 2, 30), (4, 1, 100), (4, 2, 50), (4, 3, 20),
    (5, 1, 30), (6, 2, 100), (6, 3, 10), (7, 2, 25), (8, 1, 50), (8, 3, 15),
)  # fmt: skip
"""Numbers of states and inputs, and the horizon."""


@dataclasses.dataclass(frozen=True)
class Problems:
    """``plants`` plants of one size, and as many states for each: x0 (plants, states, nx)."""

    systems: list
    Q: np.ndarray
    R: np.ndarray
    horizon: int
    constraints: Polyhedron | None
    terminal: Polyhedron | None
    x0: np.ndarray

    def ours(self):
        """Return the solution of all by `BatchedMPC`."""
        return BatchedMPC(
            LinearSystem.stack(self.systems),
            QuadraticCost(self.Q, self.R),
            self.horizon,
            constraints=self.constraints,
            terminal=self.terminal,
        ).solve(self.x0)


def random_problems(shape, kind, plants, states, rng):
    """Draw spectral radii from 0.5 to 2, weights over two decades.

    States are such that the LQR asks for a twentieth to five times what the inputs can do.
    """
    nx, nu, N = shape
    systems, Q, R = [], [], []
    for _ in range(plants):
        A = rng.normal(size=(nx, nx))
        A *= rng.uniform(0.5, 2.0) / np.abs(np.linalg.eigvals(A)).max()
        B = rng.normal(size=(nx, nu))
        systems.append(LinearSystem(A, B, dt=0.1, u_min=-1, u_max=rng.uniform(0.5, 1.5, nu)))
        L, M = rng.normal(size=(nx, nx)), rng.normal(size=(nu, nu))
        Q.append(L @ L.T / nx + 10 ** rng.uniform(-2, 0) * np.eye(nx))
        R.append((M @ M.T + np.eye(nu)) * 10 ** rng.uniform(-2, 0.5))
    constraints = terminal = None
    if kind == "coupled":
        constraints = Polyhedron(rng.normal(size=(4, nx + nu)), rng.uniform(0.2, 1.5, 4))
    if kind == "terminal":
        terminal = Polyhedron.box([-0.3] * nx, [0.3] * nx)
    x0 = rng.normal(size=(plants, states, nx))
    for i, system in enumerate(systems):
        asked = np.abs(x0[i] @ system.lqr(Q[i], R[i])[0].T) / system.u_max
        x0[i] *= 10 ** rng.uniform(-1.3, 0.7, (states, 1)) / asked.max(axis=1, keepdims=True)
    return Problems(systems, np.array(Q), np.array(R), N, constraints, terminal, x0)


class Oracle:
    """The problem of one plant, for one state after another."""

    def __init__(self, problems, i):
        system, N = problems.systems[i], problems.horizon
        nx, nu = system.nx, system.nu
        self.split = nx * (N + 1)
        weights = [sp.kron(sp.eye(N), 2 * problems.Q[i]), sp.csc_matrix((nx, nx))]
        weights.append(sp.kron(sp.eye(N), 2 * problems.R[i]))
        self.P = sp.block_diag(weights, format="csc")
        now = sp.hstack([sp.eye(N), sp.csc_matrix((N, 1))])
        A = sp.kron(sp.eye(N + 1, k=-1), system.A) - sp.eye(self.split)
        B = sp.vstack([sp.csc_matrix((nx, N * nu)), sp.kron(sp.eye(N), system.B)])
        self.dynamics = sp.hstack([A, B], format="csc")
        box = sp.hstack([sp.csc_matrix((N * nu, self.split)), sp.eye(N * nu)])
        rows, h = [box, -box], [np.tile(system.u_max, N), np.tile(-system.u_min, N)]
        if (Z := problems.constraints) is not None:
            parts = sp.kron(now, Z.H[:, :nx]), sp.kron(sp.eye(N), Z.H[:, nx:])
            rows.append(sp.hstack(parts))
            h.append(np.tile(Z.h, N))
        if (end := problems.terminal) is not None:
            last = sp.kron(sp.csc_matrix(np.eye(N + 1)[-1:]), end.H)
            rows.append(sp.hstack([last, sp.csc_matrix((len(end.h), N * nu))]))
            h.append(end.h)
        self.G, self.h = sp.vstack(rows, format="csc"), np.concatenate(h)
        self.nothing = np.zeros(self.P.shape[0])
        self.seconds = 0.0

    def __call__(self, x0):
        """Return the status and the inputs (N·nu,); None if these are not known to all digits."""
        start = np.zeros(self.split)
        start[: len(x0)] = -x0
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        cones = [clarabel.ZeroConeT(len(start)), clarabel.NonnegativeConeT(len(self.h))]
        rows = sp.vstack([self.dynamics, self.G], format="csc")
        b = np.concatenate([start, self.h])
        began = time.perf_counter()
        found = clarabel.DefaultSolver(self.P, self.nothing, rows, b, cones, settings).solve()
        self.seconds += time.perf_counter() - began
        statuses = {"Solved": "solved", "PrimalInfeasible": "infeasible"}
        status = statuses.get(str(found.status), "unfinished")
        if status != "solved":
            return status, None
        active = np.array(found.z)[len(start) :] > np.array(found.s)[len(start) :]
        for _ in range(8):
            z, multipliers, exact = self._held(start, active)
            beyond = self.G @ z - self.h
            size = 1e-9 * (1 + np.abs(z).max()), 1e-9 * (1 + np.abs(multipliers).max())
            better = (active & (multipliers > -size[1])) | (beyond > size[0])
            if (better == active).all():
                return status, z[self.split :] if exact else None
            active = better
        return status, None

    def _held(self, start, active):
        """Return the optimum with these rows at their limits, the multipliers, whether exact."""
        held = sp.vstack([self.dynamics, self.G[active]], format="csc")
        limits = np.concatenate([start, self.h[active]])
        n, m = self.P.shape[0], len(limits)
        matrix = sp.bmat([[self.P, held.T], [held, None]], format="csc")
        soft = sp.block_diag([1e-9 * sp.eye(n), -1e-9 * sp.eye(m)], format="csc")
        right = np.concatenate([self.nothing, limits])
        factors = scipy.sparse.linalg.splu(matrix + soft)
        z = np.zeros(n + m)
        for _ in range(20):
            z += factors.solve(right - matrix @ z)
        miss = np.abs(right - matrix @ z) / (1 + abs(matrix) @ np.abs(z))
        multipliers = np.zeros(len(self.h))
        multipliers[active] = z[n + self.split :]
        return z[:n], multipliers, miss.max() < 1e-12


@dataclasses.dataclass
class Comparison:
    """Verdicts (ours, the oracle's), and differences of inputs relative to max(1, |u|)."""

    verdicts: list
    differences: list
    sound: bool
    active: float
    """Share of the solved problems in which a limit matters."""
    seconds: float
    """What Clarabel took."""


def compared(problems, answer=None):
    """Compare our answers with the oracle's."""
    answer = problems.ours() if answer is None else answer
    U = answer.trajectory.u.reshape(*answer.status.shape, -1)
    verdicts, differences, seconds = [], [], 0.0
    for i in range(len(problems.systems)):
        oracle = Oracle(problems, i)
        for k, x0 in enumerate(problems.x0[i]):
            status, inputs = oracle(x0)
            verdicts.append((str(answer.status[i, k]), status))
            if verdicts[-1] == ("solved", "solved") and inputs is not None:
                size = max(1.0, np.abs(inputs).max())
                differences.append(float(np.abs(U[i, k] - inputs).max() / size))
        seconds += oracle.seconds
    solved = answer.status == "solved"
    sound = np.isfinite(U[solved]).all() and (answer.residual[solved] <= 1e-8).all()
    sound &= np.isnan(U[~solved]).all()
    active = float((answer.iterations[solved] > 0).mean())
    return Comparison(verdicts, differences, bool(sound), active, seconds)
