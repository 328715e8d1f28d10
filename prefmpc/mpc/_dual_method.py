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
    """w (b, n) and multipliers (b, m); the largest error of one of the first n rows; verdicts."""

    w: Any
    multipliers: Any
    error: Any
    infeasible: Any
    limited: Any
    count: Any


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


def dual_method(
    Y: Any, mine: Any, order: Any, free: Any, lower: Any, upper: Any, skip: Any
) -> Dual:
    """Solve b problems: Y (c, m, n), ``mine`` (b,) which of them, the rest (b, m).

    Of violated rows one with the largest ``order`` (m,) is taken up, of these the worst. Where
    ``skip`` (b,) nothing is done. Infinite limits are none.
    """
    b, (m, n) = len(mine), Y.shape[1:]
    limit = LIMIT[0] * n + LIMIT[1]
    if len(Y) == 1:

        def rows_of(w: Any) -> Any:
            return free + w @ Y[0].T

        def row_of(p: Any) -> Any:
            return Y[0][p]

    else:
        own = Y[mine]

        def rows_of(w: Any) -> Any:
            return free + _of(own, w)

        def row_of(p: Any) -> Any:
            return jnp.take_along_axis(own, p[:, None, None], axis=1)[:, 0]

    equal = lower == upper
    given = [jnp.abs(free), *(jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0) for a in (lower, upper))]
    largest = jnp.max(jnp.stack(given), axis=(0, 2))
    slots = jnp.arange(n)

    def step(state: _State) -> _State:
        s = state
        # The row to take up: the one begun, or the worst of the first in order.
        rows = rows_of(s.w)
        over, under = rows - upper, lower - rows
        radius = jnp.linalg.norm(s.w, axis=-1)
        size = jnp.abs(free) + radius[:, None]
        beyond = jnp.maximum(over, under)
        open_ = ~(s.held | s.spared)
        share = beyond / (beyond + largest[:, None])
        worst = jnp.argmax(jnp.where(open_ & (beyond > ROOM * size), order + share, 0.0), axis=-1)
        fresh = s.new < 0
        p = jnp.where(fresh, worst, s.new)
        side = jnp.where(fresh, jnp.where(_at(over, p) >= _at(under, p), 1.0, -1.0), s.side)
        push = jnp.where(fresh, 0.0, s.push)
        violation = jnp.where(side > 0, _at(over, p), _at(under, p))
        arrived = fresh & ~((violation > ROOM * _at(size, p)) & _at(open_, p))

        # Moving by −z lowers it and keeps the active rows where they are.
        normal = side[:, None] * row_of(p)
        r = _of(s.N, normal)
        z = normal - _back(s.C, r)
        more = _of(s.N, z)
        r, z = r + more, z - _back(s.C, more)
        length = jnp.linalg.norm(z, axis=-1)
        # What is left of a sum of large terms is rounding.
        terms = 10 * ROUNDING * (1 + jnp.abs(r).sum(-1))
        moves = length > jnp.maximum(DEPENDENT, terms)
        full = jnp.where(moves, violation / jnp.where(moves, length, 1.0) ** 2, jnp.inf)
        bound = (s.row >= 0) & ~jnp.take_along_axis(equal, s.row, axis=1) & (r > 1e-14)
        room = jnp.where(bound, s.force / jnp.where(bound, r, 1.0), jnp.inf)
        first = jnp.argmin(room, axis=-1)
        t = jnp.minimum(full, _at(room, first))

        reach = violation / jnp.maximum(length, 1e-300)
        blocked, hopeless = ~arrived & ~jnp.isfinite(t), radius > HOPELESS * largest
        spare = blocked & (violation <= terms * (radius + largest))
        proof = blocked & ~spare & (reach > FAR * (radius + largest))
        nowhere = (blocked & ~spare) | (~arrived & hopeless) | ~jnp.isfinite(violation)
        done = s.done | arrived | nowhere
        go = ~(done | spare)
        t = jnp.where(go, t, 0.0)
        add = go & (full <= _at(room, first))
        drop = go & ~add

        w = s.w - (t * moves)[:, None] * z
        force = jnp.maximum(s.force - t[:, None] * r, jnp.where(bound, 0.0, -jnp.inf))
        push = push + t

        # Taken up: a free slot gets the row. Let go: its slot becomes free.
        empty = jnp.argmin(s.row >= 0, axis=-1)
        place = slots == jnp.where(add, empty, first)[:, None]
        add, drop = add[:, None], drop[:, None]
        g = jnp.take_along_axis(s.N, first[:, None, None], axis=1)[:, 0]
        by = jnp.where(add, z, g)
        square = jnp.sum(by * by, axis=-1, keepdims=True)
        square = jnp.where(square > 0, square, 1.0)
        change = jnp.where(add, jnp.where(place, 1.0, -r), -_of(s.N, g)) / square
        change = jnp.where(add | drop, change, 0.0)
        N = s.N + change[:, :, None] * by[:, None, :]
        gone, comes = (place & drop)[:, :, None], (place & add)[:, :, None]
        N = jnp.where(gone, 0.0, N)
        C = jnp.where(gone, 0.0, jnp.where(comes, normal[:, None, :], s.C))
        lines = jnp.arange(m)[None, :]
        held = s.held & ~(drop & (lines == _at(s.row, first)[:, None]))
        held |= add & (lines == p[:, None])
        spared = (s.spared | (spare[:, None] & (lines == p[:, None]))) & ~go[:, None]
        limits = jnp.where(side > 0, _at(upper - free, p), _at(free - lower, p))

        def put(old: Any, taken: Any, free_slot: Any) -> Any:
            new = jnp.where(place & add, taken[:, None], old)
            return jnp.where(place & drop, free_slot, new)

        return _State(
            w,
            C,
            N,
            target=put(s.target, limits, 0.0),
            force=put(force, push, 0.0),
            row=put(s.row, p, -1),
            sign=put(s.sign, side, 0.0),
            held=held,
            spared=spared,
            new=jnp.where(drop[:, 0], p, -1),
            side=side,
            push=push,
            done=done,
            infeasible=s.infeasible | (proof & ~s.done),
            stuck=s.stuck | (nowhere & ~proof & ~s.done),
            count=s.count + ~done,
        )

    def afresh(s: _State) -> _State:
        """Compute w and the multipliers from the active rows alone; let go of wrong signs."""
        w = _back(s.N, s.target)
        for _ in range(2):
            w = w + _back(s.N, s.target - _of(s.C, w))
        force = -_of(s.N, w)
        for _ in range(2):
            force = force - _of(s.N, w + _back(s.C, force))
        return s._replace(w=w, force=force)

    def round_of(carry: tuple[Any, _State]) -> tuple[Any, _State]:
        k, state = carry

        def unfinished(s: _State) -> Any:
            return ~jnp.all(s.done) & (jnp.max(s.count) < limit)

        state = afresh(jax.lax.while_loop(unfinished, step, state))
        # Go on where what was computed afresh breaks a limit.
        rows = rows_of(state.w)
        size = jnp.abs(free) + jnp.linalg.norm(state.w, axis=-1)[:, None]
        broken = (jnp.maximum(rows - upper, lower - rows) > 10 * ROOM * size).any(-1)
        again = broken & ~skip & ~state.infeasible & ~state.stuck & (state.count < limit)
        force = jnp.where(again[:, None], jnp.maximum(state.force, 0.0), state.force)
        return k + 1, state._replace(done=~again, force=force, new=jnp.where(again, -1, state.new))

    zero, none = jnp.zeros((b, n)), jnp.zeros((b, n, n))
    nothing, no = jnp.full(b, -1), jnp.zeros(b, bool)
    count, none_yet = jnp.zeros(b, int), jnp.zeros((b, m), bool)
    start = _State(
        zero, none, none, zero, zero, jnp.full((b, n), -1), zero, none_yet, none_yet,
        nothing, jnp.ones(b), jnp.zeros(b), skip, no, no, count,
    )  # fmt: skip
    _, end = jax.lax.while_loop(
        lambda carry: (carry[0] < ROUNDS) & ~jnp.all(carry[1].done), round_of, (0, start)
    )
    lanes = jnp.arange(b)[:, None]
    place = jnp.where(end.row >= 0, end.row, m)
    multipliers = jnp.zeros((b, m + 1)).at[lanes, place].add(end.sign * end.force)[:, :m]
    limited = ~end.done | (end.count >= limit)
    inputs = Y[:, :n] if len(Y) == 1 else own[:, :n]
    error = _error(end, equal, rows_of(end.w), lower, upper, inputs)
    return Dual(end.w, multipliers, error, end.infeasible, limited, end.count)


