"""Bounded nonlinear programs min f(z), c(z) ≤ 0, lower ≤ z ≤ upper: three solvers and a check."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize, nnls

from prefmpc.mpc._limits import ON_LIMIT
from prefmpc.mpc._quadratic import convex, quadratic_program
from prefmpc.mpc._shooting import Slopes

ACTIVE = 1e-6
"""A constraint this close to its limit, relative to its size, may carry a multiplier."""

FEASIBLE = ON_LIMIT
"""How far beyond its limit a constraint may be, relative to its size."""

SLSQP_LIMIT = 9  # SLSQP's code for the iteration limit; IPOPT's is below
IPOPT_LIMIT = -1
HUGE = 1e20

NEWTON_STEPS = 60
SHORTEST = 1e-3
"""Newton steps that have to be shorter than this fraction lead nowhere."""

BALANCED = 1e-11
"""A point whose slopes are balanced so well, relative to their terms, needs no further step."""

REMEMBERED = 4


@dataclasses.dataclass(frozen=True)
class Program:
    """Functions of z (n,), already compiled.

    All is in units in which the numbers here have a meaning; see `own_units`.

    Attributes
    ----------
    values : z → f, c (m,)
    slopes : z → ∇f (n,), ∂c/∂z (m, n), and the sizes of both
    curvature : z, multipliers (m,), factor → factor·∇²f + Σ_i multiplier_i ∇²c_i, (n, n)
    lower, upper : array (n,)
    rows : m
    """

    values: Callable[[Any], tuple[float, np.ndarray]]
    slopes: Callable[[Any], Slopes]
    curvature: Callable[[Any, Any, float], np.ndarray]
    lower: np.ndarray
    upper: np.ndarray
    rows: int


def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, which looks up its latest answers instead of computing them again.

    Who chooses where to start, the solvers and the check at the end ask about the same points.
    """
    answers: dict[tuple[bytes, ...], Any] = {}

    def ask(*arrays: np.ndarray) -> Any:
        point = tuple(array.tobytes() for array in arrays)
        if point not in answers:
            if len(answers) == REMEMBERED:
                del answers[next(iter(answers))]
            answers[point] = function(*arrays)
        return answers[point]

    return ask


@dataclasses.dataclass(frozen=True)
class Attempt:
    """Where a solver stopped: the point, whether for its iteration limit, and what was reached."""

    z: np.ndarray
    limited: bool
    iterations: int
    violation: float
    residual: float

    @property
    def feasible(self) -> bool:
        """Whether the point satisfies the constraints."""
        return bool(self.violation <= FEASIBLE)

    def good(self, tol: float) -> bool:
        """Whether it also satisfies the conditions for a minimum."""
        return self.feasible and bool(self.residual <= tol)


def attempt(
    program: Program, start: np.ndarray, solver: str, max_iterations: int, tol: float
) -> Attempt:
    """Run a solver from ``start``, and judge where it stops without trusting what it says."""
    z = np.clip(start, program.lower, program.upper)
    if not z.size:  # every input is locked
        return _judge(program, z, False, 0)
    if solver == "ipopt":
        return _judge(program, *_ipopt(program, z, max_iterations))
    best = _judge(program, *_newton(program, z, min(max_iterations, NEWTON_STEPS)))
    if best.good(tol):
        return best
    # Quasi-Newton steps take over; a fresh matrix often gets on from where an old one was stuck.
    count, begin = best.iterations, best.z if best.feasible else z
    for _ in range(2):
        z, limited, more = _slsqp(program, begin, max_iterations)
        again = _judge(program, z, limited, count + more)
        if not best.feasible or (again.residual < best.residual and again.feasible):
            best = again
        count, begin = again.iterations, again.z
        if again.good(tol) or again.limited or not again.feasible:
            break
    return dataclasses.replace(best, iterations=count, limited=again.limited)


def promising(program: Program, guesses: list[np.ndarray]) -> list[np.ndarray]:
    """Return the points to start from, the most promising first: small f, few limits broken."""
    if len(guesses) == 1:
        return guesses
    f, c = (np.array(part) for part in zip(*map(program.values, guesses), strict=True))
    broken = np.zeros(len(f))
    if (c > 0).any():
        size = program.slopes(guesses[0]).near
        broken = (np.maximum(c, 0) / np.where(size > 0, size, 1.0)).sum(axis=1)
    merit = f + 1e3 * np.abs(f[np.isfinite(f)]).max(initial=0.0) * broken
    order = np.lexsort((broken, np.where(np.isfinite(merit), merit, np.inf)))
    return [guesses[i] for i in order]


