"""The paper's own objective to its global minimum: it is a convex problem in (Q, R)."""

from __future__ import annotations

import dataclasses
import time
import warnings
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from prefmpc._checks import choice, instance, positive, require_x64, to_numpy
from prefmpc._results import Result, warn_of_failure
from prefmpc.learning._newton import backtrack
from prefmpc.learning._problem import Entries, data_derivatives, loss
from prefmpc.learning.losses import PairData, padded_size, pair_data
from prefmpc.models.quadratic import DIAGONAL_MIN, QuadraticCost, _semidefinite_factor
from prefmpc.preferences.comparisons import Comparisons

GAP = 1e-8
"""Wanted distance from the minimum, relative to the objective."""

ALMOST = 1e-6
"""The same for Clarabel, which stops where it gets no further."""

# Clarabel calls a point "almost solved" when it meets the reduced tolerances and gets no further.
TOLERANCES = {
    **{"tol_gap_rel": 1e-8, "tol_gap_abs": 1e-8, "tol_feas": 1e-8},
    **{"reduced_tol_gap_rel": 1e-7, "reduced_tol_gap_abs": 1e-7, "reduced_tol_feas": 1e-7},
}


@dataclasses.dataclass(frozen=True, eq=False)
class GlobalResult(Result):
    """The global minimum of eq. (6) over (Q, R).

    Attributes
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
    objective : float
        Mean cross-entropy + l2·(tr Q + tr R).
    gap : float
        The objective is at most so much above its minimum.
    status : str
        "converged", "max_iterations", "not_finite", "inaccurate" (Clarabel's gap is too large), or
        what Clarabel said.
    iterations : int
    seconds : float
        Wall time, compilation included if there was one.
    """

    NAME = "fit_global"

    Q: np.ndarray
    R: np.ndarray
    objective: float
    gap: float
    status: str
    iterations: int
    seconds: float

    @property
    def message(self) -> str:
        """One sentence on how it went."""
        return f"{self.status} after {self.iterations} steps, gap {self.gap:.1e}"

    @property
    def model(self) -> QuadraticCost:
        """The learned σ. Raises a `FitError` unless the minimum was reached."""
        self.check()
        return QuadraticCost(self.Q, self.R)


def fit_global(
    comparisons: Comparisons,
    *,
    l2: float = 1e-6,
    solver: Literal["barrier", "clarabel"] = "barrier",
) -> GlobalResult:
    """Minimise the objective of `fit` over (Q, R) instead of θ: there it has one minimum.

    Implements eq. (6) of arXiv 2511.22502 with σ of eq. (11) and the paper's bounds on θ, as the
    convex problem that it is: ``l2``·‖θ‖² = ``l2``·(tr Q + tr R), and L_kk², a Schur complement,
    is a concave function of the matrix, so that L_kk ≥ c bounds a convex set. For teaching, and
    as an oracle of `fit`; to learn from few answers a prior is worth more, see `fit_map`.

    Parameters
    ----------
    comparisons : Comparisons
    l2 : float
        ρ of eq. (6), positive: without it separable answers have no minimum.
    solver : {"barrier", "clarabel"}
        Newton's method with a logarithmic barrier for the bounds; or Clarabel through cvxpy, with
        the bounds as linear matrix inequalities, which may give up on many separable answers.

    Returns
    -------
    GlobalResult

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    require_x64()
    began = time.perf_counter()
    instance("comparisons", comparisons, Comparisons)
    l2 = positive("l2", l2)
    choice("solver", solver, ("barrier", "clarabel"))
    nx, nu = comparisons.trajectories.x.shape[-1], comparisons.trajectories.u.shape[-1]
    like = QuadraticCost(np.eye(nx), np.eye(nu))
    if solver == "barrier":
        data = pair_data(like, comparisons, padded_size(len(comparisons)))
        W, value, gap, status, steps = _barrier(like, data, l2)
    else:
        data = pair_data(like, comparisons)
        # Once to learn the size of the weights, which spans decades, and once in their units.
        W, value, gap, status, steps = _clarabel(like, data, l2, np.ones(nx + nu), 1.0)
        if np.isfinite(W).all() and value > 0:
            unit = np.sqrt(np.maximum(np.diag(W), DIAGONAL_MIN**2))
            W, value, gap, status, more = _clarabel(like, data, l2, unit, value)
            steps += more
    result = GlobalResult(
        Q=W[:nx, :nx],
        R=W[nx:, nx:],
        objective=value,
        gap=gap,
        status=status,
        iterations=steps,
        seconds=time.perf_counter() - began,
    )
    warn_of_failure(result)
    return result


def _packed_places(nx: int, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the entries of `QuadraticCost.features` in blkdiag(Q, R)."""
    (i, j), (k, m) = np.tril_indices(nx), np.tril_indices(nu)
    return np.concatenate([i, k + nx]), np.concatenate([j, m + nx])


