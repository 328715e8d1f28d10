"""Samples of what several people want, of how sharp they are, and of their lapse rates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import expit

from prefmpc._checks import instance, positive_int, share
from prefmpc._random import generator
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._people import lapsing
from prefmpc.learning.convex import Interval
from prefmpc.learning.people import PeopleResult
from prefmpc.learning.uncertainty import (
    CHAINS,
    LEAPFROGS,
    QUARTER_PERIOD,
    SMALLEST_SHARE,
    WANTED_ACCEPTANCE,
    effective_draws,
)

WARM_UP = 30

Potential = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True, eq=False)
class PeoplePosterior(Result):
    """Equally probable people after the answers.

    Attributes
    ----------
    names : array (m,)
    sharpness : array (draws, m)
        Geometric mean of each person's weights in units of the prior's mode.
    lapse : array (draws, m)
    relative : array (draws, nx + nu)
        The common weights over their geometric mean, in units of the prior's mode: the diagonals
        of Q and R in a row.
    effective : float
        So many independent draws would tell the mean of each of these (of logarithms) as
        precisely, or more.
    """

    NAME = "people_posterior: the chains disagree"

    names: np.ndarray
    sharpness: np.ndarray
    lapse: np.ndarray
    relative: np.ndarray
    effective: float

    @property
    def success(self) -> bool:
        """Whether the chains agree: at least a tenth of the draws are worth independent ones."""
        finite = np.isfinite(self.relative).all() and np.isfinite(self.effective)
        return bool(finite and self.effective >= SMALLEST_SHARE * len(self.relative))

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return f"{len(self.relative)} draws worth {self.effective:.0f} independent ones"

    @staticmethod
    def interval(draws: np.ndarray, level: float = 0.9) -> Interval:
        """Return the median of draws (axis 0), and bounds with equal shares outside."""
        tail = (1 - share("level", level)) / 2
        lower, middle, upper = np.quantile(draws, [tail, 0.5, 1 - tail], axis=0)
        return Interval(middle, lower, upper)


def people_posterior(result: PeopleResult, *, draws: int = 1024, key: Any = 0) -> PeoplePosterior:
    """Sample what people want around the result of `fit_raters` or `fit_hierarchy`.

    Where answers are few, the most probable point is sharper than most of what is probable, and
    the intervals of Laplace's method are too narrow. Hamiltonian Monte Carlo: 32 chains, started
    from and scaled by Laplace's Gaussian.

    Parameters
    ----------
    result : PeopleResult
    draws : int
        Rounded up to a multiple of 32, at least 256.
    key : JAX random key or int

    Raises
    ------
    FitError
        If ``result`` is not a minimum.
    """
    instance("result", result, PeopleResult)
    steps = max(8, -(-positive_int("draws", draws) // CHAINS))
    result.check()
    rng = generator(key)
    form, mode = result.form, result.mode
    m, q = mode.x.shape
    r = mode.u.size

    def place(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return u (c, r) and x (c, m, q) of points s (c, r + m·q) of a standard Gaussian."""
        du = s[:, :r] @ to_u.T
        dx = s[:, r:].reshape(-1, m, q)
        dx = np.einsum("mij,cmj->cmi", to_x, dx) - np.einsum("mij,cj->cmi", gain, du)
        return mode.u + du, mode.x + dx

    def potential(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return −log posterior (c,) and its gradient (c, d)."""
        energy, by_u, by_x = _slopes(result, *place(s))
        by_u = by_u - np.einsum("mij,cmi->cj", gain, by_x)
        by_x = np.einsum("mij,cmi->cmj", to_x, by_x)
        return energy, np.concatenate([by_u @ to_u, by_x.reshape(len(s), -1)], axis=1)

    to_u = np.linalg.inv(np.linalg.cholesky(mode.outer)).T
    to_x = np.linalg.inv(np.linalg.cholesky(mode.inner)).swapaxes(1, 2)
    gain = np.linalg.solve(mode.inner, mode.mixed.swapaxes(1, 2))
    s = _hamiltonian(rng.standard_normal((CHAINS, r + m * q)), potential, steps, rng)
    u, x = place(s.reshape(-1, s.shape[-1]))
    common = form.centre + u @ form.shared.T  # (draws, p + 1)
    own = common[:, None] + x @ form.own.T
    sharpness, relative = own[..., :-1].mean(-1), common[:, :-1]
    relative = relative - relative.mean(axis=1, keepdims=True)
    # Of one person, what moves is all their own, and the same for the lapse rate where it is given.
    told = np.concatenate([sharpness, relative, *([own[..., -1]] if form.own[-1].any() else [])], 1)
    out = PeoplePosterior(
        names=result.names,
        sharpness=np.exp(sharpness),
        lapse=expit(own[..., -1]),
        relative=np.exp(relative),
        effective=effective_draws(told.reshape(steps, CHAINS, -1)),
    )
    warn_of_failure(out)
    return out


def _slopes(
    result: PeopleResult, u: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return −log posterior (c,) at u (c, r) and x (c, m, q), and its gradients by u and x."""
    answers, form = result.answers, result.form
    phi = (form.centre + u @ form.shared.T)[:, None] + x @ form.own.T
    person = answers.person
    with np.errstate(over="ignore", invalid="ignore"):
        each, rate = np.exp(phi[..., :-1]), expit(phi[..., -1])[:, person]
        z = (each[:, person] * answers.gap).sum(-1)
        loss, by_z, by_l = lapsing(z, answers.labels, rate)[:3] * answers.weights
        by_w = np.add.reduceat(by_z[..., None] * answers.gap, answers.start, axis=1)
        by_lapse = np.add.reduceat(by_l, answers.start, axis=1)
        slope = np.concatenate([by_w * each, by_lapse[..., None]], axis=-1)
        total = loss.sum(-1) + 0.5 * ((u**2).sum(-1) + (x**2).sum((-2, -1)))
    total = np.where(np.isfinite(total), total, np.inf)
    return total, u + slope.sum(1) @ form.shared, x + slope @ form.own


def _hamiltonian(
    s: np.ndarray, potential: Potential, steps: int, rng: np.random.Generator
) -> np.ndarray:
    """Return the places (steps, c, d) of chains (c, d), a trajectory of a quarter period apart."""
    energy, force = potential(s)
    log_size, places = np.log(0.3), []
    for k in range(WARM_UP + steps):
        size = float(np.exp(log_size) * rng.uniform(0.6, 1.2))
        momentum = rng.standard_normal(s.shape)
        before = energy + 0.5 * (momentum**2).sum(-1)
        at, push, now = s, force, energy
        for _ in range(min(int(np.ceil(QUARTER_PERIOD / size)), LEAPFROGS)):
            momentum = momentum - size / 2 * push
            at = at + size * momentum
            now, push = potential(at)
            momentum = momentum - size / 2 * push
        with np.errstate(invalid="ignore"):
            change = before - now - 0.5 * (momentum**2).sum(-1)
        change = np.where(np.isnan(change), -np.inf, change)
        chance = np.exp(np.minimum(change, 0.0))
        taken = rng.uniform(size=len(s)) < chance
        s, force = (np.where(taken[:, None], *pair) for pair in ((at, s), (push, force)))
        energy = np.where(taken, now, energy)
        if k < WARM_UP:
            log_size = min(log_size + 0.5 * (chance.mean() - WANTED_ACCEPTANCE), np.log(0.8))
        else:
            places.append(s)
    return np.stack(places)
