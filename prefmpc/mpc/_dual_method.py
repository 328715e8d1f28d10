"""Goldfarb and Idnani's dual active-set method for many least-distance problems side by side.

min ½‖w‖² over l ≤ e + Y w ≤ u, rows of Y of unit length. Starts at w = 0 without any row, takes up
a violated row at a time, and lets go of those whose multipliers would change sign. Each step
raises the minimum, so that none comes back; a row that cannot be met by moving w, nor by letting
go of others, is the proof that there is no solution.

Kept of the active rows C, in slots: C itself and its pseudo-inverse, N = (C Cᵀ)⁻¹C, which changes
by a product of two vectors in each step. What follows is written for one problem and mapped over
all of them: their steps are the same few products.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import dynamic_index_in_dim

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
    """A problem: Y (m, n), the rest (m,)."""

    Y: Any
    order: Any
    free: Any
    lower: Any
    upper: Any
    equal: Any
    largest: Any
    """The largest of what is given, a number."""


class _State(NamedTuple):
    w: Any
    C: Any
    """Active rows, with the sign that makes them upper limits (n, n); 0 in free slots."""
    N: Any
    target: Any
    """What C w is at the limits (n,)."""
    force: Any
    """Multipliers of the slots (n,), none negative but those of equalities."""
    row: Any
    """Which row a slot holds (n,); −1 if it is free."""
    sign: Any
    held: Any
    """Rows that are active (m,): what rounding leaves of them is no violation."""
    spared: Any
    """Rows (m,) that seem violated, depend on the active ones, and may be so by rounding."""
    new: Any
    """The row that is being taken up; −1 between two."""
    side: Any
    push: Any
    """Its multiplier so far."""
    done: Any
    infeasible: Any
    stuck: Any
    count: Any


def _at(array: Any, index: Any) -> Any:
    return dynamic_index_in_dim(array, index, keepdims=False)


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
    Y = Y[0] if len(Y) == 1 else Y[mine]
    g = _Given(Y, order, free, lower, upper, lower == upper, largest)
    shared = _Given(None if Y.ndim == 2 else 0, None, 0, 0, 0, 0, 0)

    def mapped(function: Any) -> Any:
        return jax.vmap(function, in_axes=(shared, 0))

    def round_of(carry: tuple[Any, _State]) -> tuple[Any, _State]:
        def unfinished(s: _State) -> Any:
            return ~jnp.all(s.done) & (jnp.max(s.count) < limit)

        s = jax.lax.while_loop(unfinished, lambda s: mapped(_step)(g, s), carry[1])
        return carry[0] + 1, jax.vmap(_afresh, in_axes=(shared, 0, 0, None))(g, s, skip, limit)

    zero, none = jnp.zeros((b, n)), jnp.zeros((b, n, n))
    nothing, no, none_yet = jnp.full(b, -1), jnp.zeros(b, bool), jnp.zeros((b, m), bool)
    start = _State(
        zero, none, none, zero, zero, jnp.full((b, n), -1), zero, none_yet, none_yet,
        nothing, jnp.ones(b), jnp.zeros(b), skip, no, no, jnp.zeros(b, int),
    )  # fmt: skip
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] < ROUNDS) & ~jnp.all(carry[1].done), round_of, (0, start)
    )
    multipliers, rows, error = mapped(_found)(g, end)
    limited = ~end.done | (end.count >= limit)
    return Dual(end.w, multipliers, rows, error, end.infeasible, limited, end.count)


class _Row(NamedTuple):
    """The row to take up: which, with which sign, its multiplier, how far it is beyond."""

    place: Any
    side: Any
    push: Any
    violation: Any
    none: Any


def _chosen(g: _Given, s: _State, radius: Any) -> _Row:
    """Return the row that was begun with or, if there is none, the worst of the first in order."""
    rows = g.free + s.w @ g.Y.T
    over, under = rows - g.upper, g.lower - rows
    beyond = jnp.maximum(over, under)
    violated = ~(s.held | s.spared) & (beyond > ROOM * (jnp.abs(g.free) + radius))
    share = beyond / (beyond + g.largest)
    worst = jnp.argmax(jnp.where(violated, g.order + share, 0.0))
    fresh = s.new < 0
    p = jnp.where(fresh, worst, s.new)
    above, below = _at(over, p), _at(under, p)
    side = jnp.where(fresh, jnp.where(above >= below, 1.0, -1.0), s.side)
    violation = jnp.where(side > 0, above, below)
    return _Row(p, side, jnp.where(fresh, 0.0, s.push), violation, fresh & ~_at(violated, p))


def _step(g: _Given, s: _State) -> _State:
    """Move until the chosen row is met, and take it up, or a multiplier is zero, and let it go."""
    radius = jnp.linalg.norm(s.w)
    row = _chosen(g, s, radius)
    normal = row.side * _at(g.Y, row.place)

    # Moving by −z lowers the row and keeps the active ones where they are.
    r = s.N @ normal
    z = normal - r @ s.C
    again = s.N @ z
    r, z = r + again, z - again @ s.C
    length = jnp.linalg.norm(z)
    # What is left of a sum of large terms is rounding.
    terms = 10 * ROUNDING * (1 + jnp.abs(r).sum())
    moves = length > jnp.maximum(DEPENDENT, terms)
    full = jnp.where(moves, row.violation / jnp.where(moves, length, 1.0) ** 2, jnp.inf)
    bound = (s.row >= 0) & ~g.equal[s.row] & (r > 1e-14)
    room = jnp.where(bound, s.force / jnp.where(bound, r, 1.0), jnp.inf)
    first = jnp.argmin(room)
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
    force = jnp.maximum(s.force - t * r, jnp.where(bound, 0.0, -jnp.inf))
    here = jnp.arange(len(g.free)) == row.place
    moved = s._replace(
        w=s.w - (t * moves) * z,
        force=force,
        side=row.side,
        push=row.push + t,
        spared=(s.spared | (spare & here)) & ~go,
        done=done,
        infeasible=s.infeasible | (proof & ~s.done),
        stuck=s.stuck | (nowhere & ~proof & ~s.done),
        count=s.count + ~done,
    )
    return _exchanged(g, moved, row, (normal, r, z), add, go & ~add, first)


def _exchanged(
    g: _Given, s: _State, row: _Row, way: tuple[Any, Any, Any], add: Any, drop: Any, first: Any
) -> _State:
    """Give a free slot to the row if ``add``, and free the slot ``first`` if ``drop``."""
    normal, r, z = way
    place = jnp.arange(len(s.row)) == jnp.where(add, jnp.argmin(s.row >= 0), first)
    lines = jnp.arange(len(g.free))
    held = s.held & ~(drop & (lines == _at(s.row, first))) | (add & (lines == row.place))

    # The pseudo-inverse of one row more, or of one less.
    gone = _at(s.N, first)
    by = jnp.where(add, z, gone)
    square = by @ by
    square = jnp.where(square > 0, square, 1.0)
    change = jnp.where(add, jnp.where(place, 1.0, -r), -(s.N @ gone)) / square
    N = s.N + jnp.where(add | drop, change, 0.0)[:, None] * by
    freed, taken = place & drop, place & add
    free = _at(g.free, row.place)
    above, below = _at(g.upper, row.place) - free, free - _at(g.lower, row.place)
    limit = jnp.where(row.side > 0, above, below)

    def put(old: Any, new: Any, nothing: float) -> Any:
        return jnp.where(freed, nothing, jnp.where(taken, new, old))

    return s._replace(
        C=jnp.where(freed[:, None], 0.0, jnp.where(taken[:, None], normal, s.C)),
        N=jnp.where(freed[:, None], 0.0, N),
        target=put(s.target, limit, 0.0),
        force=put(s.force, s.push, 0.0),
        row=put(s.row, row.place, -1),
        sign=put(s.sign, row.side, 0.0),
        held=held,
        new=jnp.where(drop, row.place, -1),
    )


def _afresh(g: _Given, s: _State, skip: Any, limit: Any) -> _State:
    """Compute w and multipliers from the active rows alone; go on if that breaks a limit."""
    w = s.target @ s.N
    for _ in range(2):
        w = w + (s.target - s.C @ w) @ s.N
    force = -(s.N @ w)
    for _ in range(2):
        force = force - s.N @ (w + force @ s.C)
    rows = g.free + w @ g.Y.T
    size = jnp.abs(g.free) + jnp.linalg.norm(w)
    broken = (jnp.maximum(rows - g.upper, g.lower - rows) > 10 * ROOM * size).any()
    again = broken & ~skip & ~s.infeasible & ~s.stuck & (s.count < limit)
    force = jnp.where(again, jnp.maximum(force, 0.0), force)
    return s._replace(w=w, force=force, done=~again, new=jnp.where(again, -1, s.new))


def _found(g: _Given, end: _State) -> tuple[Any, Any, Any]:
    """Return multipliers and rows (m,), and an estimate of the largest error of the first n rows.

    From what w and λ are, not how. How far active rows are from their limits, rounding included,
    moves the other rows by Y N, and active ones not at all. A multiplier too small to be sure of
    its sign is another error, as is the part of w that the active rows do not span, and a row
    beyond its limits.
    """
    m, n = g.Y.shape
    place = jnp.where(end.row >= 0, end.row, m)
    multipliers = jnp.zeros(m + 1).at[place].add(end.sign * end.force)[:m]
    rows = g.free + end.w @ g.Y.T
    inputs, radius = g.Y[:n], jnp.linalg.norm(end.w)
    active = (jnp.arange(n)[:, None] == end.row).any(-1)
    held = end.row >= 0
    miss = jnp.abs(end.C @ end.w - end.target)
    miss = jnp.where(held, miss + ROUNDING * (jnp.abs(end.target) + radius), 0.0)
    spread = jnp.abs(inputs @ end.N.T)
    astray = end.w
    for _ in range(2):
        astray = astray - (end.N @ astray) @ end.C
    aside = jnp.abs(inputs @ astray)
    moved = (spread @ miss + jnp.where(active, 0.0, aside)).max()
    weights = jnp.linalg.norm(end.N, axis=-1)
    unsure = ROUNDING * weights * radius
    free = g.equal[end.row]
    wrong = jnp.where(held & ~free & (end.force < unsure), unsure - jnp.minimum(end.force, 0), 0.0)
    beyond = jnp.maximum(jnp.maximum(rows - g.upper, g.lower - rows), 0.0).max()
    softness = jnp.linalg.norm(weights)
    large = jnp.where(beyond > 100 * ROOM * (jnp.abs(rows).max() + radius), softness, 1.0)
    return multipliers, rows, moved + wrong.max() + large * beyond
