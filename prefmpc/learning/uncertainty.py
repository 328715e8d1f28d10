"""How sure the answers leave us: samples of the posterior of (Q, R), all positive definite."""

from __future__ import annotations

import dataclasses
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from prefmpc._checks import instance, positive_int, share, to_numpy
from prefmpc._random import generator
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._chart import Chart, Laplace, laplaces, minus_log_posterior
from prefmpc.learning.convex import Interval, MapResult
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.trajectories import Trajectory

CHAINS = 32
WARM_UP = 100
WANTED_ACCEPTANCE = 0.8

QUARTER_PERIOD = np.pi / 2
"""Length of a trajectory: after it, a Gaussian's position is a fresh one."""

LEAPFROGS = 32
"""At most so many for one trajectory."""

SMALLEST_SHARE = 0.1
"""Of the draws, that must be worth independent ones."""


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior(Result):
    """Equally probable (Q, R) after the answers.

    Attributes
    ----------
    Q : array (m, nx, nx)
    R : array (m, nu, nu)
        Positive definite every one (with ``outputs``: Q is semidefinite).
    effective : float
        So many independent draws would tell the mean of each weight as precisely, or more; from
        the spread of the means of 64 half chains (Gelman and Rubin).
    acceptance : float
        Share of accepted proposals.
    seconds : float
        Wall time, compilation included if there was one.
    result : MapResult
        Whose posterior this is.
    """

    NAME = "posterior: the chains disagree"

    Q: np.ndarray
    R: np.ndarray
    effective: float
    acceptance: float
    seconds: float
    result: MapResult = dataclasses.field(repr=False)
    w: np.ndarray = dataclasses.field(repr=False)

    @property
    def success(self) -> bool:
        """Whether the chains agree: at least a tenth of the draws are worth independent ones."""
        numbers = np.isfinite(self.w).all() and np.isfinite(self.effective)
        return bool(numbers and self.effective >= SMALLEST_SHARE * len(self.Q))

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return (
            f"{len(self.Q)} draws worth {self.effective:.0f} independent ones, "
            f"{100 * self.acceptance:.0f} % of the proposals accepted"
        )

    @property
    def models(self) -> QuadraticCost:
        """The samples as a stack of models (m,)."""
        return QuadraticCost(self.Q, self.R)

    @property
    def std_Q(self) -> np.ndarray:
        """Standard deviations (nx, nx) of the entries of Q."""
        return self.Q.std(axis=0)

    @property
    def std_R(self) -> np.ndarray:
        """Standard deviations (nu, nu) of the entries of R."""
        return self.R.std(axis=0)

    def probability(self, first: Trajectory, second: Trajectory, level: float = 0.9) -> Interval:
        """Return P(first is preferred), and how sure we are of that: see `MapResult.probability`.

        The mean (...) is the probability to bet on.
        """
        tail = (1 - share("level", level)) / 2
        P = expit(np.tensordot(self.w, self.result.gaps(first, second), 1))
        return Interval(P.mean(axis=0), *np.quantile(P, [tail, 1 - tail], axis=0))


