"""MPC with input bounds for many states and many costs at once, as one compiled program.

With the states eliminated the problem is min ½ Uᵀ H U + (F x_0)ᵀ U over a box in U. Accelerated
projected gradient steps with restarts solve most of them in a handful of iterations; what they
leave over (badly conditioned weights) goes to a primal-dual active-set method, which is exact.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import nonnegative, positive_int
from prefmpc._pytree import bypass_init
from prefmpc.models import QuadraticCost
from prefmpc.mpc.solution import Controller, MPCSolution, check_problem, check_state
from prefmpc.systems import LinearSystem
from prefmpc.trajectories import Trajectory

GRADIENT_STEPS = 150
ACTIVE_SET_STEPS = 60
ROUNDING = 1e-14


class CondensedProblem(NamedTuple):
    """min ½ UᵀHU + (F x0)ᵀU over lower ≤ U ≤ upper, in coordinates where diag(H) = 1."""

    H: Any
    F: Any
    scale: Any
    inverse: Any
    largest: Any
    smallest: Any
    lower: Any
    upper: Any


def responses(system: LinearSystem, horizon: int) -> tuple[Any, Any]:
    """Return Φ (N, nx, nx) and Γ (N, nx, N·nu): x_k = Φ_k x_0 + Γ_k U for k = 0 … N−1."""
    A, B = jnp.asarray(system.A), jnp.asarray(system.B)
    _, Phi = jax.lax.scan(lambda P, _: (A @ P, P), jnp.eye(system.nx), None, length=horizon)
    k = np.arange(horizon)
    delay = k[:, None] - k - 1  # steps from u_j until x_k; negative: not yet
    blocks = jnp.where(delay[..., None, None] >= 0, (Phi @ B)[np.maximum(delay, 0)], 0.0)
    return Phi, blocks.swapaxes(1, 2).reshape(horizon, system.nx, horizon * system.nu)


def condense(system: LinearSystem, cost: QuadraticCost, horizon: int) -> CondensedProblem:
    """Eliminate the states of eq. (12) of arXiv 2511.22502: a problem in the inputs alone."""
    Phi, Gamma = responses(system, horizon)
    H = 2 * (
        jnp.einsum("kxi,xz,kzj->ij", Gamma, cost.Q, Gamma) + jnp.kron(jnp.eye(horizon), cost.R)
    )
    F = 2 * jnp.einsum("kxi,xz,kzj->ij", Gamma, cost.Q, Phi)
    scale = 1 / jnp.sqrt(jnp.diag(H))
    H = (H * scale).T * scale
    H = (H + H.T) / 2
    # The inverse comes from the same factorisation: two batched LAPACK calls that run at the
    # same time can wait for each other for ever in XLA's thread pool when it has two threads.
    values, vectors = jnp.linalg.eigh(H)
    return CondensedProblem(
        H=H,
        F=F * scale[:, None],
        scale=scale,
        inverse=(vectors / values) @ vectors.T,
        largest=values[-1],
        smallest=values[0],
        lower=jnp.tile(system.u_min, horizon) / scale,
        upper=jnp.tile(system.u_max, horizon) / scale,
    )


def _certified(problem: CondensedProblem, V: Any, g: Any, tol: Any) -> tuple[Any, Any, Any]:
    """Take one projected gradient step; return V⁺, a bound on its distance to V*, and "done".

    With V⁺ = clip(V − ∇/L), the residual of the optimality conditions at V⁺ has norm at most
    (L − μ)·‖V⁺ − V‖, and strong monotonicity turns that into ‖V⁺ − V*‖ ≤ (L − μ)/μ·‖V⁺ − V‖.
    Weights that hardly see an input make μ so small that rounding alone exceeds ``tol``: a step
    of rounding size is then as good as float64 can tell, and counts as done too.
    """
    L, mu = problem.largest, problem.smallest
    V_next = jnp.clip(V - (V @ problem.H + g) / L, problem.lower, problem.upper)
    step = jnp.linalg.norm(V_next - V, axis=-1)
    distance = (L - mu) / mu * step * jnp.max(problem.scale)
    size = jnp.linalg.norm(V, axis=-1) + jnp.linalg.norm(g, axis=-1) / L
    return V_next, distance, (distance <= tol) | (step <= ROUNDING * size)


def solve_box(problem: CondensedProblem, x0: Any, tol: Any) -> tuple[Any, Any, Any, Any]:
    """Solve for x0 (m, nx).

    Returns U (m, N·nu), whether it is solved (m,), the bound on its distance from the optimum
    (m,) and the iterations (m,).
    """
    g = x0 @ problem.F.T
    start = jnp.clip(-g @ problem.inverse, problem.lower, problem.upper)
    V, distance, done = _certified(problem, start, g, tol)
    count = jnp.zeros(len(x0), dtype=int)

    def unfinished(limit: int) -> Any:
        return lambda carry: (carry[0] < limit) & ~jnp.all(carry[3])

    def gradient(carry: Any) -> Any:
        k, V, distance, done, count, momentum, t = carry
        V_next, distance_next, done_next = _certified(problem, momentum, g, tol)
        t_next = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
        step = V_next - V
        # O'Donoghue & Candès: forget the momentum where it points uphill.
        uphill = jnp.sum((momentum - V_next) * step, axis=-1) > 0
        t_next = jnp.where(uphill, 1.0, t_next)
        momentum_next = V_next + jnp.where(uphill, 0.0, (t - 1) / t_next)[:, None] * step
        return (
            k + 1,
            jnp.where(done[:, None], V, V_next),
            jnp.where(done, distance, distance_next),
            done | done_next,
            count + ~done,
            jnp.where(done[:, None], momentum, momentum_next),
            jnp.where(done, t, t_next),
        )

    _, V, distance, done, count, _, _ = jax.lax.while_loop(
        unfinished(GRADIENT_STEPS), gradient, (0, V, distance, done, count, V, jnp.ones(len(x0)))
    )

    eye = jnp.eye(problem.H.shape[0])

    def active_set(carry: Any) -> Any:
        k, V, distance, done, count = carry
        slope = V @ problem.H + g
        low = V - slope <= problem.lower
        high = V - slope >= problem.upper
        free = ~(low | high)
        bound = jnp.where(low, problem.lower, jnp.where(high, problem.upper, 0.0))
        # Rows of fixed inputs read V_i = bound_i; their columns move to the right-hand side.
        matrix = jnp.where(free[:, :, None] & free[:, None, :], problem.H, eye)
        target = jnp.where(free, -g - bound @ problem.H, bound)
        newton = jnp.linalg.solve(matrix, target[..., None])[..., 0]
        inside = jnp.clip(newton, problem.lower, problem.upper)
        _, distance_next, done_next = _certified(problem, inside, g, tol)
        return (
            k + 1,
            jnp.where(done[:, None], V, newton),
            jnp.where(done, distance, distance_next),
            done | done_next,
            count + ~done,
        )

    # The iterates may leave the box on the way; the certificate is about the clipped ones.
    _, V, distance, done, count = jax.lax.while_loop(
        unfinished(ACTIVE_SET_STEPS), active_set, (0, V, distance, done, count)
    )
    V = jnp.clip(V, problem.lower, problem.upper)
    return V * problem.scale, done, distance, count


def each_cost(cost: QuadraticCost) -> tuple[QuadraticCost, bool]:
    """Give the cost a leading axis; say whether it had one."""
    stacked = bool(cost.batch_shape)
    if len(cost.batch_shape) > 1:
        raise ValueError(
            f"cost must be one model or a stack along one axis, got shape {cost.batch_shape}"
        )
    return (cost if stacked else jax.tree.map(lambda leaf: leaf[None], cost)), stacked


def broadcast_states(x0: Any, costs: int, stacked: bool, nx: int) -> tuple[Any, tuple[int, ...]]:
    """Return x0 as (costs, m, nx) and the shape of the answer's leading axes."""
    if stacked and x0.ndim == 3:
        if x0.shape[0] != costs:
            raise ValueError(f"x0 must have {costs} rows of states, one a cost, got {x0.shape}")
        return x0, (costs, x0.shape[1])
    if x0.ndim > 2:
        raise ValueError(f"x0 must have shape ({nx},) or (m, {nx}), got {x0.shape}")
    lead = (costs, *x0.shape[:-1]) if stacked else x0.shape[:-1]
    flat = np.asarray(x0).reshape(-1, nx)
    return np.broadcast_to(flat, (costs, *flat.shape)), lead


