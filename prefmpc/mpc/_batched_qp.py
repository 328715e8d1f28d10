"""Many small quadratic programs side by side: c problems, each for k right-hand sides.

min ½ VᵀHV + gᵀV over l ≤ G V ≤ u. Three methods, each for what the one before leaves over: the
unconstrained minimum, where it is feasible; a primal-dual active-set method, exact and short; an
interior-point method, which always arrives and tells what is infeasible.

The first two consist of products of matrices alone: conjugate gradients find the multipliers of
the active rows, in as many steps as there are of these.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc.mpc._condensed import CondensedProblem
from prefmpc.mpc._interior import interior_point

BOX_STEPS = 120
STEPS = 15
PATIENCE = 5
"""With polyhedra, a step after so many that finishes no problem is the last."""

TRIES = 3
"""Changes of the whole active set that may be in vain before single ones are made."""

POLISHING_STEPS = 6
CHUNK = 8
"""Problems that the interior-point method takes at a time."""

ROUNDING = 1e-14
NOTHING = 1e-7
"""Multipliers below, in the unit of the rows, do not say that a row was active."""

STATUSES = np.array(["solved", "infeasible", "max_iterations"])
SOLVED, INFEASIBLE, UNFINISHED = range(3)


class Answer(NamedTuple):
    """Inputs U (c, k, n) and what is to be said of each of the (c, k) problems.

    ``residual`` is a proven bound on ‖U − U*‖₂ where there are only input bounds; else the
    largest violation of the optimality conditions, in the unit of the inputs. ``status`` is a
    place in STATUSES.
    """

    U: Any
    multipliers: Any
    status: Any
    residual: Any
    iterations: Any


class _Data(NamedTuple):
    """What stays the same while the problems are solved."""

    g: Any
    lower: Any
    upper: Any
    V: Any
    """The unconstrained minimum −H⁻¹g (c, k, n)."""
    free: Any
    """G V (c, k, m)"""


class _Search(NamedTuple):
    """Where the search for V and λ stands; the same leading axes (c, k), or (b,) in a chunk."""

    V: Any
    multipliers: Any
    rows: Any
    residual: Any
    done: Any
    iterations: Any


def solve(
    problem: CondensedProblem, x0: Any, tol: Any, *, start: Any = None, thorough: bool = True
) -> Answer:
    """Solve for the states x0 (c, k, nx). Derivatives: see `with_derivative`.

    ``start`` are multipliers (c, k, m) of a problem much like this one.
    Without ``thorough`` what the active-set method leaves over stays unfinished; the program then
    compiles in a third of the time.
    """
    problem, x0, start = jax.lax.stop_gradient((problem, x0, start))
    data = _data(problem, x0)
    dead = ~jnp.isfinite(data.g).all(-1)
    start = jnp.zeros_like(data.free) if start is None else start
    found = _active_set(problem, data, start, dead, tol)
    infeasible = jnp.zeros_like(dead)
    if thorough:
        found, infeasible = jax.lax.cond(
            jnp.all(found.done | dead),
            lambda found: (found, infeasible),
            lambda found: _left_over(problem, data, found, dead, tol),
            found,
        )
    n = problem.H.shape[-1]
    U = jnp.clip(found.V, data.lower[..., :n], data.upper[..., :n]) * problem.scale[:, None]
    status = jnp.where(found.done, SOLVED, jnp.where(infeasible, INFEASIBLE, UNFINISHED))
    return Answer(U, found.multipliers, status, found.residual, found.iterations)


def _data(problem: CondensedProblem, x0: Any) -> _Data:
    g = x0 @ problem.F.swapaxes(1, 2)
    shift = 0.0 if problem.E is None else x0 @ problem.E.swapaxes(1, 2)
    lower, upper = problem.lower[:, None] - shift, problem.upper[:, None] - shift
    V = -g @ problem.inverse
    free = _rows_of(problem, V)
    lower, upper = (jnp.broadcast_to(bound, free.shape) for bound in (lower, upper))
    return _Data(g, lower, upper, V, free)


def _rows_of(problem: CondensedProblem, V: Any) -> Any:
    return V if problem.G is None else V @ problem.G.swapaxes(1, 2)


def _columns_of(problem: CondensedProblem, multipliers: Any) -> Any:
    return multipliers if problem.G is None else multipliers @ problem.G


def _plan(problem: CondensedProblem, data: _Data, multipliers: Any) -> Any:
    """Return V = −H⁻¹(g + Gᵀλ)."""
    return -(data.g + _columns_of(problem, multipliers)) @ problem.inverse


def _correction(problem: CondensedProblem, data: _Data, V: Any, multipliers: Any) -> Any:
    """Return how far V is from H⁻¹(g + Gᵀλ), with the sign that moves it there if subtracted."""
    slope = V @ problem.H + data.g + _columns_of(problem, multipliers)
    return slope @ problem.inverse


def _judged(
    problem: CondensedProblem, data: _Data, V: Any, multipliers: Any, count: Any, tol: Any
) -> _Search:
    """Say how far V and λ are from optimal, without trusting where they come from."""
    rows = _rows_of(problem, V)
    if problem.G is None:
        V, residual, done = _certified(problem, data, rows, tol)
    else:
        # Zero where, and only where, the conditions for the optimum hold.
        reach = _diagonal(problem) * multipliers
        miss = jnp.clip(rows + reach, data.lower, data.upper) - rows
        apart = _correction(problem, data, V, multipliers)
        unit = jnp.max(problem.scale, axis=-1)[:, None]
        residual = jnp.maximum(jnp.abs(miss).max(-1), jnp.abs(apart).max(-1)) * unit
        # XLA's max passes over NaN: what is not finite would look exact.
        sound = jnp.isfinite(V).all(-1) & jnp.isfinite(multipliers).all(-1)
        residual = jnp.where(sound, residual, jnp.inf)
        # Not the size of the multipliers: these grow without end where there is no solution.
        size = jnp.abs(data.free).max(-1) + jnp.abs(data.V).max(-1)
        done = (residual <= tol) | (residual <= 10 * ROUNDING * size * unit)
    return _Search(V, multipliers, rows, residual, done, count)


def _certified(problem: CondensedProblem, data: _Data, rows: Any, tol: Any) -> tuple[Any, Any, Any]:
    """Take one projected gradient step: it proves how far the optimum is, if G = I.

    With V⁺ = clip(V − ∇/L), the residual of the optimality conditions at V⁺ has norm at most
    (L − μ)·‖V⁺ − V‖, and strong monotonicity turns that into ‖V⁺ − V*‖ ≤ (L − μ)/μ·‖V⁺ − V‖.
    Weights that hardly see an input make μ so small that rounding alone exceeds ``tol``: a step
    of rounding size is then as good as float64 can tell, and counts as done too.
    """
    V = jnp.clip(rows, data.lower, data.upper)
    short = problem.step[:, None]
    gradient = V @ problem.H + data.g
    V_next = jnp.clip(V - short[..., None] * gradient, data.lower, data.upper)
    step = jnp.linalg.norm(V_next - V, axis=-1)
    distance = problem.amplification[:, None] * step
    size = jnp.linalg.norm(V, axis=-1) + short * jnp.linalg.norm(data.g, axis=-1)
    return V_next, distance, (distance <= tol) | (step <= ROUNDING * size)


def _diagonal(problem: CondensedProblem) -> Any:
    return jnp.diagonal(problem.dual, axis1=1, axis2=2)[:, None]


def _active(data: _Data, reach: Any, rows: Any) -> tuple[Any, Any]:
    """Return which rows are taken to be at their upper limits, and which at their lower ones.

    ``reach`` are the multipliers, in the unit of the rows: what a row would be without its own
    one. A row at one limit that pulls the wrong way becomes free; it does not jump to the other.
    """
    half = (data.upper - data.lower) / 2
    alone = rows + jnp.clip(reach, -half, half)
    high = alone >= data.upper
    return high, (alone <= data.lower) & ~high


def _excess(data: _Data, rows: Any, high: Any, low: Any) -> Any:
    """Return how far active rows are beyond their limits; 0 elsewhere."""
    limits = jnp.where(high, data.upper, jnp.where(low, data.lower, 0.0))
    return jnp.where(high | low, rows - limits, 0.0)


class _Guess(NamedTuple):
    """Rows at their upper and lower limits (c, k, m); see `_next_guess`."""

    high: Any
    low: Any
    fewest: Any
    tries: Any


def _next_guess(guess: _Guess, high: Any, low: Any) -> _Guess:
    """Take over which rows look active, or only the last change if that has not helped lately.

    Changing all at once needs few steps but may go round in circles; changing the one with the
    largest index ends for sure if the rows are independent. Júdice and Pires' block pivoting.
    """
    changed = (high != guess.high) | (low != guess.low)
    number = jnp.sum(changed, axis=-1)
    better = number < guess.fewest
    tries = jnp.where(better, TRIES, guess.tries - 1)
    last = jnp.cumsum(changed[..., ::-1], axis=-1)[..., ::-1] == 1
    taken = changed & ((tries >= 0)[..., None] | last)
    return _Guess(
        jnp.where(taken, high, guess.high),
        jnp.where(taken, low, guess.low),
        jnp.minimum(number, guess.fewest),
        tries,
    )


def _active_set(problem: CondensedProblem, data: _Data, start: Any, dead: Any, tol: Any) -> _Search:
    """Guess the active rows, solve for their multipliers, look which rows are active then.

    Hintermüller, Ito and Kunisch's primal-dual active-set method. Where the guess repeats itself
    it is exact. The first guess is what was active at ``start``, if anything was.
    """
    pull = _diagonal(problem) * start
    pushed, pulled = pull > NOTHING, pull < -NOTHING
    warm = jnp.any(pushed | pulled, axis=-1, keepdims=True)
    n = problem.H.shape[-1]
    steps, patience = (BOX_STEPS, BOX_STEPS) if problem.G is None else (STEPS, PATIENCE)

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, now, guess, idle, _ = carry
        high, low = _active(data, _diagonal(problem) * now.multipliers, now.rows)
        first = warm & (k == 0)
        high, low = jnp.where(first, pushed, high), jnp.where(first, pulled, low)
        guess = _next_guess(guess, high, low)
        # More active rows than inputs depend on each other: too hard a case for this method.
        both = guess.high | guess.low
        idle |= now.done | (jnp.sum(both, axis=-1) > n)
        active = both & ~idle[..., None]
        kept = jnp.where(active, now.multipliers, 0.0)
        # Newton's step from where V is: repeated with the same rows it removes rounding errors.
        V = now.V - _correction(problem, data, now.V, kept)
        excess = _excess(data, _rows_of(problem, V), guess.high, guess.low)
        rest = jnp.where(active, excess, 0.0)
        limits = jnp.where(active, jnp.abs(now.rows) + 1, 0.0)
        exact = 1e-13 * jnp.linalg.norm(limits, axis=-1)
        more = _conjugate_gradients(problem.dual, active, rest, exact, limit=2 * n)
        V -= _columns_of(problem, more) @ problem.inverse
        new = _kept(idle, now, _judged(problem, data, V, kept + more, now.iterations + 1, tol))
        return k + 1, new, guess, idle | new.done, jnp.all(new.done == now.done)

    def unfinished(carry: tuple[Any, ...]) -> Any:
        k, _, _, idle, stuck = carry
        return (k < steps) & ~jnp.all(idle) & ~((k >= patience) & stuck)

    none, count = jnp.zeros_like(data.free), jnp.zeros(dead.shape, dtype=int)
    free = _judged(problem, data, data.V, none, count, tol)
    nowhere = jnp.zeros_like(data.free, dtype=bool)
    guess = _Guess(nowhere, nowhere, jnp.full(dead.shape, none.shape[-1] + 1), count + TRIES)
    return jax.lax.while_loop(unfinished, step, (0, free, guess, dead | free.done, False))[1]


def _kept(keep: Any, old: Any, new: Any) -> Any:
    """Return ``old`` where ``keep``, else ``new``; leading axes are those of ``keep``."""

    def choose(a: Any, b: Any) -> Any:
        return jnp.where(keep.reshape(keep.shape + (1,) * (a.ndim - keep.ndim)), a, b)

    return jax.tree.map(choose, old, new)


def _conjugate_gradients(dual: Any, active: Any, rest: Any, exact: Any, limit: int) -> Any:
    """Return λ, zero outside of the active rows, with dual·λ = rest on these."""

    def unfinished(carry: tuple[Any, ...]) -> Any:
        return (carry[0] < limit) & jnp.any(carry[4] > exact**2)

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, multipliers, rest, way, square = carry
        turned = jnp.where(active, way @ dual, 0.0)
        bend = jnp.sum(way * turned, axis=-1)
        far = jnp.where(bend > 0, square / jnp.where(bend > 0, bend, 1.0), 0.0)[..., None]
        multipliers, rest = multipliers + far * way, rest - far * turned
        next_square = jnp.sum(rest * rest, axis=-1)
        ratio = jnp.where(square > 0, next_square / jnp.where(square > 0, square, 1.0), 0.0)
        return k + 1, multipliers, rest, rest + ratio[..., None] * way, next_square

    square = jnp.sum(rest * rest, axis=-1)
    start = (0, jnp.zeros_like(rest), rest, rest, square)
    return jax.lax.while_loop(unfinished, step, start)[1]


def _left_over(
    problem: CondensedProblem, data: _Data, found: _Search, dead: Any, tol: Any
) -> tuple[_Search, Any]:
    """Solve what is left over by the interior-point method, gathered in front, chunk by chunk."""
    c, k = dead.shape
    lanes = c * k
    chunk = min(CHUNK, lanes)
    one_row = jax.tree.map(lambda a: a.reshape(lanes, *a.shape[2:]), (data, found))
    finished = (found.done | dead).ravel()
    order = jnp.argsort(finished)
    order = jnp.concatenate([order, order[:1].repeat(chunk)])
    left = jnp.sum(~finished)

    def work(carry: tuple[Any, _Search, Any]) -> tuple[Any, _Search, Any]:
        i, out, infeasible = carry
        lane = jax.lax.dynamic_slice(order, (i,), (chunk,))
        skip = i + jnp.arange(chunk) >= left
        mine, before = jax.tree.map(lambda a: a[lane], one_row)
        own = jax.tree.map(lambda a: a[lane // k], problem)
        new, proven = _by_interior_point(own, mine, before.iterations, skip, tol)
        place = jnp.where(skip, lanes, lane)  # out of bounds: dropped

        def put(old: Any, new: Any) -> Any:
            return old.at[place].set(new, mode="drop")

        return i + chunk, jax.tree.map(put, out, new), put(infeasible, proven)

    start = 0, one_row[1], jnp.zeros(lanes, dtype=bool)
    _, out, infeasible = jax.lax.while_loop(lambda carry: carry[0] < left, work, start)
    return jax.tree.map(lambda a: a.reshape(c, k, *a.shape[1:]), out), infeasible.reshape(c, k)


def _by_interior_point(
    problem: CondensedProblem, data: _Data, count: Any, skip: Any, tol: Any
) -> tuple[_Search, Any]:
    """Solve b problems, each with matrices of its own; polish by exact active-set steps."""
    n = problem.H.shape[-1]
    G = jnp.broadcast_to(jnp.eye(n), problem.H.shape) if problem.G is None else problem.G
    found = interior_point(problem.H, data.g, G, data.lower, data.upper, skip)
    count = count + found.count

    def judged(V: Any, multipliers: Any) -> _Search:
        single = jax.tree.map(lambda a: a[:, None], (data, V, multipliers, count))
        given, V, multipliers, steps = single
        answer = _judged(problem, given, V, multipliers, steps, tol)
        return jax.tree.map(lambda a: a[:, 0], answer)

    start = judged(found.x, found.multipliers)
    settled = skip | found.infeasible

    def polish(carry: tuple[Any, _Search, _Search]) -> tuple[Any, _Search, _Search]:
        k, now, best = carry
        reach = jnp.diagonal(problem.dual, axis1=1, axis2=2) * now.multipliers
        now = judged(*_on_limits(problem.H, G, data, *_active(data, reach, now.rows)))
        return k + 1, now, _kept(~(now.residual < best.residual), best, now)

    _, _, best = jax.lax.while_loop(
        lambda carry: (
            (carry[0] < POLISHING_STEPS) & ((carry[0] == 0) | ~jnp.all(settled | carry[2].done))
        ),
        polish,
        (0, start, start),
    )
    return best, found.infeasible & ~best.done


def _on_limits(H: Any, G: Any, data: _Data, high: Any, low: Any) -> tuple[Any, Any]:
    """Return the optimal V and λ with the active rows held at their limits."""
    active = high | low
    n = data.g.shape[1]
    held = jnp.where(active[..., None], G, 0.0)
    corner = jnp.where(active, 0.0, 1.0)[..., None] * jnp.eye(active.shape[1])
    top = jnp.concatenate([H, held.swapaxes(1, 2)], axis=2)
    matrix = jnp.concatenate([top, jnp.concatenate([held, corner], axis=2)], axis=1)
    limits = jnp.where(high, data.upper, jnp.where(low, data.lower, 0.0))
    right = jnp.concatenate([-data.g, limits], axis=1)
    solution = jnp.linalg.solve(matrix, right[..., None])[..., 0]
    return solution[:, :n], solution[:, n:]


def with_derivative(problem: CondensedProblem, x0: Any, answer: Answer) -> Any:
    """Return U (c, k, n) again, as a function of problem and x0 that can be differentiated.

    The active rows stay active nearby: U moves with the solution of the equations
    H V + g + Gᵀλ = 0 and G V = limit on these.
    """
    fixed, start = jax.lax.stop_gradient((problem, x0))
    known = _data(fixed, start)
    rows = known.free - answer.multipliers @ fixed.dual
    high, low = _active(known, _diagonal(fixed) * answer.multipliers, rows)
    active = high | low
    data = _data(problem, x0)

    def on_active(multipliers: Any) -> Any:
        return jnp.where(active, multipliers @ problem.dual, multipliers)

    def solved(_: Any, right: Any) -> Any:
        inside = jnp.where(active, right, 0.0)
        exact = 1e-13 * jnp.linalg.norm(inside, axis=-1)
        found = _conjugate_gradients(fixed.dual, active, inside, exact, 2 * inside.shape[-1])
        return jnp.where(active, found, right)

    excess = _excess(data, data.free, high, low)
    multipliers = jax.lax.custom_linear_solve(on_active, excess, solved, symmetric=True)
    moving = _plan(problem, data, multipliers) * problem.scale[:, None]
    return answer.U + moving - jax.lax.stop_gradient(moving)