def least_violation(program: Program, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point near ``start`` with the smallest Σ max(c, 0)², and its largest violation."""

    def value_and_slope(z: np.ndarray) -> tuple[float, np.ndarray]:
        _, c = program.values(z)
        if not np.isfinite(c).all():
            return HUGE, np.zeros_like(z)
        excess = np.maximum(c, 0)
        return float(excess @ excess) / 2, excess @ program.slopes(z).jacobian

    box = list(zip(program.lower, program.upper, strict=True))
    inside = np.clip(start, program.lower, program.upper)
    options = {"ftol": 1e-15, "gtol": 1e-10}  # half the square of what is feasible, and less
    found = minimize(
        value_and_slope, inside, jac=True, bounds=box, method="L-BFGS-B", options=options
    )
    z = np.clip(found.x, program.lower, program.upper)
    return z, _violation(program, z)


def _violation(program: Program, z: np.ndarray) -> float:
    """Return the largest violation of a constraint, relative to its size; ∞ if it is unknown."""
    f, c = program.values(z)
    if not (np.isfinite(f) and np.isfinite(c).all()):
        return np.inf
    if not (c > 0).any():
        return 0.0
    size = program.slopes(z).rows
    excess = np.maximum(c, 0.0) / np.where(size > 0, size, 1.0)
    return float(excess.max()) if np.isfinite(excess).all() else np.inf


def _judge(program: Program, z: np.ndarray, limited: bool, iterations: int) -> Attempt:
    z = np.clip(z, program.lower, program.upper)
    violation = _violation(program, z)
    residual = stationarity(program, z) if np.isfinite(violation) else np.inf
    return Attempt(z, limited, iterations, violation, residual)


def stationarity(program: Program, z: np.ndarray) -> float:
    """Return how far ∇f is from what active constraints can balance, relative to its terms' size.

    The multipliers are the best nonnegative ones, from a least-squares problem of their own. ∞ if
    anything is unknown.
    """
    c = program.values(z)[1]
    slope, jacobian, size, rows, _ = program.slopes(z)
    if not all(np.isfinite(part).all() for part in (slope, jacobian, size, rows)):
        return np.inf
    eye = np.eye(z.size)
    width = np.minimum(program.upper - program.lower, 1.0)
    pushing = np.concatenate(
        [
            jacobian[c > -ACTIVE * rows],
            eye[program.upper - z <= ACTIVE * width],
            -eye[z - program.lower <= ACTIVE * width],
        ]
    )
    rest = slope
    if pushing.size:
        length = np.maximum(np.linalg.norm(pushing, axis=1), 1e-12)
        directions = (pushing / length[:, None]).T
        try:
            multipliers, _ = nnls(directions, -slope, maxiter=30 * len(pushing))
        except RuntimeError:
            return np.inf
        rest = slope + directions @ multipliers
    # Each input for itself: in an unstable plant the first ones matter far more than the last.
    return float((np.abs(rest) / np.where(size > 0, size, 1.0)).max(initial=0.0))


def _newton(program: Program, z: np.ndarray, steps: int) -> tuple[np.ndarray, bool, int]:
    """Solve quadratic programs with the exact curvature of the Lagrangian, with a line search.

    Few steps, of which each costs more: a minimum is reached in 2 to 10 of them as a rule. Stops
    where a program has no solution or no step improves f + weight·Σ max(c, 0).
    """
    z = z.copy()
    f, c = program.values(z)
    eye = np.eye(z.size)
    up, down = np.isfinite(program.upper), np.isfinite(program.lower)
    every = np.zeros(program.rows + int(up.sum()) + int(down.sum()))
    weight = 0.0
    for count in range(1, steps + 1):
        slope, jacobian, size, *_ = program.slopes(z)
        A = np.concatenate([jacobian, eye[up], -eye[down]])
        b = np.concatenate([-c, (program.upper - z)[up], (z - program.lower)[down]])
        size = np.maximum(size, 1e-300)
        missing = (slope + every @ A) / size, every * b / size.max(), np.minimum(b, 0)
        if all((np.abs(m) <= BALANCED).all() for m in missing):
            return z, False, count - 1
        H = program.curvature(z, every[: program.rows], 1.0)
        if not (np.isfinite(slope).all() and np.isfinite(jacobian).all() and np.isfinite(H).all()):
            return z, False, count
        H, exact = convex((H + H.T) / 2, A[every > 0])
        found = quadratic_program(H, slope, A, b)
        if found is None:
            return z, False, count
        d, every = found
        weight = max(1.5 * np.max(every[: program.rows], initial=0.0), weight / 2)
        before = f + weight * np.maximum(c, 0).sum()
        gain = min(slope @ d - weight * np.maximum(c, 0).sum(), 0.0)
        length = 1.0
        while True:
            trial = np.clip(z + length * d, program.lower, program.upper)
            f, c = program.values(trial)
            after = f + weight * np.maximum(c, 0).sum()
            # Rounding may raise the merit a little where nothing is left to gain.
            slack = 1e-12 * (abs(before) + weight)
            if after <= before + 1e-4 * length * gain + slack:
                break
            length /= 2
            if length < SHORTEST:
                return z, False, count
        z = trial
        # The next step is the square of this one; what counts is its size beside the plan's. A tiny
        # step that the line search shortens is rounding.
        near = np.sqrt(min(1.0, float(np.abs(z).max())))
        small = (1e-6 if exact else 1e-9) if length == 1 else 1e-8
        if np.abs(d).max() <= max(small * near, 1e-300):
            return z, False, count
    return z, True, steps


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
    constraints = []
    if program.rows:
        constraints = [
            {
                "type": "ineq",
                "fun": lambda z: -values(z)[1],
                "jac": lambda z: -program.slopes(z).jacobian,
            }
        ]
    found = minimize(
        lambda z: values(z)[0] / size,
        start,
        jac=lambda z: program.slopes(z).gradient / size,
        bounds=list(zip(program.lower, program.upper, strict=True)),
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": max_iterations, "ftol": 1e-13},
    )
    return np.asarray(found.x), int(found.status) == SLSQP_LIMIT, int(found.nit)


def need_ipopt() -> None:
    """Raise an ImportError that says what to install, unless IPOPT is there."""
    try:
        import ipyopt  # noqa: F401
    except ImportError as error:
        raise ImportError(
            'solver="ipopt" needs the package ipyopt: pip install "prefmpc[ipopt]"'
        ) from error


def _ipopt(
    program: Program, start: np.ndarray, max_iterations: int
) -> tuple[np.ndarray, bool, int]:
    import ipyopt

    n, m = start.size, program.rows
    count = [0]

    def value(z: np.ndarray) -> float:
        return program.values(z)[0]

    def gradient(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = program.slopes(z).gradient

    def limits(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = program.values(z)[1]

    def jacobian(z: np.ndarray, out: np.ndarray) -> None:
        out[:] = program.slopes(z).jacobian.ravel()

    lower_rows, lower_columns = np.tril_indices(n)

    def hessian(z: np.ndarray, multipliers: np.ndarray, factor: float, out: np.ndarray) -> None:
        out[:] = program.curvature(z, multipliers, factor)[lower_rows, lower_columns]

    def each_iteration(*report: Any) -> bool:
        count[0] = int(report[1])
        return True

    rows, columns = np.divmod(np.arange(m * n), n)
    problem = ipyopt.Problem(
        n,
        np.maximum(program.lower, -HUGE),
        np.minimum(program.upper, HUGE),
        m,
        np.full(m, -HUGE),
        np.zeros(m),
        (rows, columns),
        (lower_rows, lower_columns),
        value,
        gradient,
        limits,
        jacobian,
        hessian,
        intermediate_callback=each_iteration,
        ipopt_options={
            **{"print_level": 0, "sb": "yes", "max_iter": max_iterations, "tol": 1e-11},
            **{"mu_strategy": "adaptive", "bound_relax_factor": 0.0},
        },
    )
    z, _, status = problem.solve(start.copy())
    return np.asarray(z), status == IPOPT_LIMIT, count[0]
