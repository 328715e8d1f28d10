"""The most probable log weights of several people at once, and Gaussians about them.

A person's log weights are θ = centre + shared·u + own·x: u is what all have in common, x what is
theirs alone, both standard Gaussians beforehand. P(first preferred) = ε/2 + (1 − ε)·logistic(z)
with z = gap·e^θ and the person's lapse rate ε. Each person's x meets the others' through u alone,
so that Newton's method solves small systems, one for each person.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, log_expit, logit

from prefmpc.learning._answers import Answers

LAPSE_CENTRE, LAPSE_SPREAD = float(logit(0.05)), 1.5
"""An estimated lapse rate has a logit with this mean and standard deviation: 0.4 % to 38 %."""

LONGEST = 2.0
"""No coordinate moves further in one step, in standard deviations of its prior."""

SURE = 1.0
"""Typical size of the log-odds where the search starts: there the loss has curvature everywhere."""

TOLERANCE = 1e-9


def lapsing(z: np.ndarray, labels: np.ndarray, rate: Any) -> np.ndarray:
    """Return the loss (n,), its derivatives by z, by ζ = logit(rate), by z², ζ² and zζ: (6, n).

    Written with logarithms, so that neither a rate of 0 nor the largest log-odds is a limit.
    """
    with np.errstate(divide="ignore"):
        guess, heed = np.log(rate / 2), np.log1p(-rate)
    yes, no = log_expit(z), log_expit(-z)
    log_p, log_q = np.logaddexp(guess, heed + yes), np.logaddexp(guess, heed + no)
    s, slope = expit(z), heed + yes + no
    p_z, q_z = np.exp(slope - log_p), -np.exp(slope - log_q)  # ∂p/∂z over p, ∂q/∂z over q
    bend = 1 - 2 * s
    # ∂ε/∂ζ = ε(1 − ε); over p and q. p_ε = 1/2 − s.
    rise = rate * (1 - rate)
    with np.errstate(over="ignore", invalid="ignore"):
        p_l, q_l = rise * bend / 2 * np.exp(-log_p), -rise * bend / 2 * np.exp(-log_q)
    p_l, q_l = np.where(rise > 0, p_l, 0.0), np.where(rise > 0, q_l, 0.0)
    # ∂²p/∂z∂ζ over p is −ε·p_z, since ∂p/∂z = (1 − ε)s(1 − s).
    parts = []
    for log, by_z, by_l in ((log_p, p_z, p_l), (log_q, q_z, q_l)):
        parts.append(
            np.stack(
                [
                    -log,
                    -by_z,
                    -by_l,
                    by_z**2 - by_z * bend,
                    by_l**2 - by_l * (1 - 2 * rate),
                    by_z * by_l + rate * by_z,
                ]
            )
        )
    return labels * parts[0] + (1 - labels) * parts[1]


class Form(NamedTuple):
    """θ and logit lapse rates (p + 1,) of a person: centre + shared·u + own·x."""

    centre: Any
    shared: Any
    """(p + 1, r)"""
    own: Any
    """(p + 1, q)"""


def ratios(p: int) -> np.ndarray:
    """Return p − 1 orthonormal directions (p, p − 1) in which log weights change their ratios."""
    return np.linalg.svd(np.ones((1, p)))[2][1:].T


def form(
    p: int, spread: float, sharpness: float, apart: float, sharper: float, lapse: float | None
) -> Form:
    """Return the form for people about a common centre, itself about the prior's mode.

    Parameters
    ----------
    spread, sharpness : float
        Standard deviations of the centre's log weights: of their ratios, and of what they share.
    apart, sharper : float
        The same, of each person's about the centre.
    lapse : float or None
        A rate in [0, 1), or None: estimated.
    """
    inside = ratios(p)
    level = np.ones((p, 1))
    own = [sharper * level] + ([apart * inside] if apart else [])
    estimated = lapse is None
    sides = [[spread * inside, sharpness * level], own]
    shared, own_ = (np.concatenate(side, axis=1) for side in sides)
    shared = np.concatenate([shared, np.zeros((1, shared.shape[1]))])
    own_ = np.concatenate([own_, np.zeros((1, own_.shape[1]))])
    centre = np.zeros(p + 1)
    if estimated:
        own_ = np.concatenate([own_, LAPSE_SPREAD * np.eye(p + 1)[:, -1:]], axis=1)
        centre[-1] = LAPSE_CENTRE
    else:
        with np.errstate(divide="ignore"):
            centre[-1] = logit(lapse)
    return Form(centre, shared, own_)


class Mode(NamedTuple):
    """What `minimise` found.

    With H the Hessian of −log posterior: ``inner`` and ``mixed`` are its blocks of each person,
    ``outer`` is what is left for u (Schur's complement).
    """

    u: Any
    x: Any
    energy: Any
    """−log posterior density of (u, x), in which the prior is a standard Gaussian."""
    log_evidence: Any
    own_evidence: Any
    """(m,): log P(a person's answers given u), their x integrated out by Laplace's method."""
    decrement: Any
    curvature: Any
    """The least eigenvalue of ``inner`` and of ``outer``; the prior's are 1."""
    steps: Any
    outer: Any
    inner: Any
    mixed: Any

    @property
    def certified(self) -> bool:
        """Whether gradient and curvature make this a local minimum."""
        finite = np.isfinite([self.energy, self.decrement, self.curvature]).all()
        near = self.decrement <= TOLERANCE * (1 + abs(self.energy))
        return bool(finite and near and self.curvature > 0)

    def covariance(self, by_u: np.ndarray, by_x: np.ndarray) -> np.ndarray:
        """Return the covariance (m, k, k) of ``by_u``·u + ``by_x``·x of each person.

        ``by_u`` (k, r) and ``by_x`` (k, q) are the same for all.
        """
        gain = np.linalg.solve(self.inner, self.mixed.swapaxes(1, 2))  # (m, q, r)
        slope = by_u - by_x @ gain
        return slope @ np.linalg.solve(self.outer, slope.swapaxes(1, 2)) + by_x @ np.linalg.solve(
            self.inner, np.broadcast_to(by_x.T, (len(self.x), *by_x.T.shape))
        )


def minimise(
    answers: Answers,
    form: Form,
    *,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    counts: np.ndarray | None = None,
    limit: int = 100,
) -> Mode:
    """Minimise −log posterior by Newton's method; directions of negative curvature turn round.

    Not convex in log weights, nor with a lapse rate: what is found is a local minimum, certified
    by decrement and curvature. The same answers and start give the same one.

    Parameters
    ----------
    start : u (r,) and x (m, q), optional
        By default at the prior's centre, made so unsharp that no answer is far from the model.
    counts : array (m,), optional
        As how many people each one counts for u: the responsibilities of a mixture.
    """
    m = len(answers.start)
    counts = np.ones(m) if counts is None else counts
    u, x = _unsharp(answers, form) if start is None else start
    energy, parts = _energy(answers, form, u, x, counts)
    steps, decrement = 0, np.inf
    while True:
        system = _system(answers, form, u, x, parts, counts)
        decrement = system.decrement
        done = decrement <= TOLERANCE * (1 + abs(energy)) and system.curvature > 0
        if done or steps == limit or not np.isfinite(decrement):
            break
        du, dx = system.step
        t = min(
            1.0, LONGEST / max(np.abs(du).max(initial=0.0), np.abs(dx).max(initial=0.0), 1e-300)
        )
        while t > 1e-10:
            trial, parts_ = _energy(answers, form, u + t * du, x + t * dx, counts)
            if trial <= energy - 0.2 * t * decrement + 1e-13 * (1 + abs(energy)):
                break
            t /= 2
        else:
            break
        u, x, energy, parts, steps = u + t * du, x + t * dx, trial, parts_, steps + 1
    own = -answers.total(answers.weights * parts.loss[0]) - 0.5 * (x**2).sum(-1)
    own = own - 0.5 * system.log_det
    log_evidence = counts @ own - 0.5 * (u**2).sum() - 0.5 * np.linalg.slogdet(system.outer)[1]
    return Mode(
        u, x, energy, float(log_evidence), own, decrement, system.curvature, steps,
        system.outer, system.inner, system.mixed,
    )  # fmt: skip


def _unsharp(answers: Answers, form: Form) -> tuple[np.ndarray, np.ndarray]:
    z = answers.gap @ np.exp(form.centre[:-1])
    size = np.sqrt((answers.weights @ z**2) / max(answers.weights.sum(), 1e-300))
    level = -np.log(max(size / SURE, 1.0))
    x = np.zeros((len(answers.start), form.own.shape[1]))
    if form.shared.shape[1]:
        to_u = np.linalg.pinv(form.shared[:-1]) @ np.full(len(form.centre) - 1, level)
        return to_u, x
    return np.zeros(0), x + np.linalg.pinv(form.own[:-1]) @ np.full(len(form.centre) - 1, level)


class _Parts(NamedTuple):
    w: Any
    """(n, p): the weights of whoever gave each answer."""
    rate: Any
    """(n,)"""
    loss: Any
    """(6, n): see `lapsing`."""


def _energy(
    answers: Answers, form: Form, u: np.ndarray, x: np.ndarray, counts: np.ndarray
) -> tuple[float, _Parts]:
    phi = form.centre + form.shared @ u + x @ form.own.T
    with np.errstate(over="ignore", invalid="ignore"):
        w, rate = np.exp(phi[:, :-1])[answers.person], expit(phi[:, -1])[answers.person]
        z = (answers.gap * w).sum(-1)
        loss = lapsing(z, answers.labels, rate)
        each = answers.total(answers.weights * loss[0]) + 0.5 * (x**2).sum(-1)
    total = float(counts @ each + 0.5 * (u**2).sum())
    return (total if np.isfinite(total) else np.inf), _Parts(w, rate, loss)


class _System(NamedTuple):
    step: Any
    decrement: Any
    curvature: Any
    outer: Any
    inner: Any
    mixed: Any
    log_det: Any


def _system(
    answers: Answers, form: Form, u: np.ndarray, x: np.ndarray, parts: _Parts, counts: np.ndarray
) -> _System:
    """Return the Newton step, its decrement, and the blocks of the exact Hessian."""
    _, by_z, by_l, by_zz, by_ll, by_zl = parts.loss * answers.weights
    to_theta = answers.gap * parts.w
    p = to_theta.shape[1]
    slope = answers.total(np.column_stack([by_z[:, None] * to_theta, by_l]))
    bend = np.zeros((len(answers.start), p + 1, p + 1))
    bend[:, :p, :p] = answers.total((by_zz[:, None] * to_theta)[:, :, None] * to_theta[:, None])
    bend[:, range(p), range(p)] += slope[:, :p]  # z is an exponential of θ
    bend[:, :p, p] = bend[:, p, :p] = answers.total(by_zl[:, None] * to_theta)
    bend[:, p, p] = answers.total(by_ll)
    inner = form.own.T @ bend @ form.own + np.eye(x.shape[1])
    mixed = form.shared.T @ bend @ form.own  # (m, r, q)
    values, vectors = np.linalg.eigh(inner)
    sizes = _away_from_zero(values)
    inverse = (vectors / sizes[:, None]) @ vectors.swapaxes(1, 2)
    g_x, g_u = x + slope @ form.own, slope @ form.shared
    eliminated = mixed @ inverse  # (m, r, q)
    outer = np.eye(u.size) + np.tensordot(
        counts, form.shared.T @ bend @ form.shared - eliminated @ mixed.swapaxes(1, 2), 1
    )
    rest = u + counts @ (g_u - (eliminated @ g_x[..., None])[..., 0])
    outer_values, outer_vectors = np.linalg.eigh(outer)
    turned = outer_vectors.T @ rest
    outer_sizes = _away_from_zero(outer_values)
    du = -outer_vectors @ (turned / outer_sizes)
    dx = -(inverse @ (g_x + mixed.swapaxes(1, 2) @ du)[..., None])[..., 0]
    alone = (g_x * (inverse @ g_x[..., None])[..., 0]).sum(-1)
    decrement = 0.5 * (counts @ alone + turned @ (turned / outer_sizes))
    least = min(values.min(initial=np.inf), outer_values.min(initial=np.inf))
    return _System(
        (du, dx), float(decrement), float(least), outer, inner, mixed, np.log(sizes).sum(-1)
    )


def _away_from_zero(values: np.ndarray) -> np.ndarray:
    """Return sizes of eigenvalues; none counts as less than a thousandth of the prior's."""
    return np.maximum(np.abs(values), 1e-3)