def posterior(result: MapResult, *, draws: int = 1024, key: Any = 0) -> Posterior:
    """Sample the posterior of (Q, R) around a MAP estimate.

    Hamiltonian Monte Carlo: 32 chains, started from and scaled by Laplace's Gaussian in
    coordinates in which every point is positive definite.

    Parameters
    ----------
    result : MapResult
        Its structure must be block-diagonal, or such that its Cholesky factor has the same zeros.
    draws : int
        Number of samples, rounded up to a multiple of 32, at least 256.
    key : JAX random key or int
        The same key gives the same samples. Another one shows the error of sampling.

    Raises
    ------
    FitError
        If ``result`` is not a minimum.
    ValueError
        If an argument is out of range.
    """
    instance("result", result, MapResult)
    if not isinstance(result.comparisons, Comparisons):
        raise ValueError("result must be learned from Comparisons, got one from Answers")
    began = time.perf_counter()
    steps = max(8, -(-positive_int("draws", draws) // CHAINS))
    result.check()
    problem = result.problem
    chart = Chart.of(problem)
    mode = laplaces([problem], [result.minimum.w])[0]
    rng = generator(key)
    p, total = mode.eta.size, WARM_UP + steps
    noise = Noise(
        rng.standard_normal((CHAINS, p)),
        rng.standard_normal((total, CHAINS, p)),
        np.log(rng.uniform(size=(total, CHAINS))),
        rng.uniform(0.6, 1.2, total),
        np.arange(total) < WARM_UP,
    )
    data = problem.gap, problem.labels, problem.weights, problem.strength
    w, acceptance = to_numpy(_sample(chart, mode, noise, *data))
    w, acceptance = w[WARM_UP:], acceptance[WARM_UP:]
    flat = w.reshape(-1, p)
    Q, R = problem.costs(flat)
    out = Posterior(
        Q=Q,
        R=R,
        effective=effective_draws(w),
        acceptance=float(acceptance.mean()),
        seconds=time.perf_counter() - began,
        result=result,
        w=flat,
    )
    warn_of_failure(out)
    return out


class Noise(NamedTuple):
    """All random numbers of `sample`, drawn beforehand."""

    start: Any
    """(chains, p)"""
    momentum: Any
    """(steps, chains, p)"""
    log_uniform: Any
    """(steps, chains)"""
    stretch: Any
    """(steps,): factors of the step size, so that no period is hit for ever."""
    adapting: Any
    """(steps,): whether the step size is still learned."""


def sample(
    chart: Chart,
    mode: Laplace,
    noise: Noise,
    gap: Any,
    labels: Any,
    weights: Any,
    strength: Any,
) -> tuple[Any, Any]:
    """Return w (steps, chains, p) and the acceptance probabilities (steps, chains)."""

    def potential(at: Any) -> Any:
        eta = mode.coordinates(at)
        return minus_log_posterior(chart, eta, gap, labels, weights, strength)

    energy_and_force = jax.vmap(jax.value_and_grad(potential))

    def step(carry: Any, draw: Any) -> Any:
        at, energy, slope, log_size = carry
        momentum, log_uniform, stretch, adapting = draw
        size = stretch * jnp.exp(log_size)

        def leap(_: Any, state: Any) -> Any:
            at, _, slope, momentum = state
            momentum = momentum - size / 2 * slope
            at = at + size * momentum
            energy, slope = energy_and_force(at)
            return at, energy, slope, momentum - size / 2 * slope

        count = jnp.clip(jnp.ceil(QUARTER_PERIOD / size), 1, LEAPFROGS).astype(int)
        new = jax.lax.fori_loop(0, count, leap, (at, energy, slope, momentum))
        kinetic = 0.5 * (jnp.sum(momentum**2, -1) - jnp.sum(new[3] ** 2, -1))
        log_ratio = energy - new[1] + kinetic
        log_ratio = jnp.where(jnp.isnan(log_ratio), -jnp.inf, log_ratio)
        accepted = log_uniform < log_ratio
        at = jnp.where(accepted[:, None], new[0], at)
        slope = jnp.where(accepted[:, None], new[2], slope)
        energy = jnp.where(accepted, new[1], energy)
        chance = jnp.exp(jnp.minimum(log_ratio, 0.0))
        change = 0.5 * (jnp.mean(chance) - WANTED_ACCEPTANCE)
        log_size = log_size + jnp.where(adapting, change, 0.0)
        return (at, energy, slope, log_size), (at, chance)

    energy, slope = energy_and_force(noise.start)
    carry = (noise.start, energy, slope, jnp.log(0.3))
    _, (at, chance) = jax.lax.scan(step, carry, tuple(noise[1:]))
    return jax.vmap(jax.vmap(chart.weights))(mode.coordinates(at)), chance


_sample = jax.jit(sample)


def effective_draws(draws: np.ndarray) -> float:
    """Return the smallest effective number of draws of all coordinates.

    Parameters
    ----------
    draws : array (steps, chains, p)
    """
    half = len(draws) // 2
    halves = np.concatenate([draws[:half], draws[half : 2 * half]], axis=1)
    means = halves.mean(axis=0).var(axis=0, ddof=1)
    total = halves.reshape(-1, draws.shape[-1]).var(axis=0)
    return float(min((halves.shape[1] * total / means).min(), halves.shape[0] * halves.shape[1]))