@jax.jit(static_argnums=2)
def _solve_many(
    system: LinearSystem, costs: QuadraticCost, horizon: int, x0: Any, tol: Any
) -> tuple[Any, ...]:
    def one(cost: QuadraticCost, starts: Any) -> tuple[Any, ...]:
        problem = condense(system, cost, horizon)
        U, done, distance, count = solve_box(problem, starts, tol)
        return U.reshape(-1, horizon, system.nu), done, distance, count

    return jax.vmap(one)(costs, x0)


class BatchedMPC(Controller):
    """The MPC of eq. (12) of arXiv 2511.22502 for whole batches of states, and of costs.

    Solves the same problem as `LinearMPC` without ``constraints`` and ``terminal``: only input
    bounds. Every answer carries a proven bound on its distance from the optimum.

    Parameters
    ----------
    system : LinearSystem
    cost : QuadraticCost
        One σ, or a stack of c of them.
    horizon : int
        N ≥ 1.
    tol : float
        Largest proven distance ‖U − U*‖₂, in the unit of the input, that counts as solved. An
        answer that satisfies the optimality conditions to rounding counts as solved as well.

    Raises
    ------
    ValueError
        If the horizon is below 1, or a dimension does not fit.
    """

    def __init__(
        self, system: LinearSystem, cost: QuadraticCost, horizon: int, *, tol: float = 1e-8
    ) -> None:
        check_problem(system, cost)
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        self.tol = nonnegative("tol", tol)
        self._costs, self._stacked = each_cost(cost)

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for x0 (nx,) or (m, nx); with a stack of c costs also (c, m, nx).

        The leading shape of everything in the answer is (c, m), without c for a single cost and
        without m for a single state. Raises a ValueError on a bad x0.
        """
        began = time.perf_counter()
        nx, nu = self.system.nx, self.system.nu
        states = check_state(x0, nx)
        starts, lead = broadcast_states(states, len(self._costs.theta_Q), self._stacked, nx)
        out = _solve_many(self.system, self._costs, self.horizon, starts, self.tol)
        U, solved, distance, count = (np.array(part) for part in out)
        U[~solved] = np.nan
        U = U.reshape(*lead, self.horizon, nu)
        start = np.asarray(starts).reshape(*lead, nx)
        x = [start]
        for k in range(self.horizon):
            x.append(x[-1] @ self.system.A.T + U[..., k, :] @ self.system.B.T)
        X = np.stack(x, axis=-2)
        trajectory = bypass_init(Trajectory, x=X, u=U, y=X[..., :-1, :] @ self.system.C.T)
        cost = _cost_along(self._costs, trajectory, self._stacked)
        status = np.where(solved, "solved", "max_iterations").reshape(lead)
        failed = int((~solved).sum())
        message = (
            "optimal"
            if not failed
            else f"{failed} of {solved.size} problems not solved to {self.tol:g} "
            f"(worst {distance.max():.2g})"
        )
        return MPCSolution(
            u=U[..., 0, :],
            trajectory=trajectory,
            cost=cost,
            status=status if lead else str(status),
            message=message,
            iterations=count.reshape(lead),
            residual=distance.reshape(lead),
            seconds=time.perf_counter() - began,
        )


def _cost_along(costs: QuadraticCost, trajectory: Trajectory, stacked: bool) -> np.ndarray:
    if not stacked:
        return np.asarray(costs[0](trajectory))
    return np.asarray(jax.vmap(lambda cost, T: cost(T))(costs, trajectory))
