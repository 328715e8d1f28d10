"""Many small quadratic programs side by side: c problems, each for k right-hand sides.

min ½‖w‖² over l ≤ E x_0 + Y w ≤ u. Three methods, each for what the one before leaves over: w = 0,
where it is feasible; with input bounds alone a primal-dual active-set method, exact and short;
Goldfarb and Idnani's dual method, which always arrives and tells what is infeasible.

The only unknowns are the multipliers λ of the rows: w = −Yᵀλ is optimal if the rows keep to their
limits and only rows at their limits have multipliers, with the right sign.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc.mpc._condensed import CondensedProblem
from prefmpc.mpc._dual_method import dual_method
from prefmpc.mpc._limits import ON_LIMIT, row_sizes

STEPS = 12
"""Active sets that are tried where there are input bounds alone."""

LANES = 16
"""Problems that the dual method takes at a time, if they are small."""

CHUNK = 2**20
"""Numbers in its arrays, at most."""

ROUNDING = 1e-15
FINEST = 1e-12
"""Relative errors below are not asked for: rounding alone may be as large."""

NOTHING = 1e-9
"""Multipliers below, relative to the largest, do not say that a row was active."""

STATUSES = np.array(["solved", "infeasible", "max_iterations", "failed"])
SOLVED, INFEASIBLE, UNFINISHED, FAILED = range(4)


class Answer(NamedTuple):
    """Inputs U (c, k, n) and what is to be said of each of the (c, k) problems.

    ``residual`` estimates the largest error of U relative to its largest entry, each input in the
    unit in which σ sees it. ``status`` is a place in STATUSES.
    """

    U: Any
    w: Any
    multipliers: Any
    status: Any
    residual: Any
    iterations: Any


class _Data(NamedTuple):
    """What stays the same while the problems are solved, all (c, k, m)."""

    free: Any
    """Rows of the unconstrained minimum."""
    lower: Any
    upper: Any


class _Search(NamedTuple):
    """Where the search stands; the same leading axes (c, k), or (b,) in a chunk."""

    w: Any
    multipliers: Any
    rows: Any
    residual: Any
    done: Any
    iterations: Any


def solve(problem: CondensedProblem, x0: Any, tol: Any, *, start: Any = None) -> Answer:
    """Solve for the states x0 (c, k, nx). Derivatives: see `with_derivative`.

    ``start`` are multipliers (c, k, m) of a problem much like this one.
    """
    problem, x0, start = jax.lax.stop_gradient((problem, x0, start))
    n = problem.Y.shape[-1]
    data, impossible = _data(problem, x0)
    dead = ~jnp.isfinite(data.free).all(-1) | impossible
    start = jnp.zeros_like(data.free) if start is None else start
    none, still, no = jnp.zeros_like(data.free), jnp.zeros((*dead.shape, n)), jnp.zeros_like(dead)
    # XLA would work out what follows from zeros while it compiles, slowly if they are many.
    none, still = jax.lax.optimization_barrier((none, still))
    error = _error(data, none, data.free, jnp.ones(dead.shape))
    found = _judged(data, still, none, data.free, error, n, jnp.zeros(dead.shape, int), tol)
    if problem.fixed is None:
        found = _active_set(problem, data, start, found, dead, tol)
    infeasible = limited = no
    if dead.size:
        found, infeasible, limited = jax.lax.cond(
            jnp.all(found.done | dead),
            lambda found: (found, no, no),
            lambda found: _left_over(problem, data, start, found, dead, tol),
            found,
        )
    if problem.fixed is None:  # input bounds alone always leave a plan, however bad
        infeasible = no
    low, high = problem.bounds[:, :1], problem.bounds[:, 1:]
    pull = found.multipliers[..., :n]
    U = jnp.clip(found.rows[..., :n] * problem.scale[:, None], low, high)
    U = jnp.where(pull > 0, high, jnp.where(pull < 0, low, U))
    status = jnp.where(found.done & jnp.isfinite(U).all(-1), SOLVED, FAILED)
    status = jnp.where(limited, UNFINISHED, status)
    status = jnp.where(impossible | infeasible, INFEASIBLE, status)
    return Answer(U, found.w, found.multipliers, status, found.residual, found.iterations)


def _data(problem: CondensedProblem, x0: Any) -> tuple[_Data, Any]:
    """Return the rows and their limits, and which states (c, k) break one that no input moves."""
    free = x0 @ problem.E.swapaxes(1, 2)
    lower, upper = (
        jnp.broadcast_to(bound[:, None], free.shape) for bound in (problem.lower, problem.upper)
    )
    impossible = jnp.zeros(x0.shape[:2], bool)
    if problem.fixed is not None:
        fixed, n = problem.fixed, problem.Y.shape[-1]
        still = fixed.rows[:, None]
        size = jax.vmap(row_sizes)(fixed.A, fixed.B, fixed.u_size, x0, fixed.Hx, fixed.h)
        beyond = free[..., n:] - upper[..., n:] > ON_LIMIT * size
        impossible = (still & beyond).any(-1)
        upper = jnp.concatenate(
            [upper[..., :n], jnp.where(still, jnp.inf, upper[..., n:])], axis=-1
        )
    return _Data(free, lower, upper), impossible


def _moved(problem: CondensedProblem, multipliers: Any) -> Any:
    """Return Y Yᵀλ, what multipliers take away from the rows."""
    if problem.dual is not None:
        return multipliers @ problem.dual
    return (multipliers @ problem.Y) @ problem.Y.swapaxes(1, 2)


def _judged(
    data: _Data, w: Any, multipliers: Any, rows: Any, error: Any, n: int, count: Any, tol: Any
) -> _Search:
    """Say how large the ``error`` of one of the first n rows is, beside the largest of them.

    A state that is held at its limit can take no input at all: what is left then is beside a
    small part of what the input would be without limits, or can be.
    """
    free = jnp.abs(data.free[..., :n])
    most = jnp.maximum(jnp.abs(data.lower), jnp.abs(data.upper))[..., :n]
    little = jnp.maximum(1e-3 * jnp.minimum(free, most), 1e-6 * free)
    unit = jnp.maximum(jnp.abs(rows[..., :n]), little).max(-1)
    some = (error > 0) & (unit > 0)
    residual = jnp.where(some, error / jnp.where(some, unit, 1.0), error)
    # XLA's max passes over NaN: what is not finite would look exact.
    parts = w, multipliers, rows, error[..., None]
    sound = jnp.all(jnp.stack([jnp.isfinite(part).all(-1) for part in parts]), axis=0)
    residual = jnp.where(sound, residual, jnp.inf)
    done = residual <= jnp.maximum(tol, FINEST)
    return _Search(w, multipliers, rows, residual, done, count)


def _error(data: _Data, multipliers: Any, rows: Any, softness: Any) -> Any:
    """Say how far w = −Yᵀλ is from optimal, without trusting where λ comes from.

    Were the limits of the active rows where these rows are, λ would be optimal: ``miss`` is how
    far the limits are from there. To move the rows onto them takes ‖Δw‖ ≤ √softness·‖miss‖, where
    softness bounds 1/σ² for the least singular value σ of the active rows of Y. By duality the
    optimum then is within twice that. What rounding may have done to rows counts as a miss too.
    """
    miss = jnp.clip(rows + multipliers, data.lower, data.upper) - rows
    size = jnp.abs(rows) + jnp.abs(data.free)
    rounding = jnp.where(multipliers != 0, ROUNDING * size, 0.0)
    miss = jnp.linalg.norm(jnp.abs(miss) + rounding, axis=-1)
    return jnp.sqrt(softness) * miss + ROUNDING * jnp.linalg.norm(multipliers, axis=-1)


def _active(data: _Data, multipliers: Any, rows: Any) -> tuple[Any, Any]:
    """Return which rows are taken to be at their upper limits, and which at their lower ones.

    Rows have unit length: a multiplier is what a row would be without it. A row at one limit that
    pulls the wrong way becomes free; it does not jump to the other.
    """
    half = (data.upper - data.lower) / 2
    alone = rows + jnp.clip(multipliers, -half, half)
    high = alone >= data.upper
    return high, (alone <= data.lower) & ~high


def _excess(data: _Data, rows: Any, high: Any, low: Any) -> Any:
    """Return how far active rows are beyond their limits; 0 elsewhere."""
    limits = jnp.where(high, data.upper, jnp.where(low, data.lower, 0.0))
    return jnp.where(high | low, rows - limits, 0.0)


def _active_set(
    problem: CondensedProblem, data: _Data, start: Any, free: _Search, dead: Any, tol: Any
) -> _Search:
    """Guess the active rows, solve for their multipliers, look which rows are active then.

    Hintermüller, Ito and Kunisch's primal-dual active-set method. Where the guess repeats itself
    it is exact; it may also go round in circles. The first guess is what was active at ``start``,
    if anything was.
    """
    n = problem.Y.shape[-1]
    least = NOTHING * jnp.abs(start).max(-1, keepdims=True)
    pushed, pulled = start > least, start < -least
    warm = jnp.any(pushed | pulled, axis=-1, keepdims=True)

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, now, before, idle, softness = carry
        high, low = _active(data, now.multipliers, now.rows)
        first = warm & (k == 0)
        high, low = jnp.where(first, pushed, high), jnp.where(first, pulled, low)
        idle |= now.done
        active = (high | low) & ~idle[..., None]
        # From where λ is: repeated with the same rows it removes rounding errors.
        kept = jnp.where(active, now.multipliers, 0.0)
        rows = data.free - _moved(problem, kept)
        residual = jnp.where(active, _excess(data, rows, high, low), 0.0)
        sizes = jnp.where(active, jnp.abs(data.free) + jnp.abs(rows), 0.0)
        exact = 10 * ROUNDING * jnp.linalg.norm(sizes, axis=-1)
        correction, trace = _conjugate_gradients(problem, active, residual, exact, limit=2 * n)
        # With the same rows as before there is little left to do, and little to learn from it.
        softness = jnp.where((active == before).all(-1), jnp.maximum(trace, softness), trace)
        rows -= _moved(problem, correction)
        multipliers = kept + correction
        error = _error(data, multipliers, rows, softness)
        new = _judged(data, now.w, multipliers, rows, error, n, now.iterations + 1, tol)
        new = _kept(idle, now, new)
        return k + 1, new, active, idle | new.done, softness

    nowhere = jnp.zeros_like(data.free, dtype=bool)
    begin = (0, free, nowhere, dead | free.done, jnp.ones(dead.shape))
    found: _Search = jax.lax.while_loop(
        lambda carry: (carry[0] < STEPS) & ~jnp.all(carry[3]), step, begin
    )[1]
    return found._replace(w=-(found.multipliers @ problem.Y))


def _kept(keep: Any, old: Any, new: Any) -> Any:
    """Return ``old`` where ``keep``, else ``new``; leading axes are those of ``keep``."""

    def choose(a: Any, b: Any) -> Any:
        return jnp.where(keep.reshape(keep.shape + (1,) * (a.ndim - keep.ndim)), a, b)

    return jax.tree.map(choose, old, new)


def _conjugate_gradients(
    problem: CondensedProblem, active: Any, rest: Any, exact: Any, limit: int
) -> tuple[Any, Any]:
    """Return λ, zero outside of the active rows, with Y Yᵀλ = rest on these; and their softness.

    The method builds a tridiagonal matrix whose eigenvalues approach those of Y Yᵀ on the active
    rows: the trace of its inverse is at least 1 over the least of them.
    """

    def unfinished(carry: tuple[Any, ...]) -> Any:
        return (carry[0] < limit) & jnp.any(carry[4] > exact**2)

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, multipliers, rest, direction, square, inverse, trace = carry
        image = jnp.where(active, _moved(problem, direction), 0.0)
        curvature = jnp.sum(direction * image, axis=-1)
        moving = (curvature > 0) & (square > exact**2)
        length = jnp.where(moving, square / jnp.where(moving, curvature, 1.0), 0.0)
        inverse += jnp.where(moving, 1 / jnp.where(moving, square, 1.0), 0.0)
        trace += length * square * inverse
        multipliers += length[..., None] * direction
        rest -= length[..., None] * image
        next_square = jnp.where(moving, jnp.sum(rest * rest, axis=-1), square)
        ratio = jnp.where(moving, next_square / jnp.where(moving, square, 1.0), 0.0)
        direction = jnp.where(moving[..., None], rest + ratio[..., None] * direction, direction)
        return k + 1, multipliers, rest, direction, next_square, inverse, trace

    square = jnp.sum(rest * rest, axis=-1)
    nothing = jnp.zeros_like(square)
    start = (0, jnp.zeros_like(rest), rest, rest, square, nothing, nothing)
    _, multipliers, *_, trace = jax.lax.while_loop(unfinished, step, start)
    return multipliers, jnp.maximum(trace, 1.0)


def _left_over(
    problem: CondensedProblem, data: _Data, start: Any, found: _Search, dead: Any, tol: Any
) -> tuple[_Search, Any, Any]:
    """Solve what is left over by the dual method, gathered in front, chunk by chunk."""
    c, k = dead.shape
    m, n = problem.Y.shape[1:]
    lanes = c * k
    chunk = max(1, min(CHUNK // (n * n + (m * n if c > 1 else m)), lanes, LANES))
    one_row = jax.tree.map(lambda a: a.reshape(lanes, *a.shape[2:]), (data, found))
    finished = (found.done | dead).ravel()
    # Together with their like: all problems of a chunk go on until the hardest is done.
    order = jnp.argsort(jnp.where(finished, m + 1, jnp.sum(start != 0, axis=-1).ravel()))
    order = jnp.concatenate([order, order[:1].repeat(chunk)])
    left = jnp.sum(~finished)

    def work(carry: tuple[Any, _Search, Any, Any]) -> tuple[Any, _Search, Any, Any]:
        i, out, infeasible, limited = carry
        lane = jax.lax.dynamic_slice(order, (i,), (chunk,))
        skip = i + jnp.arange(chunk) >= left
        mine, before = jax.tree.map(lambda a: a[lane], one_row)
        limits = mine.lower, mine.upper
        dual = dual_method(problem.Y, lane // k, problem.order[0], mine.free, *limits, skip)
        count = before.iterations + dual.count
        new = _judged(mine, dual.w, dual.multipliers, dual.rows, dual.error, n, count, tol)
        # Two methods have tried: what was found last is kept if it is the better one.
        new = _kept(~(new.residual < before.residual), before, new)
        place = jnp.where(skip, lanes, lane)  # out of bounds: dropped

        def put(old: Any, new: Any) -> Any:
            return old.at[place].set(new, mode="drop")

        out = jax.tree.map(put, out, new)
        said = dual.infeasible & ~new.done, dual.limited & ~new.done
        return i + chunk, out, put(infeasible, said[0]), put(limited, said[1])

    no = jnp.zeros(lanes, dtype=bool)
    begin = 0, one_row[1], no, no
    _, out, infeasible, limited = jax.lax.while_loop(lambda carry: carry[0] < left, work, begin)
    shaped = jax.tree.map(lambda a: a.reshape(c, k, *a.shape[1:]), out)
    return shaped, infeasible.reshape(c, k), limited.reshape(c, k)


def with_derivative(problem: CondensedProblem, x0: Any, answer: Answer) -> Any:
    """Return U (c, k, n) again, as a function of problem and x0 that can be differentiated.

    The active rows stay active nearby: U moves with the solution of Y w + E x_0 = limit on these,
    w = −Yᵀλ.
    """
    fixed = jax.lax.stop_gradient(problem)
    n = problem.Y.shape[-1]
    active = answer.multipliers != 0
    high, low = answer.multipliers > 0, answer.multipliers < 0
    data, _ = _data(problem, x0)

    def on_active(multipliers: Any) -> Any:
        return jnp.where(active, _moved(problem, multipliers), multipliers)

    def solved(_: Any, right: Any) -> Any:
        inside = jnp.where(active, right, 0.0)
        exact = 1e-13 * jnp.linalg.norm(inside, axis=-1)
        found, _ = _conjugate_gradients(fixed, active, inside, exact, 2 * n)
        return jnp.where(active, found, right)

    excess = _excess(data, data.free, high, low)
    multipliers = jax.lax.custom_linear_solve(on_active, excess, solved, symmetric=True)
    moving = (data.free - _moved(problem, multipliers))[..., :n] * problem.scale[:, None]
    return answer.U + moving - jax.lax.stop_gradient(moving)