def _lowest(like: QuadraticCost) -> np.ndarray:
    """Return the bounds c (nx + nu,) on the diagonals of the two factors."""
    low, _ = like.bounds()
    parts = [(low.theta_Q, len(like.Q)), (low.theta_R, len(like.R))]
    return np.concatenate([theta[np.cumsum(np.arange(1, n + 1)) - 1] for theta, n in parts])


def _barrier(
    like: QuadraticCost, data: PairData, l2: float
) -> tuple[np.ndarray, float, float, str, int]:
    rows, columns = _packed_places(len(like.Q), len(like.R))
    entries, lowest = Entries.of(rows, columns), _lowest(like)
    scaled = data.features.T, data.labels, data.weights / data.weights.sum()
    w, value, gap, steps = to_numpy(_follow(*scaled, entries, lowest, l2))
    status = "converged" if gap <= GAP * value else "max_iterations"
    if not (np.isfinite(w).all() and np.isfinite(value)):
        status = "not_finite"
    return np.asarray(entries.matrix(w)), float(value), float(gap), status, int(steps)


@jax.jit
def _follow(
    gap: Any, labels: Any, weights: Any, entries: Entries, lowest: Any, l2: Any
) -> tuple[Any, Any, Any, Any]:
    """Follow the central path; return w (p,), the objective, the certified gap and the steps."""
    on_diagonal = jnp.where(entries.rows == entries.columns, 1.0, 0.0)
    m = lowest.size

    def objective(w: Any) -> Any:
        return loss(w @ gap, labels, weights) + l2 * (on_diagonal @ w)

    def barrier(w: Any) -> Any:
        slack = jnp.diag(jnp.linalg.cholesky(entries.matrix(w))) ** 2 - lowest**2
        return -jnp.sum(jnp.log(slack))  # NaN outside

    def direction(w: Any, mu: Any) -> tuple[Any, Any]:
        slope, curvature = data_derivatives(gap, w @ gap, labels, weights)
        gradient = slope + l2 * on_diagonal + mu * jax.grad(barrier)(w)
        hessian = curvature + mu * jax.hessian(barrier)(w)
        unit = 1 / jnp.sqrt(jnp.diag(hessian))
        step = -unit * jnp.linalg.solve(hessian * unit * unit[:, None], unit * gradient)
        return step, -gradient @ step

    def move(carry: Any) -> Any:
        w, mu, _, k, _ = carry
        step, squared = direction(w, mu)

        def value(t: Any) -> Any:
            return objective(w + t * step) + mu * barrier(w + t * step)

        now = value(0.0)
        slack = 1e-14 * jnp.abs(now)
        t, trial = backtrack(value, now, 0.1 * squared, slack, shrink=0.5, least=1e-10)
        w = jnp.where(trial <= now, w + t * step, w)
        # In the centre the gap is m·mu; the decrement, in units of mu, says how near it is.
        central = (squared <= 0.1 * mu) | ~(t > 1e-10)
        certified = jnp.where(squared <= 0.1 * mu, (m + 1) * mu, jnp.inf)
        done = certified <= GAP * objective(w)
        return w, jnp.where(central & ~done, mu / 8, mu), certified, k + 1, done

    def unfinished(carry: Any) -> Any:
        return ~carry[-1] & (carry[3] < 500)

    start = 4 * jnp.max(lowest) ** 2 * on_diagonal
    carry: Any = (start, jnp.asarray(1.0), jnp.inf, 0, False)
    w, _, certified, k, _ = jax.lax.while_loop(unfinished, move, carry)
    return w, objective(w), certified, k


