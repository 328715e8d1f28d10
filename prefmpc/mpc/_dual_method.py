"""Goldfarb and Idnani's dual active-set method for many least-distance problems side by side.

min ½‖w‖² over l ≤ e + Y w ≤ u, rows of Y of unit length. Starts at w = 0 without any row, takes up
a violated row at a time, and lets go of those whose multipliers would change sign. Each step
raises the minimum, so that none comes back; a row that cannot be met by moving w, nor by letting
go of others, is the proof that there is no solution.

Kept of the active rows C, in slots: C itself and its pseudo-inverse, N = (C Cᵀ)⁻¹C, which changes
by a product of two vectors in each step. All steps of all problems are the same few products.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

ROOM = 1e-13
"""Rows beyond their limits by less, relative to their size, are not violated."""

DEPENDENT = 1e-10
"""The part of a row that the active ones do not span has at least this length to count."""

ROUNDING = 1e-15

FAR = 1e8
"""There is no solution if each would have to lie so many times as far out as w and the limits."""

HOPELESS = 1e11
"""Where w has to be so many times as large as anything given, float64 has no digits left."""

LIMIT = (20, 200)
"""Steps at most, for each variable and for all."""

ROUNDS = 3
"""How often multipliers are computed afresh, and the method goes on from there."""


class Dual(NamedTuple):
    """w (b, n), multipliers and rows (b, m); the largest error of one of the first n; verdicts."""

    w: Any
    multipliers: Any
    rows: Any
    error: Any
    infeasible: Any
    limited: Any
    count: Any


class _Given(NamedTuple):
    """The problems: Y (b, m, n), or (1, m, n) for all, the rest (b, m) but order (m,)."""

    Y: Any
    order: Any
    free: Any
    lower: Any
    upper: Any
    equal: Any
    largest: Any
    """The largest of what is given (b,)."""


class _State(NamedTuple):
    w: Any
    C: Any
    """Active rows, with the sign that makes them upper limits (b, n, n); 0 in free slots."""
    N: Any
    target: Any
    """What C w is at the limits (b, n)."""
    force: Any
    """Multipliers of the slots (b, n), none negative but those of equalities."""
    row: Any
    """Which row a slot holds (b, n); −1 if it is free."""
    sign: Any
    held: Any
    """Rows that are active (b, m): what rounding leaves of them is no violation."""
    spared: Any
    """Rows (b, m) that seem violated, depend on the active ones, and may be so by rounding."""
    new: Any
    """The row that is being taken up (b,); −1 between two."""
    side: Any
    push: Any
    """Its multiplier so far (b,)."""
    done: Any
    infeasible: Any
    stuck: Any
    count: Any


def _of(M: Any, v: Any) -> Any:
    return jnp.einsum("bij,bj->bi", M, v)


def _back(M: Any, v: Any) -> Any:
    return jnp.einsum("bij,bi->bj", M, v)


def _at(array: Any, index: Any) -> Any:
    return jnp.take_along_axis(array, index[:, None], axis=1)[:, 0]


def _rows_of(g: _Given, w: Any) -> Any:
    if len(g.Y) == 1:
        return g.free + w @ g.Y[0].T
    return g.free + _of(g.Y, w)


def dual_method(
    Y: Any, mine: Any, order: Any, free: Any, lower: Any, upper: Any, skip: Any
) -> Dual:
    """Solve b problems: Y (c, m, n), ``mine`` (b,) which of them, the rest (b, m).

    Of violated rows one with the largest ``order`` (m,) is taken up, of these the worst. Where
    ``skip`` (b,) nothing is done. Infinite limits are none.
    """
    b, (m, n) = len(mine), Y.shape[1:]
    limit = LIMIT[0] * n + LIMIT[1]
    sizes = [jnp.abs(free), *(jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0) for a in (lower, upper))]
    largest = jnp.max(jnp.stack(sizes), axis=(0, 2))
    Y = Y if len(Y) == 1 else Y[mine]
    g = _Given(Y, order, free, lower, upper, lower == upper, largest)

    def round_of(carry: tuple[Any, _State]) -> tuple[Any, _State]:
        def unfinished(s: _State) -> Any:
            return ~jnp.all(s.done) & (jnp.max(s.count) < limit)

        s = _afresh(jax.lax.while_loop(unfinished, lambda s: _step(g, s), carry[1]))
        # Go on where what was computed afresh breaks a limit.
        rows = _rows_of(g, s.w)
        size = jnp.abs(free) + jnp.linalg.norm(s.w, axis=-1)[:, None]
        broken = (jnp.maximum(rows - upper, lower - rows) > 10 * ROOM * size).any(-1)
        again = broken & ~skip & ~s.infeasible & ~s.stuck & (s.count < limit)
        force = jnp.where(again[:, None], jnp.maximum(s.force, 0.0), s.force)
        return carry[0] + 1, s._replace(done=~again, force=force, new=jnp.where(again, -1, s.new))

    zero, none = jnp.zeros((b, n)), jnp.zeros((b, n, n))
    nothing, no, none_yet = jnp.full(b, -1), jnp.zeros(b, bool), jnp.zeros((b, m), bool)
    start = _State(
        zero, none, none, zero, zero, jnp.full((b, n), -1), zero, none_yet, none_yet,
        nothing, jnp.ones(b), jnp.zeros(b), skip, no, no, jnp.zeros(b, int),
    )  # fmt: skip
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] < ROUNDS) & ~jnp.all(carry[1].done), round_of, (0, start)
    )
    place = jnp.where(end.row >= 0, end.row, m)
    multipliers = jnp.zeros((b, m + 1)).at[jnp.arange(b)[:, None], place].add(end.sign * end.force)
    limited = ~end.done | (end.count >= limit)
    rows = _rows_of(g, end.w)
    error = _error(g, end, rows)
    return Dual(end.w, multipliers[:, :m], rows, error, end.infeasible, limited, end.count)


class _Row(NamedTuple):
    """The row to take up (b,): which, with which sign, its multiplier, how far it is beyond."""

    place: Any
    side: Any
    push: Any
    violation: Any
    none: Any


def _chosen(g: _Given, s: _State, radius: Any) -> _Row:
    """Return the row that was begun with or, if there is none, the worst of the first in order."""
    rows = _rows_of(g, s.w)
    over, under = rows - g.upper, g.lower - rows
    beyond = jnp.maximum(over, under)
    violated = ~(s.held | s.spared) & (beyond > ROOM * (jnp.abs(g.free) + radius[:, None]))
    share = beyond / (beyond + g.largest[:, None])
    worst = jnp.argmax(jnp.where(violated, g.order + share, 0.0), axis=-1)
    fresh = s.new < 0
    p = jnp.where(fresh, worst, s.new)
    side = jnp.where(fresh, jnp.where(_at(over, p) >= _at(under, p), 1.0, -1.0), s.side)
    violation = jnp.where(side > 0, _at(over, p), _at(under, p))
    return _Row(p, side, jnp.where(fresh, 0.0, s.push), violation, fresh & ~_at(violated, p))


def _step(g: _Given, s: _State) -> _State:
    """Move until the chosen row is met, and take it up, or a multiplier is zero, and let it go."""
    radius = jnp.linalg.norm(s.w, axis=-1)
    row = _chosen(g, s, radius)
    lanes = jnp.arange(len(row.place)) if len(g.Y) > 1 else 0
    line = g.Y[lanes, row.place]
    normal = row.side[:, None] * line

    # Moving by −z lowers the row and keeps the active ones where they are.
    r = _of(s.N, normal)
    z = normal - _back(s.C, r)
    more = _of(s.N, z)
    r, z = r + more, z - _back(s.C, more)
    length = jnp.linalg.norm(z, axis=-1)
    # What is left of a sum of large terms is rounding.
    terms = 10 * ROUNDING * (1 + jnp.abs(r).sum(-1))
    moves = length > jnp.maximum(DEPENDENT, terms)
    full = jnp.where(moves, row.violation / jnp.where(moves, length, 1.0) ** 2, jnp.inf)
    bound = (s.row >= 0) & ~jnp.take_along_axis(g.equal, s.row, axis=1) & (r > 1e-14)
    room = jnp.where(bound, s.force / jnp.where(bound, r, 1.0), jnp.inf)
    first = jnp.argmin(room, axis=-1)
    t = jnp.minimum(full, _at(room, first))

    blocked = ~row.none & ~jnp.isfinite(t)
    spare = blocked & (row.violation <= terms * (radius + g.largest))
    reach = row.violation / jnp.maximum(length, 1e-300)
    proof = blocked & ~spare & (reach > FAR * (radius + g.largest))
    hopeless = ~row.none & (radius > HOPELESS * g.largest)
    nowhere = (blocked & ~spare) | hopeless | ~jnp.isfinite(row.violation)
    done = s.done | row.none | nowhere
    go = ~(done | spare)
    t = jnp.where(go, t, 0.0)
    add = go & (full <= _at(room, first))
    force = jnp.maximum(s.force - t[:, None] * r, jnp.where(bound, 0.0, -jnp.inf))
    here = jnp.arange(g.free.shape[1])[None, :] == row.place[:, None]
    moved = s._replace(
        w=s.w - (t * moves)[:, None] * z,
        force=force,
        side=row.side,
        push=row.push + t,
        spared=(s.spared | (spare[:, None] & here)) & ~go[:, None],
        done=done,
        infeasible=s.infeasible | (proof & ~s.done),
        stuck=s.stuck | (nowhere & ~proof & ~s.done),
        count=s.count + ~done,
    )
    return _exchanged(g, moved, row, (normal, r, z), add, go & ~add, first)


def _exchanged(
    g: _Given, s: _State, row: _Row, way: tuple[Any, Any, Any], add: Any, drop: Any, first: Any
) -> _State:
    """Give a free slot to the row where ``add``, and free the slot ``first`` where ``drop``."""
    normal, r, z = way
    n, m = s.row.shape[1], g.free.shape[1]
    empty = jnp.argmin(s.row >= 0, axis=-1)
    place = jnp.arange(n) == jnp.where(add, empty, first)[:, None]
    again = jnp.where(drop, row.place, -1)
    lines, leaving = jnp.arange(m)[None, :], _at(s.row, first)[:, None]
    add, drop = add[:, None], drop[:, None]
    held = (s.held & ~(drop & (lines == leaving))) | (add & (lines == row.place[:, None]))

    # The pseudo-inverse of one row more, or of one less.
    gone = jnp.take_along_axis(s.N, first[:, None, None], axis=1)[:, 0]
    by = jnp.where(add, z, gone)
    square = jnp.sum(by * by, axis=-1, keepdims=True)
    square = jnp.where(square > 0, square, 1.0)
    change = jnp.where(add, jnp.where(place, 1.0, -r), -_of(s.N, gone)) / square
    N = s.N + jnp.where(add | drop, change, 0.0)[:, :, None] * by[:, None, :]
    freed, taken = (place & drop)[:, :, None], (place & add)[:, :, None]
    C = jnp.where(freed, 0.0, jnp.where(taken, normal[:, None, :], s.C))
    up = row.side > 0
    free = _at(g.free, row.place)
    limit = jnp.where(up, _at(g.upper, row.place) - free, free - _at(g.lower, row.place))

    def put(old: Any, new: Any, nothing: float) -> Any:
        old = jnp.where(place & add, new[:, None], old)
        return jnp.where(place & drop, nothing, old)

    return s._replace(
        C=C,
        N=jnp.where(freed, 0.0, N),
        target=put(s.target, limit, 0.0),
        force=put(s.force, s.push, 0.0),
        row=put(s.row, row.place, -1),
        sign=put(s.sign, row.side, 0.0),
        held=held,
        new=again,
    )


def _afresh(s: _State) -> _State:
    """Compute w and the multipliers from the active rows alone."""
    w = _back(s.N, s.target)
    for _ in range(2):
        w = w + _back(s.N, s.target - _of(s.C, w))
    force = -_of(s.N, w)
    for _ in range(2):
        force = force - _of(s.N, w + _back(s.C, force))
    return s._replace(w=w, force=force)


def _error(g: _Given, end: _State, rows: Any) -> Any:
    """Estimate the largest error of one of the first n rows, from what w and λ are, not how.

    How far active rows are from their limits, rounding included, moves the other rows by Y N, and
    active ones not at all. A multiplier too small to be sure of its sign is another error, as is
    the part of w that the active rows do not span, and a row beyond its limits.
    """
    n = g.Y.shape[2]
    inputs = g.Y[:, :n]
    radius = jnp.linalg.norm(end.w, axis=-1)[:, None]
    held = end.row >= 0
    miss = jnp.abs(_of(end.C, end.w) - end.target)
    miss = jnp.where(held, miss + ROUNDING * (jnp.abs(end.target) + radius), 0.0)
    spread = jnp.abs(inputs @ end.N.swapaxes(1, 2))
    astray = end.w - _back(end.C, _of(end.N, end.w))
    astray = astray - _back(end.C, _of(end.N, astray))
    aside = jnp.abs(inputs @ astray[..., None])[..., 0]
    active = (jnp.arange(n)[None, :, None] == end.row[:, None, :]).any(-1)
    moved = (_of(spread, miss) + jnp.where(active, 0.0, aside)).max(-1)
    weights = jnp.linalg.norm(end.N, axis=-1)
    unsure = ROUNDING * weights * radius
    free = jnp.take_along_axis(g.equal, end.row, axis=1)
    wrong = jnp.where(held & ~free & (end.force < unsure), unsure - jnp.minimum(end.force, 0), 0.0)
    beyond = jnp.maximum(jnp.maximum(rows - g.upper, g.lower - rows), 0.0).max(-1)
    softness = jnp.sqrt(jnp.sum(weights**2, axis=-1))
    large = jnp.where(beyond > 100 * ROOM * (jnp.abs(rows).max(-1) + radius[:, 0]), softness, 1.0)
    return moved + wrong.max(-1) + large * beyond
