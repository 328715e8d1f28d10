"""Every answer is a choice among alternatives, or several: one likelihood for all of them.

The utilities u_k of the alternatives are linear in σ of what was shown and in a few thresholds,
and −log P(k is chosen) = logsumexp(u) − u_k, which is convex in both, and so in all weights of a
σ that is linear in them, (Q, R) among them. On a scale of g marks

    two trajectories A and B:   u_k = −(½ + s_k)·σ(A) − (½ − s_k)·σ(B) + c_k
    one trajectory A:           u_m = −m·σ(A) + τ_1 + … + τ_m,   m = 0 … g − 1

s_k falls in equal steps, s_k = −s_{g−1−k}, and the mildest marks on both sides of the middle
differ by 1 in it, as do the two marks of a plain pair; c_k = c_{g−1−k} is learned, with c_0 = 0.
So between two neighbouring marks the log-odds are linear: the ordered logit of *adjacent
categories*. The cumulative one is jointly convex too, but is no choice with linear utilities, and
its cut points must stay in order. Special cases:

- g = 2: c = 0, the logistic loss of a pair, eq. (4) of arXiv 2511.22502;
- g = 3: Davidson's model of ties, u = (−σ(A), ν − (σ(A) + σ(B))/2, −σ(B)) with ν = c_1. Rao and
  Kupper's is the cumulative one: jointly convex in σ and the logarithm of its threshold, but only
  where that is positive, which is a constraint; Davidson's ν may be any number. Without its ties
  it is the model of a plain pair with the same σ, so that both can stand in one data set.
- one trajectory, g = 2: acceptable with the log-odds τ − σ(A).

A ranking is Plackett and Luce's: a choice of the best, then of the best of the others, and so on
as far as it goes, with u_k = −σ(T_k). The best of many is a ranking of one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array

from prefmpc.preferences.answers import Answers
from prefmpc.preferences.codings import RANKING


class Thresholds(NamedTuple):
    """Which thresholds a data set has: of (how many were shown, grades) a slice of all of them."""

    places: dict[tuple[int, int], slice]
    total: int

    @classmethod
    def of(cls, *sets: Answers) -> Thresholds:
        """Return those of several data sets, in a fixed order."""
        kinds = np.concatenate([np.stack([one.sizes, one.grades], axis=1) for one in sets])
        places, count = {}, 0
        for size, grades in np.unique(kinds[kinds[:, 1] != RANKING], axis=0):
            more = grades - 1 if size == 1 else (grades - 1) // 2
            if more:
                places[int(size), int(grades)] = slice(count, count + int(more))
                count += int(more)
        return cls(places, count)

    def named(self, values: Any) -> dict[str, np.ndarray]:
        """Return thresholds (..., total) by name."""
        names = {(1, 2): "acceptable", (2, 3): "tie"}
        return {
            names.get(kind, f"{kind[1]} {'stars' if kind[0] == 1 else 'grades'}"): np.asarray(
                values
            )[..., place]
            for kind, place in self.places.items()
        }


NO_THRESHOLDS = Thresholds({}, 0)


class Choices(NamedTuple):
    """Choices among K alternatives: u = offsets·thresholds − coefficients·σ(items), summed."""

    items: Any
    """(n, K, 2) int, trajectories."""
    coefficients: Any
    """(n, K, 2)"""
    which: Any
    """(n, K) int, rows of ``offsets``, the first of which is zero."""
    chosen: Any
    """(n, K): what is chosen, as weights that add up to 1."""
    possible: Any
    """(n, K) bool: False where there are fewer alternatives. The first one is always there."""
    answer: Any
    """(n,) int: of which answer this is a part."""


def choices_of(answers: Answers, thresholds: Thresholds) -> tuple[list[Choices], np.ndarray]:
    """Return all choices, those of a kind together, and ``offsets`` (rows, thresholds)."""
    found, rows = [], [np.zeros((1, thresholds.total))]
    sizes, grades = answers.sizes, answers.grades
    for size, marks in np.unique(np.stack([sizes, grades], axis=1), axis=0):
        which = np.flatnonzero((sizes == size) & (grades == marks))
        items = answers.shown[which, :size]
        if marks == RANKING:
            ranked = answers.answers[which]
            for stage in range(size - 1):
                there = ranked > stage
                if there.any():
                    found.append(_stage(items[there, stage:], which[there]))
            continue
        coefficients, offsets = _scale(size, marks)
        used = thresholds.places.get((int(size), int(marks)))
        kinds = np.zeros(marks, dtype=int)
        if used is not None:
            kinds = sum(map(len, rows)) + np.arange(marks)
            rows.append(np.zeros((marks, thresholds.total)))
            rows[-1][:, used] = offsets
        shape = (len(which), marks)
        found.append(
            Choices(
                np.broadcast_to(items[:, None, [0, -1]], (*shape, 2)),
                np.broadcast_to(coefficients, (*shape, 2)),
                np.broadcast_to(kinds, shape),
                _chosen(answers.answers[which], marks),
                np.ones(shape, dtype=bool),
                which,
            )
        )
    return found, np.concatenate(rows)


def _stage(items: np.ndarray, which: np.ndarray) -> Choices:
    """Return the choice of the first of items (n, K)."""
    first = np.zeros(items.shape)
    first[:, 0] = 1.0
    return Choices(
        np.stack([items, items], axis=-1),
        np.broadcast_to([1.0, 0.0], (*items.shape, 2)),
        np.zeros(items.shape, dtype=int),
        first,
        np.ones(items.shape, dtype=bool),
        which,
    )


def _scale(size: int, marks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients of σ (marks, 2) and of the scale's thresholds, the best mark first."""
    if size == 1:
        stars = np.arange(marks)[::-1]
        return np.stack([stars, 0 * stars], axis=1).astype(float), np.tri(marks, k=-1)[::-1, :-1]
    step = 1.0 if marks % 2 == 0 else 0.5
    s = step * ((marks - 1) / 2 - np.arange(marks))
    depth = np.minimum(np.arange(marks), np.arange(marks)[::-1])  # 0 at both ends
    return np.stack([0.5 + s, 0.5 - s], axis=1), np.eye((marks + 1) // 2)[depth, 1:]


def _chosen(grades: np.ndarray, marks: int) -> np.ndarray:
    """Return the marks of grades (n,) as weights (n, marks), both neighbours if between them."""
    place = (1 - grades) * (marks - 1)
    return np.maximum(0.0, 1 - np.abs(place[:, None] - np.arange(marks)))


def merged(parts: list[Choices], width: int, size: int) -> tuple[Choices, np.ndarray]:
    """Return choices as one set of ``width`` alternatives, padded to ``size``, and weights.

    What is padded has weight 0, and alternatives that there are not are impossible.
    """
    n = sum(len(part.answer) for part in parts)

    def together(*arrays: Any) -> np.ndarray:
        if arrays[0].ndim > 1:
            arrays = tuple(
                np.pad(a, [(0, 0), (0, width - a.shape[1]), *[(0, 0)] * (a.ndim - 2)])
                for a in arrays
            )
        whole = np.concatenate(arrays)
        return np.concatenate([whole, np.broadcast_to(whole[:1], (size - n, *whole.shape[1:]))])

    return Choices(*map(together, *parts)), (np.arange(size) < n).astype(float)


class Wide(NamedTuple):
    """Choices among more than two, for Newton's method: K − 1 utilities minus the first one's."""

    gap: Any
    """(p, K − 1, size): their derivatives with respect to all weights and thresholds."""
    labels: Any
    """(K − 1, size): what is chosen."""
    weights: Any
    possible: Any
    """(K − 1, size)"""


def gaps(
    answers: Answers, thresholds: Thresholds, pool: np.ndarray, padded: Any
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], tuple[Wide, ...]]:
    """Return all choices by their gaps of utilities, linear in weights and thresholds.

    Parameters
    ----------
    pool : array (p, n_t)
        The derivatives of σ of each trajectory.
    padded : function
        Of a number of choices and a smallest size: the size that they are padded to.

    Returns
    -------
    gap (p + thresholds, size), labels (size,), weights (size,)
        Of choices among two, as in the loss of pairs.
    tuple of Wide
        The others: among 3, 4 to 5, 6 to 9, … alternatives, so that few shapes are compiled.
    """
    found, offsets = choices_of(answers, thresholds)
    sets: dict[int, list[Choices]] = {}
    for part in found:
        K = part.chosen.shape[1]
        sets.setdefault(1 << (K - 2).bit_length(), []).append(part)
    rows = len(pool) + thresholds.total
    pairs = np.zeros((rows, padded(1))), np.zeros(padded(1)), np.zeros(padded(1))
    wide = []
    for width, parts in sorted(sets.items()):
        n = sum(len(part.answer) for part in parts)
        size = padded(n) if width == 1 else padded(n, 128)
        choices, weights = merged(parts, width + 1, size)
        gap = _gaps(choices, offsets, pool, -1.0 if width == 1 else 1.0)
        if width == 1:
            pairs = gap[:, 0] * weights, choices.chosen[:, 0] * weights, weights
        else:
            labels, possible = choices.chosen[:, 1:].T, choices.possible[:, 1:].T
            wide.append(Wide(*map(np.ascontiguousarray, (gap, labels, weights, possible))))
    return pairs, tuple(wide)


