"""Units in which a nonlinear program is solved: the same numbers whatever the user's units are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from prefmpc.mpc._limits import ON_LIMIT
from prefmpc.mpc._nlp import Program
from prefmpc.mpc._shooting import Slopes


@dataclasses.dataclass(frozen=True)
class Units:
    """What the units of z, f and c are, in those of the program that was given.

    Attributes
    ----------
    plan : array (n,)
        With the values of what cannot move.
    free : bool array (n,)
    z : array (free,)
    f : float
    c : array (m,)
    relaxed : array (m,)
        How far beyond their limit constraints are that nothing can move, and that are near enough.
    """

    plan: np.ndarray
    free: np.ndarray
    z: np.ndarray
    f: float
    c: np.ndarray
    relaxed: np.ndarray

    def whole(self, z: np.ndarray) -> np.ndarray:
        """Return all of z in the units of the program that was given."""
        out = self.plan.copy()
        out[self.free] = z * self.z
        return out

    def part(self, plan: np.ndarray) -> np.ndarray:
        """Return what is free, in these units."""
        return plan[self.free] / self.z


def own_units(program: Program, guess: np.ndarray, inputs: int) -> tuple[Program, Units]:
    """Return the program in units of its own, taken from where it starts.

    An input without two limits is measured by how far it is from its optimum, as a diagonal
    Newton step sees it; f by the size of its slopes; a constraint by its own size. All are powers
    of two, so that no digit is lost. Constraints that nothing can move and that are as good as on
    their limit are taken to be on it.
    """
    slopes = program.slopes(guess)
    curvature = np.abs(np.diag(program.curvature(guess, np.zeros(program.rows))))
    free = program.upper > program.lower
    open_ended = free & ~np.isfinite(program.upper - program.lower)
    z = np.ones(guess.size)
    if open_ended.any():
        slope, curve = (part.reshape(-1, inputs).max(0) for part in (slopes.size, curvature))
        known = np.stack([guess, program.lower, program.upper]).reshape(3, -1, inputs)
        known = np.where(np.isfinite(known), np.abs(known), 0.0).max((0, 1))
        with np.errstate(all="ignore"):
            step = np.maximum(slope / curve, known)
        step = np.tile(_power(step), guess.size // inputs)
        z[open_ended] = step[open_ended]
    size = float((slopes.size * z)[free].max(initial=0.0))
    f = _power(size if size > 0 else (curvature * z**2)[free].max(initial=0.0))
    c = _power(np.where(slopes.near > 0, slopes.near, slopes.rows))
    now = program.values(guess)[1]
    still = ~slopes.jacobian.any(axis=1) & (now <= ON_LIMIT * slopes.near)
    relaxed = np.where(still, np.maximum(now, 0.0), 0.0)
    units = Units(guess.copy(), free, z[free], float(f), c, relaxed)
    return _converted(program, units), units


def _power(size: Any) -> np.ndarray:
    """Return the nearest power of two of each size, 1 where there is none."""
    size = np.asarray(size, float)
    good = np.isfinite(size) & (size > 0)
    return np.where(good, np.exp2(np.round(np.log2(np.where(good, size, 1.0)))), 1.0)


def _converted(program: Program, units: Units) -> Program:
    free, everything = units.free, bool(units.free.all())
    columns = units.z / units.f
    steps = units.z * columns[:, None]

    def values(z: np.ndarray) -> tuple[float, np.ndarray]:
        f, c = program.values(units.whole(z))
        return f / units.f, (c - units.relaxed) / units.c

    def slopes(z: np.ndarray) -> Slopes:
        out = program.slopes(units.whole(z))
        if not everything:
            out = out._replace(
                gradient=out.gradient[free], jacobian=out.jacobian[:, free], size=out.size[free]
            )
        return Slopes(
            out.gradient * columns,
            out.jacobian * units.z / units.c[:, None],
            out.size * columns,
            out.rows / units.c,
            out.near / units.c,
        )

    def curvature(z: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        H = program.curvature(units.whole(z), multipliers * (units.f / units.c))
        return (H if everything else H[np.ix_(free, free)]) * steps

    lower, upper = units.part(program.lower), units.part(program.upper)
    return Program(values, slopes, curvature, lower, upper, program.rows)