def _clarabel(
    like: QuadraticCost, data: PairData, l2: float, unit: np.ndarray, size: float
) -> tuple[np.ndarray, float, float, str, int]:
    """Solve in W / unit / unit[:, None] for the objective / size; return all in the user's."""
    import cvxpy

    cp: Any = cvxpy
    nx = len(like.Q)
    lowest = _lowest(like)
    matrices, packed, bounds = [], [], []
    for part, low in ((unit[:nx], lowest[:nx]), (unit[nx:], lowest[nx:])):
        M = cp.Variable((len(part),) * 2, symmetric=True)
        matrices.append(M)
        packed.append(M[np.tril_indices(len(part))])
        for k, c in enumerate(low / part):
            corner = np.zeros((k + 1, k + 1))
            corner[k, k] = c**2
            bounds.append(M[: k + 1, : k + 1] - corner >> 0)
    rows, columns = _packed_places(nx, len(like.R))
    z = cp.Variable(len(data.labels))
    tie = (data.features * unit[rows] * unit[columns]) @ cp.hstack(packed) == z
    mean = cp.sum(cp.logistic(z) - cp.multiply(data.labels, z)) / len(data.labels)
    trace = unit**2 @ cp.hstack([cp.diag(M) for M in matrices])
    problem = cp.Problem(cp.Minimize((mean + l2 * trace) / size), [tie, *bounds])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the solver thinks of its answer is in the status
        try:
            problem.solve(solver=cp.CLARABEL, **TOLERANCES)
            status = str(problem.status)
        except cp.SolverError as error:
            status = str(error)
    W = np.full((len(unit),) * 2, np.nan)
    values = [M.value for M in matrices]
    if any(value is None for value in values):
        return W, np.nan, np.nan, status, 0
    W = np.zeros_like(W)
    W[:nx, :nx], W[nx:, nx:] = values
    steps = int(problem.solver_stats.num_iters)
    # Within the bounds it may be by a tolerance only; what is handed out is, and is judged.
    half = _semidefinite_factor(W * unit * unit[:, None])
    np.fill_diagonal(half, np.maximum(np.diag(half), lowest))
    W = half @ half.T
    # The multipliers say how each log-odds pulls at the objective.
    slope = np.zeros(len(data.labels)) if tie.dual_value is None else tie.dual_value * size
    value, gap = _certificate(W, slope * len(slope), data, l2, lowest, nx)
    if status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        status = "converged" if np.isfinite(value) and gap <= ALMOST * value else "inaccurate"
    return W, value, gap, status, steps


def _certificate(
    W: np.ndarray, slope: np.ndarray, data: PairData, l2: float, lowest: np.ndarray, nx: int
) -> tuple[float, float]:
    """Return the objective at W and a bound on its distance from the minimum, ∞ if there is none.

    Each loss lies above a line s·z − l*(s), l* its conjugate, so that the objective lies above
    tr(G V) − Σ l*(s)/n, where G holds l2·I and the data. With V = LLᵀ this is a sum over the
    columns of L, smallest where each diagonal entry is on its bound c_k: c_k² times a Schur
    complement of G. Any slopes s will do; they are shrunk until G has no negative eigenvalue.
    """
    d = len(W)
    rows, columns = _packed_places(nx, d - nx)
    z = data.features @ W[rows, columns]
    value = float(np.mean(np.logaddexp(0, z) - data.labels * z)) + l2 * float(np.trace(W))
    slope = np.clip(slope, -data.labels, 1 - data.labels)
    half = data.features.T @ slope / (2 * len(z))
    G = np.zeros((d, d))
    np.add.at(G, (rows, columns), half)
    np.add.at(G, (columns, rows), half)
    values = np.linalg.eigvalsh(G)
    rounding = 1e-14 * float(np.abs(values).max())
    shrink = (1 - 1e-9) * min(1.0, l2 / max(rounding - float(values[0]), l2))
    G = shrink * G + l2 * np.eye(d)
    p = data.labels + shrink * slope
    lowest_value = float(np.mean(scipy.special.entr(p) + scipy.special.entr(1 - p)))
    try:
        for part in (slice(0, nx), slice(nx, d)):
            # The Schur complements: the squared diagonal of a factor from the last entry up.
            root = np.linalg.cholesky(G[part, part][::-1, ::-1])
            lowest_value += float(np.sum((lowest[part] * np.diag(root)[::-1]) ** 2))
    except np.linalg.LinAlgError:  # rounding, beside l2
        return value, np.inf
    gap = value - lowest_value
    return value, max(gap, 0.0) if np.isfinite(gap) else np.inf