def _gaps(choices: Choices, offsets: np.ndarray, pool: np.ndarray, sign: float) -> np.ndarray:
    """Return sign·(u_k − u_0) for k = 1 … K − 1, as rows (p + thresholds, K − 1, n) of weights."""
    n, K = choices.chosen.shape
    first, others = (
        (choices.items[:, part], choices.coefficients[:, part], choices.which[:, part])
        for part in (slice(0, 1), slice(1, None))
    )
    shape = (n, K - 1, 2)
    columns = np.concatenate([np.broadcast_to(first[0], shape), others[0]], axis=-1)
    values = np.concatenate([np.broadcast_to(first[1], shape), -others[1]], axis=-1)
    there = (values != 0) & choices.possible[:, 1:, None]
    row = np.broadcast_to(np.arange(n * (K - 1)).reshape(n, K - 1, 1), there.shape)
    S = coo_array(
        (sign * values[there], (row[there], columns[there])), shape=(n * (K - 1), pool.shape[1])
    ).tocsr()
    gap = np.empty((len(pool) + offsets.shape[1], K - 1, n))
    gap[: len(pool)] = (S @ pool.T).T.reshape(-1, n, K - 1).swapaxes(1, 2)
    gap[len(pool) :] = sign * np.moveaxis(offsets[others[2]] - offsets[first[2]], -1, 0).swapaxes(
        1, 2
    )
    return gap
