"""Newton's method for nonlinear programs: a sequence of quadratic ones, with exact curvature.

Where it gets stuck SciPy's SLSQP takes over, whose quasi-Newton matrix is always convex.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.optimize import minimize

from prefmpc.mpc._nlp import Attempt, Program, judged, violation
from prefmpc.mpc._quadratic import convex, quadratic_program

NEWTON_STEPS = 60
SHORTEST = 1e-3
"""Newton steps that have to be shorter than this fraction lead nowhere."""

BALANCED = 1e-11
"""A point whose slopes are balanced so well, relative to their terms, needs no further step."""

TINY = 1e-300
HUGE = 1e20
SLSQP_LIMIT = 9  # SLSQP's code for the iteration limit


def attempt(program: Program, start: np.ndarray, max_iterations: int, tol: float) -> Attempt:
    """Look for a minimum from ``start``, and judge what was found."""
    z = program.clipped(start)
    if not z.size:  # every input is locked
        return judged(program, z, False, 0)
    best = judged(program, *_newton(program, z, min(max_iterations, NEWTON_STEPS)))
    if best.good(tol):
        return best
    # A fresh quasi-Newton matrix often gets on from where an old one was stuck.
    count, begin = best.iterations, best.z if best.feasible else z
    for _ in range(2):
        z, limited, iterations = _slsqp(program, begin, max_iterations)
        again = judged(program, z, limited, count + iterations)
        if not best.feasible or (again.residual < best.residual and again.feasible):
            best = again
        count, begin = again.iterations, again.z
        if again.good(tol) or again.limited or not again.feasible:
            break
    return dataclasses.replace(best, iterations=count, limited=again.limited)


def _newton(program: Program, z: np.ndarray, steps: int) -> tuple[np.ndarray, bool, int]:
    """Return the point, whether ``steps`` were too few, and how many were taken.

    Few steps, of which each costs more: a minimum is reached in 2 to 10 of them as a rule. Stops
    where a quadratic program has no solution or no step improves the merit function.
    """
    eye = np.eye(z.size)
    up, down = np.isfinite(program.upper), np.isfinite(program.lower)
    multipliers = np.zeros(program.rows + int(up.sum()) + int(down.sum()))
    weight = 0.0
    for count in range(1, steps + 1):
        c = program.values(z)[1]
        gradient, jacobian, size, *_ = program.slopes(z)
        A = np.concatenate([jacobian, eye[up], -eye[down]])
        b = np.concatenate([-c, (program.upper - z)[up], (z - program.lower)[down]])
        size = np.maximum(size, TINY)
        stationary = (gradient + multipliers @ A) / size
        conditions = stationary, multipliers * b / size.max(), np.minimum(b, 0)
        if all((np.abs(residual) <= BALANCED).all() for residual in conditions):
            return z, False, count - 1
        H = program.curvature(z, multipliers[: program.rows])
        if not all(np.isfinite(part).all() for part in (gradient, jacobian, H)):
            break
        H, exact = convex((H + H.T) / 2, A[multipliers > 0])
        found = quadratic_program(H, gradient, A, b)
        if found is None:
            break
        step, multipliers = found
        weight = max(1.5 * np.max(multipliers[: program.rows], initial=0.0), weight / 2)
        length = _line_search(program, z, step, float(gradient @ step), weight)
        if length is None:
            break
        z = program.clipped(z + length * step)
        # The next step is the square of this one; what counts is its size beside the plan's. A tiny
        # step that the line search shortens is rounding.
        size_of_z = min(1.0, float(np.abs(z).max()))
        tolerance = (1e-6 if exact else 1e-9) if length == 1 else 1e-8
        if np.abs(step).max() <= max(tolerance * np.sqrt(size_of_z), TINY):
            break
    else:
        return z, True, steps
    return z, False, count


def _line_search(
    program: Program, z: np.ndarray, step: np.ndarray, slope: float, weight: float
) -> float | None:
    """Return a step length that lessens f + weight·Σ max(c, 0) enough, None if all are too short.

    Armijo's rule; ``slope`` is ∇f along the step.
    """

    def merit(z: np.ndarray) -> tuple[float, float]:
        f, c = program.values(z)
        penalty = weight * np.maximum(c, 0).sum()
        return f + penalty, penalty

    before, penalty = merit(z)
    gain = min(slope - penalty, 0.0)
    # Rounding may raise the merit a little where nothing is left to gain.
    slack = 1e-12 * (abs(before) + weight)
    length = 1.0
    while length >= SHORTEST:
        trial = program.clipped(z + length * step)
        if merit(trial)[0] <= before + 1e-4 * length * gain + slack:
            return length
        length /= 2
    return None


def _slsqp(
    program: Program, start: np.ndarray, max_iterations: int
) -> tuple[np.ndarray, bool, int]:
    def values(z: np.ndarray) -> tuple[float, np.ndarray]:
        f, c = program.values(z)
        if np.isfinite(f) and np.isfinite(c).all():
            return f, c
        return HUGE, np.zeros_like(c)  # a trial step that leaves the numbers is only too long

    size = float(program.slopes(start).size.max()) or 1.0
    size = size if np.isfinite(size) else 1.0
    rows = {
        "type": "ineq",
        "fun": lambda z: -values(z)[1],
        "jac": lambda z: -program.slopes(z).jacobian,
    }
    found = minimize(
        lambda z: values(z)[0] / size,
        start,
        jac=lambda z: program.slopes(z).gradient / size,
        bounds=list(zip(program.lower, program.upper, strict=True)),
        constraints=[rows] if program.rows else [],
        method="SLSQP",
        options={"maxiter": max_iterations, "ftol": 1e-13},
    )
    return np.asarray(found.x), int(found.status) == SLSQP_LIMIT, int(found.nit)


def least_violation(program: Program, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point near ``start`` with the smallest Σ max(c, 0)², and its largest violation."""

    def value_and_slope(z: np.ndarray) -> tuple[float, np.ndarray]:
        _, c = program.values(z)
        if not np.isfinite(c).all():
            return HUGE, np.zeros_like(z)
        excess = np.maximum(c, 0)
        return float(excess @ excess) / 2, excess @ program.slopes(z).jacobian

    box = list(zip(program.lower, program.upper, strict=True))
    options = {"ftol": 1e-15, "gtol": 1e-10}  # half the square of what is feasible, and less
    found = minimize(
        value_and_slope,
        program.clipped(start),
        jac=True,
        bounds=box,
        method="L-BFGS-B",
        options=options,
    )
    z = program.clipped(found.x)
    return z, violation(program, z)
