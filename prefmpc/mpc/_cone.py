"""Cone programs that Clarabel solves again and again, each answer judged by its residual."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from prefmpc._units import power_of_two
from prefmpc.mpc._refine import Refiner
from prefmpc.mpc._turns import Turns

# Clarabel calls a point "almost solved" when it gets no further than the reduced tolerances. It
# has no say in what counts as solved here: that is the residual below.
_TOLERANCES = {
    **{"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8},
    **{"reduced_tol_gap_abs": 1e-6, "reduced_tol_gap_rel": 1e-6, "reduced_tol_feas": 1e-6},
}

TIGHT = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-10}
"""Where there is hardly any room u is sensitive; only exponential cones do not reach this."""

SOLVED = 1e-7
"""The largest residual of a solution."""

GOOD = 1e-11
"""A residual that needs no improvement."""

PROVEN = 1e-4
"""How exact a proof of infeasibility must be: it holds for all plans up to 1 / PROVEN units."""

FAR = 1e6
"""Limits so many units away are as good as none, and would only drown the others."""

# About one exponential-cone program in 2000 stops at a residual of 1e-6, by an unlucky rounding:
# other steps arrive.
_SECOND_TRIES: tuple[dict[str, Any], ...] = (
    {"max_step_fraction": 0.9},
    {"equilibrate_enable": False},
)

Cone = tuple[str, int]
"""A kind ("zero", "nonnegative", "second_order" or "exponential"), and a number of rows."""


@dataclasses.dataclass(frozen=True)
class ConeSolution:
    """A point, its multipliers, what Clarabel says of it, and the residual that is computed here.

    ``residual`` is the largest violation of the optimality conditions, in units of the problem;
    with the status "infeasible" that of the proof. ``unit`` is the size of z for which it was
    solved.
    """

    z: np.ndarray
    y: np.ndarray
    objective: float
    status: str
    message: str
    iterations: int
    residual: float
    unit: float = 1.0


class ConeProgram(Turns):
    """min ½ zᵀPz + qᵀz subject to b − A z in a product of cones; only b changes between solves.

    Set up once: a new b keeps ordering and symbolic factorisation. Every problem is solved in the
    unit in which its z is of order one. Several threads may use the same program, in turns.
    """

    def __init__(
        self,
        P: Any,
        q: np.ndarray,
        A: Any,
        b: np.ndarray,
        cones: Sequence[Cone],
        options: dict[str, Any] | None = None,
        good: float = GOOD,
    ) -> None:
        self._options, self._good = options or {}, good
        self._cones = [(kind, size) for kind, size in cones if size]
        A = sp.csr_matrix(A)
        biggest = np.asarray(abs(A).max(axis=1).todense()).ravel() if A.shape[0] else np.zeros(0)
        for kind, part in self._parts():
            if kind not in ("zero", "nonnegative"):
                biggest[part] = biggest[part].max()
        self._per_row = 1 / np.where(biggest > 0, biggest, 1.0)
        self._P, self._q = sp.csc_matrix(P), np.asarray(q, dtype=np.float64)
        self._A = sp.csc_matrix(sp.diags_array(self._per_row) @ A)
        self._A_by_columns = sp.csr_matrix(self._A.T)
        self._equations = np.zeros(len(b), dtype=bool)
        for kind, part in self._parts():
            self._equations[part] = kind == "zero"
        flat = all(kind in ("zero", "nonnegative") for kind, _ in self._cones)
        self._refine = Refiner(self._P, self._A) if flat else None
        self._mixed = bool(self._P.count_nonzero() and self._q.any())
        super().__init__()

    def _parts(self) -> list[tuple[str, slice]]:
        """Return the kind of every cone and its rows."""
        parts, at = [], 0
        for kind, size in self._cones:
            parts.append((kind, slice(at, at + size)))
            at += size
        return parts

    def _new_solver(self, options: dict[str, Any]) -> Any:
        import clarabel

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # it may drop rows, which then cannot be changed
        for name, value in {**_TOLERANCES, **self._options, **options}.items():
            setattr(settings, name, value)
        kinds = {
            "zero": clarabel.ZeroConeT,
            "nonnegative": clarabel.NonnegativeConeT,
            "second_order": clarabel.SecondOrderConeT,
            "exponential": lambda _: clarabel.ExponentialConeT(),
        }
        cones = [kinds[kind](size) for kind, size in self._cones]
        upper = sp.triu(self._P, format="csc")
        nothing = np.zeros(self._A.shape[0])
        return clarabel.DefaultSolver(upper, self._q, self._A, nothing, cones, settings)

    def _far(self, b: np.ndarray) -> float:
        """Return how far z = 0 is from feasible: about the size of z."""
        far = 0.0
        for kind, part in self._parts():
            own = b[part]
            if kind == "zero":
                miss = np.abs(own).max()
            elif kind == "nonnegative":
                miss = -own.min()
            elif kind == "second_order":
                miss = np.linalg.norm(own[1:]) - own[0]
            else:  # the size of an exponential is not to be chosen
                miss = 1.0
            far = max(far, float(miss))
        if self._mixed:  # with a linear cost z is not in proportion to b
            far = max(far, 1e-3 * float(np.abs(self._q).max()))
        return far

    def solve(self, b: np.ndarray) -> ConeSolution:
        """Solve for another b, same shape; never raises, the status says how it went."""
        b = b * self._per_row
        far = self._far(b)
        if far == 0 and not self._q.any():
            nothing = np.zeros(len(self._q)), np.zeros(len(b))
            return ConeSolution(*nothing, 0.0, "solved", "optimal", 0, 0.0)
        unit = power_of_two(far)
        q = self._q / unit if self._mixed else self._q
        b = b / unit
        near = b.copy()
        for kind, part in self._parts():
            if kind == "nonnegative":
                near[part] = np.minimum(near[part], FAR)
        with self._lock:
            if self._solver is None:
                self._solver = self._new_solver({})
            for options in (None, *_SECOND_TRIES):
                solver = self._solver if options is None else self._new_solver(options)
                if self._mixed:
                    solver.update(q=q)
                found = self._judged(self._run(solver, near), q, b)
                if found.status != "failed":
                    break
        z = found.z * unit
        scale = unit if self._mixed or not self._q.any() else 1.0
        objective = np.nan
        if found.status == "solved":
            objective = float(0.5 * z @ (self._P @ z) + self._q @ z)
        return dataclasses.replace(
            found, z=z, y=found.y * self._per_row * scale, objective=objective, unit=unit
        )

    @staticmethod
    def _run(solver: Any, b: np.ndarray) -> ConeSolution:
        solver.update(b=b)
        found = solver.solve()
        said = str(found.status)
        # Whether a point at which it got stuck is good enough, its residual says.
        status = dict.fromkeys(("Solved", "AlmostSolved", "InsufficientProgress"), "solved")
        status["PrimalInfeasible"] = "infeasible"
        return ConeSolution(
            z=np.array(found.x),
            y=np.array(found.z),
            objective=np.nan,
            status=status.get(said, "failed"),
            message="optimal" if said == "Solved" else f"Clarabel says {said!r}",
            iterations=int(found.iterations),
            residual=np.nan,
        )

    def _judged(self, found: ConeSolution, q: np.ndarray, b: np.ndarray) -> ConeSolution:
        """Return the same, improved where that is possible, with a status that its numbers bear."""
        if found.status == "infeasible":
            doubt = self._doubt(found.y, b)
            if doubt <= PROVEN:
                return dataclasses.replace(found, residual=doubt)
            note = f"{found.message}, with a proof that is off by {doubt:.1e}"
            return dataclasses.replace(found, status="failed", message=note, residual=doubt)
        if found.status != "solved":
            return dataclasses.replace(found, residual=self._residual(found.z, found.y, q, b))
        z, y = found.z, found.y
        residual = self._residual(z, y, q, b)
        if self._refine is not None and not residual <= self._good and np.isfinite(residual):
            low = np.where(self._equations, b, -np.inf)
            other = self._refine(q, low, b, z, y)
            if (less := self._residual(*other, q, b)) < residual:
                (z, y), residual = other, less
        if residual <= SOLVED:
            note = "optimal" if residual <= 1e-8 else f"optimal up to {residual:.1e}"
            return dataclasses.replace(found, z=z, y=y, residual=residual, message=note)
        note = f"{found.message}, but the optimality conditions are missed by {residual:.1e}"
        return dataclasses.replace(found, status="failed", message=note, residual=residual)

    def _residual(self, z: np.ndarray, y: np.ndarray, q: np.ndarray, b: np.ndarray) -> float:
        """Return the largest violation of the optimality conditions, relative to their terms."""
        with np.errstate(invalid="ignore", over="ignore"):
            return self._violation(z, y, q, b)

    def _violation(self, z: np.ndarray, y: np.ndarray, q: np.ndarray, b: np.ndarray) -> float:
        slope, pull, slack = self._P @ z, self._A_by_columns @ y, b - self._A @ z
        sizes = [np.abs(part).max(initial=1.0) for part in (slope, pull, q)]
        dual = np.abs(slope + pull + q).max(initial=0.0) / np.max(sizes)
        worth = max(1.0, abs(0.5 * z @ slope + q @ z))
        gap = abs(float(np.where(y == 0, 0.0, slack) @ y)) / worth
        outside = [
            [_outside(kind, slack[part]), _outside(kind, y[part], dual=True)]
            for kind, part in self._parts()
        ]
        high, wrong = np.max(outside, axis=0, initial=0.0)
        return float(np.max([dual, gap, high / max(1.0, np.abs(z).max()), wrong / np.max(sizes)]))

    def _doubt(self, y: np.ndarray, b: np.ndarray) -> float:
        """Return Aᵀy for a y in the dual cone, relative to −bᵀy: what a proof lacks; NaN if none.

        0 > bᵀy ≥ (A z)ᵀy is impossible for any z with ‖z‖ · doubt < 1.
        """
        short = -float(b @ y)
        wrong = np.max([0.0, *(_outside(k, y[part], dual=True) for k, part in self._parts())])
        if not short > 0 or not wrong <= 1e-9 * np.abs(y).max():
            return np.nan
        return float(np.abs(self._A_by_columns @ y).sum() / short)


def _outside(kind: str, s: np.ndarray, *, dual: bool = False) -> float:
    """Return how far s is outside of a cone, or of its dual one: 0 inside, NaN for NaN."""
    if kind == "zero":
        return 0.0 * float(s.sum()) if dual else float(np.abs(s).max())
    if kind == "nonnegative":
        return float(np.maximum(-s, 0.0).max())
    if kind == "second_order":
        return float(np.maximum(np.linalg.norm(s[1:]) - s[0], 0.0))
    # {b exp(a / b) ≤ c, b > 0} and its limits; the dual cone is the same one with other names.
    a, b, c = s if not dual else (-s[1], -s[0], np.e * s[2])
    if b > 0 and c > 0:
        return float(np.maximum(a - b * np.log(c / b), 0.0))
    return float(np.max([np.abs(b), -c, a, 0.0]))
