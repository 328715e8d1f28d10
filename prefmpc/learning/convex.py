"""Learning a quadratic σ is a convex problem: one minimum, Newton's method, a certificate.

σ is linear in (Q, R), so the negative log-likelihood of the answers is convex in them; a Wishart
prior makes the problem strictly convex, and keeps Q and R positive definite. Nothing is random:
the same data and prior give the same answer.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jax.typing import ArrayLike
from scipy.special import expit, ndtri

from prefmpc._checks import (
    instance,
    nonnegative,
    positive_int,
    require_x64,
    share,
)
from prefmpc._results import Result, warn_of_failure
from prefmpc._sharding import check_mesh
from prefmpc.learning._newton import Minimum, solve
from prefmpc.learning._problem import Problem, answer_weights, build, build_answers, check
from prefmpc.learning.losses import padded_size
from prefmpc.learning.priors import Structure, WishartPrior, paired
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.answers import Answers, check_data
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.trajectories import Trajectory

Status = Literal["converged", "max_iterations", "not_finite"]


class Interval(NamedTuple):
    """A posterior mean and the bounds of an interval about it, all of the same shape."""

    mean: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class MapResult(Result):
    """The most probable (Q, R) after the answers.

    Attributes
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        As the solver left them; `model` refuses to hand out an unfinished one.
    status : "converged", "max_iterations" or "not_finite".
    objective : float
        −log posterior up to a constant: Σ cross-entropy + the prior's term.
    log_likelihood : float
        −Σ cross-entropy, in nats.
    decrement : float
        λ²/2, half the squared Newton decrement at the last but one point: to second order its
        distance from the minimum. Another full step followed.
    iterations : int
    seconds : float
        Wall time, compilation included if there was one; of the whole call in `fit_maps`.
    comparisons, prior, structure, outputs
        What was asked.
    """

    NAME = "fit_map"

    Q: np.ndarray
    R: np.ndarray
    status: Status
    objective: float
    log_likelihood: float
    decrement: float
    iterations: int
    seconds: float
    comparisons: Comparisons | Answers = dataclasses.field(repr=False)
    prior: WishartPrior = dataclasses.field(repr=False)
    structure: Structure = dataclasses.field(repr=False)
    outputs: np.ndarray | None = dataclasses.field(repr=False)
    problem: Problem = dataclasses.field(repr=False)
    minimum: Minimum = dataclasses.field(repr=False)

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return f"{self.status} after {self.iterations} Newton steps, decrement {self.decrement:.1e}"

    @property
    def model(self) -> QuadraticCost:
        """The learned σ. Raises a `FitError` unless the minimum was reached."""
        self.check()
        return QuadraticCost(self.Q, self.R)

    @property
    def sharpness(self) -> float:
        """How sharp the answers are: the mean weight, in units of the prior's mode W₀.

        tr(W₀⁻¹W) / d with the d × d matrix W = blkdiag(Q, R). σ is in log-odds, so that somebody
        who answers half as surely has half the weights, and wants the same controller.
        """
        self.check()
        W = self.problem.entries.matrix(self.minimum.w)
        return float(np.trace(np.linalg.solve(self.problem.mode, W))) / len(W)

    @property
    def thresholds(self) -> dict[str, np.ndarray]:
        """What was learned beside σ from `Answers`, by name: see `fit_map`."""
        self.check()
        return self.problem.thresholds.named(self.minimum.thresholds)

    @property
    def normalised(self) -> QuadraticCost:
        """σ / `sharpness`: what is wanted, whatever the noise, so that people can be compared."""
        sharpness = self.sharpness
        return QuadraticCost(self.Q / sharpness, self.R / sharpness)

    @property
    def std_Q(self) -> np.ndarray:
        """Standard deviations (nx, nx) of the entries of Q by Laplace's method.

        From the inverse Hessian at the minimum: good with many answers. With few, the posterior
        is not symmetric about its mode; see `posterior`.
        """
        return self._std()[0]

    @property
    def std_R(self) -> np.ndarray:
        """Standard deviations (nu, nu) of the entries of R, likewise."""
        return self._std()[1]

    def _std(self) -> tuple[np.ndarray, np.ndarray]:
        self.check()
        covariance = self.minimum.covariance
        slopes = self.problem.costs(np.eye(self.minimum.w.size))  # ∂Q/∂w (p, nx, nx), ∂R/∂w
        Q, R = (np.sqrt(np.einsum("aij,ab,bij->ij", S, covariance, S)) for S in slopes)
        return Q, R

    def gaps(self, first: Any, second: Any) -> np.ndarray:
        """Return the derivatives (p, ...) of σ(second) − σ(first) with respect to the weights."""
        instance("first", first, Trajectory)
        instance("second", second, Trajectory)
        shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(side)] for side in (first, second)]
        channels = [len(self.Q), len(self.R)]
        if shapes[0] != shapes[1] or [first.x.shape[-1], first.u.shape[-1]] != channels:
            raise ValueError(
                f"first and second must have equal shapes with {channels[0]} states and "
                f"{channels[1]} inputs, got {shapes[0]} and {shapes[1]}"
            )
        return self.problem.moments(second) - self.problem.moments(first)

    def probability(self, first: Trajectory, second: Trajectory, level: float = 0.9) -> Interval:
        """Return P(first is preferred), and how sure we are of it, by Laplace's method.

        The log-odds of a pair are linear in the weights, and so Gaussian if these are. Without
        sampling, hence quick; `Posterior.probability` is better where answers are few.

        Parameters
        ----------
        first, second : Trajectory
            With equal batch shapes (...).
        level : float
            The share of the posterior between the bounds, with equal shares outside.

        Returns
        -------
        Interval
            Three arrays (...). The mean of a logistic function of a Gaussian is MacKay's.
        """
        self.check()
        reach = ndtri((1 + share("level", level)) / 2)
        gap = self.gaps(first, second)
        z = np.tensordot(self.minimum.w, gap, 1)
        variance = (gap * np.tensordot(self.minimum.covariance, gap, 1)).sum(axis=0)
        std = np.sqrt(variance)
        odds = (z / np.sqrt(1 + np.pi * variance / 8), z - reach * std, z + reach * std)
        return Interval(*(expit(part) for part in odds))

    def nearest_diagonal(self) -> MapResult:
        """Return the best diagonal (Q, R) for the same answers: a few numbers that can be read.

        What that costs is the difference of the two `log_likelihood`. Of the prior, the diagonal
        is kept.
        """
        Q0, R0 = (np.diag(np.diag(mode)) for mode in (self.prior.Q, self.prior.R))
        prior = WishartPrior(Q0, R0, self.prior.strength)
        data, weights = self.comparisons, None
        if isinstance(data, Comparisons):
            weights = self.problem.weights[: len(data)]
        return fit_map(data, prior, structure="diagonal", outputs=self.outputs, weights=weights)


def fit_map(
    comparisons: Comparisons | Answers,
    prior: WishartPrior,
    *,
    structure: Structure = "full",
    outputs: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    max_iterations: int = 100,
    tol: float = 1e-8,
    mesh: Mesh | None = None,
) -> MapResult:
    """Return the maximum a posteriori weights of a quadratic σ: one start, no randomness.

    Minimises Σ_i cross-entropy(z_i, label_i) − log prior(Q, R) with the log-odds
    z_i = σ(second_i) − σ(first_i), eq. (4) of arXiv 2511.22502, over positive definite Q and R,
    by Newton's method with exact derivatives from the prior's mode.

    `Answers` of every kind are choices with utilities linear in (Q, R) and in a few thresholds:
    convex in all of them, and learned together (`prefmpc.learning.choices`). "tie" is Davidson's
    log ν, "acceptable" or "5 stars" the σ between neighbours, "5 grades" the inner grades' excess.

    Parameters
    ----------
    comparisons : Comparisons or Answers
        Labels may be soft (0.5: cannot say); the noise of the answers is in the scale of Q and R.
    prior : WishartPrior
    structure : {"full", "diagonal"} or (mask of Q, mask of R)
        Which entries may differ from zero. The prior's mode must have the same zeros. See
        `blocks` for block-diagonal ones.
    outputs : array (ny, nx), optional
        C of y = C x: σ then sees outputs and inputs only. The prior weighs y, and the result is
        Q = CᵀQ_yC.
    weights : array (n,), optional
        As how many answers each one counts, at least 0; see `forgetting`. The problem stays convex.
    tol : float
        Stop when half the squared Newton decrement is below ``tol`` times 1 + abs(objective).
    mesh : jax.sharding.Mesh, optional
        Devices to share Comparisons among; all processes that own some make the same call.

    Returns
    -------
    MapResult

    Raises
    ------
    ValueError
        If an argument is out of range, or prior and trajectories do not fit each other.
    """
    check_data("comparisons", comparisons)
    instance("prior", prior, WishartPrior)
    if mesh is not None:
        mesh = check_mesh(mesh)
        instance("comparisons, to be shared among devices,", comparisons, Comparisons)
    if weights is not None:
        instance("comparisons, to be weighed,", comparisons, Comparisons)
    counts = answer_weights(weights, len(comparisons))
    options = structure, outputs, max_iterations, tol, mesh, counts
    result = _solved([comparisons], [prior], *options)[0]
    warn_of_failure(result)
    return result


def fit_maps(
    comparisons: Comparisons | Sequence[Comparisons],
    priors: WishartPrior | Sequence[WishartPrior],
    *,
    structure: Structure = "full",
    outputs: ArrayLike | None = None,
    max_iterations: int = 100,
    tol: float = 1e-8,
) -> list[MapResult]:
    """Solve many problems of `fit_map` in one compiled call: many data sets, or many priors.

    Parameters
    ----------
    comparisons : Comparisons, or a sequence of them
    priors : WishartPrior, or a sequence of them
        One of something goes with all of the other; two sequences go pair by pair.

    Returns
    -------
    list of MapResult
    """
    data_sets, beliefs = paired(comparisons, priors)
    results = _solved(data_sets, beliefs, structure, outputs, max_iterations, tol)
    if bad := [result for result in results if not result.success]:
        many = f" ({len(bad)} of {len(results)} problems)" if len(results) > 1 else ""
        warn_of_failure(bad[0], many)
    return results


def _solved(
    data_sets: Sequence[Any],
    priors: list[WishartPrior],
    structure: Structure,
    outputs: ArrayLike | None,
    max_iterations: int,
    tol: float,
    mesh: Mesh | None = None,
    weights: np.ndarray | None = None,
) -> list[MapResult]:
    require_x64()
    began = time.perf_counter()
    limit, tol = positive_int("max_iterations", max_iterations), nonnegative("tol", tol)
    C, entries = check(data_sets, priors, structure, outputs)
    parts = 1 if mesh is None else mesh.size
    size = parts * padded_size(max(-(-len(data) // parts) for data in data_sets))
    if isinstance(data_sets[0], Answers):
        problems = [build_answers(data_sets[0], priors[0], entries, C)]
    elif all(data is data_sets[0] for data in data_sets):
        problems = build(data_sets[0], priors, entries, C, size, weights)
    else:
        pairs = zip(data_sets, priors, strict=True)
        problems = [build(data, [prior], entries, C, size)[0] for data, prior in pairs]
    results = []
    minima = solve(problems, tol, limit, mesh)
    for problem, minimum, data, prior in zip(problems, minima, data_sets, priors, strict=True):
        Q, R = problem.costs(minimum.w)
        finite = all(np.isfinite(part).all() for part in (Q, R, minimum.objective))
        reached: Status = "converged" if minimum.converged(tol) else "max_iterations"
        results.append(
            MapResult(
                Q=Q,
                R=R,
                status=reached if finite else "not_finite",
                # log det in the user's units
                objective=float(minimum.objective) + prior.strength * problem.log_unit,
                log_likelihood=float(minimum.log_likelihood),
                decrement=float(minimum.decrement),
                iterations=int(minimum.steps),
                seconds=time.perf_counter() - began,
                comparisons=data,
                prior=prior,
                structure=structure,
                outputs=C,
                problem=problem,
                minimum=minimum,
            )
        )
    return results