def _error(end: _State, equal: Any, rows: Any, lower: Any, upper: Any, inputs: Any) -> Any:
    """Estimate the largest error of one of the first n rows, from what w and λ are, not how.

    How far active rows are from their limits, rounding included, moves the other rows by Y N, and
    active ones not at all. A multiplier too small to be sure of its sign is another error, as is
    the part of w that the active rows do not span, and a row beyond its limits.
    """
    radius = jnp.linalg.norm(end.w, axis=-1)[:, None]
    held = end.row >= 0
    miss = jnp.abs(_of(end.C, end.w) - end.target)
    miss = jnp.where(held, miss + ROUNDING * (jnp.abs(end.target) + radius), 0.0)
    spread = jnp.abs(
        jnp.einsum("...in,bjn->bij" if inputs.ndim == 2 else "bin,bjn->bij", inputs, end.N)
    )
    astray = end.w - _back(end.C, _of(end.N, end.w))
    astray = astray - _back(end.C, _of(end.N, astray))
    aside = jnp.abs(inputs @ astray[..., None])[..., 0]
    n = inputs.shape[-2]
    active = (jnp.arange(n)[None, :, None] == end.row[:, None, :]).any(-1)
    moved = (_of(spread, miss) + jnp.where(active, 0.0, aside)).max(-1)
    weights = jnp.linalg.norm(end.N, axis=-1)
    unsure = ROUNDING * weights * radius
    free = jnp.take_along_axis(equal, end.row, axis=1)
    wrong = jnp.where(held & ~free & (end.force < unsure), unsure - jnp.minimum(end.force, 0), 0.0)
    beyond = jnp.maximum(jnp.maximum(rows - upper, lower - rows), 0.0).max(-1)
    softness = jnp.sqrt(jnp.sum(weights**2, axis=-1))
    large = jnp.where(beyond > 100 * ROOM * (jnp.abs(rows).max(-1) + radius[:, 0]), softness, 1.0)
    return moved + wrong.max(-1) + large * beyond
