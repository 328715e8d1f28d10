"""How good is a model, and how good is the controller that it makes?"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import function, instance, nonnegative, positive_int, to_numpy
from prefmpc.models import QuadraticCost
from prefmpc.mpc.batched import broadcast_states, condense, each_cost, solve_box
from prefmpc.mpc.solution import check_problem, check_state
from prefmpc.preferences import Comparisons
from prefmpc.systems import LinearSystem
from prefmpc.trajectories import Trajectory, from_flat


def accuracy(model: Callable[[Trajectory], Any], comparisons: Comparisons) -> float:
    """Return the share of comparisons in [0, 1] whose answer the model gives.

    Implements the accuracy of section III-A of arXiv 2511.22502: π prefers the first where
    σ(first) ≤ σ(second), eq. (3). A soft label p counts as the probability that a person who
    prefers the first with probability p answers like the model.

    ``model`` is any function that maps a batch of trajectories (n_t,) to costs (n_t,).
    """
    function("model", model)
    instance("comparisons", comparisons, Comparisons)
    costs = np.asarray(model(comparisons.trajectories))
    count = len(comparisons.trajectories)
    if costs.shape != (count,):
        raise ValueError(f"model must return one cost a trajectory ({count},), got {costs.shape}")
    if not np.isfinite(costs).all():
        raise ValueError("model must return finite costs, got NaN or infinite ones")
    first_wins = costs[comparisons.first] <= costs[comparisons.second]
    return float(np.where(first_wins, comparisons.labels, 1 - comparisons.labels).mean())


def simulate(
    system: LinearSystem, controller: Callable[[Any], ArrayLike], x0: ArrayLike, steps: int
) -> Trajectory:
    """Run plant and controller in closed loop: u(t) = controller(x(t)).

    Parameters
    ----------
    controller : callable
        x (nx,) → u (nu,): an MPC object, or any Python function.
    x0 : array (nx,) or (m, nx)
        Batches run one after another; `closed_loops` is the fast way for many MPC loops.
    steps : int

    Returns
    -------
    Trajectory
        x (..., steps + 1, nx), u (..., steps, nu), y (..., steps, ny).

    Raises
    ------
    ValueError
        If x0 or an input that the controller returns is not finite or has a wrong shape.
    MPCError
        If an MPC controller finds no solution on the way.
    """
    instance("system", system, LinearSystem)
    function("controller", controller)
    x0 = np.asarray(check_state(x0, system.nx))
    steps = positive_int("steps", steps)
    starts = x0.reshape(-1, system.nx)
    x = np.empty((len(starts), steps + 1, system.nx))
    u = np.empty((len(starts), steps, system.nu))
    x[:, 0] = starts
    for i in range(len(starts)):
        for k in range(steps):
            action = np.asarray(controller(x[i, k]), dtype=np.float64)
            if action.shape != (system.nu,) or not np.isfinite(action).all():
                raise ValueError(
                    f"controller must return a finite input of shape ({system.nu},), "
                    f"got {action} at step {k}"
                )
            u[i, k] = action
            x[i, k + 1] = system.A @ x[i, k] + system.B @ action
    return from_flat(system, x, u, x0.shape[:-1])


@dataclasses.dataclass(frozen=True)
class ClosedLoops:
    """Simulated closed loops of c controllers from m initial states each.

    Attributes
    ----------
    trajectories : Trajectory
        Leading shape (c, m), without c for a single cost. NaN from a failed solve onwards.
    solved : bool array, same leading shape
        Whether every solve along the way succeeded.
    iterations : int array, same leading shape
        Solver iterations, summed over the steps.
    seconds : float
    """

    trajectories: Trajectory
    solved: np.ndarray
    iterations: np.ndarray
    seconds: float


def closed_loops(
    system: LinearSystem,
    costs: QuadraticCost,
    x0: ArrayLike,
    *,
    horizon: int,
    steps: int,
    tol: float = 1e-8,
) -> ClosedLoops:
    """Simulate MPC closed loops for many costs and many initial states in one compiled call.

    Parameters
    ----------
    costs : QuadraticCost
        One σ, or a stack of c of them.
    x0 : array (m, nx) or (c, m, nx)
        The same m initial states for every cost, or m of its own for each.
    horizon, steps : int
        N of the controllers, and the length of the simulations.
    tol : float
        See `BatchedMPC`.

    Returns
    -------
    ClosedLoops
    """
    began = time.perf_counter()
    check_problem(system, costs)
    horizon, steps = positive_int("horizon", horizon), positive_int("steps", steps)
    stack, stacked = each_cost(costs)
    states = check_state(x0, system.nx)
    starts, lead = broadcast_states(states, len(stack.theta_Q), stacked, system.nx)
    x, u, count = _loop_many(system, stack, horizon, starts, steps, nonnegative("tol", tol))
    x, u, count = to_numpy((x, u, count))
    flat = (-1, steps + 1, system.nx), (-1, steps, system.nu)
    trajectories = from_flat(system, x.reshape(flat[0]), u.reshape(flat[1]), lead)
    return ClosedLoops(
        trajectories=trajectories,
        solved=np.isfinite(trajectories.u).all(axis=(-2, -1)),
        iterations=count.reshape(lead),
        seconds=time.perf_counter() - began,
    )


@jax.jit(static_argnums=(2, 4))
def _loop_many(
    system: LinearSystem, costs: QuadraticCost, horizon: int, x0: Any, steps: int, tol: Any
) -> tuple[Any, ...]:
    def one(cost: QuadraticCost, starts: Any) -> tuple[Any, ...]:
        problem = condense(system, cost, horizon)

        def step(x: Any, _: None) -> tuple[Any, tuple[Any, Any, Any]]:
            U, done, _, count = solve_box(problem, x, tol)
            u = jnp.where(done[:, None], U[:, : system.nu], jnp.nan)
            x_next = x @ system.A.T + u @ system.B.T
            return x_next, (x_next, u, count)

        _, (x, u, count) = jax.lax.scan(step, starts, None, length=steps)
        x = jnp.concatenate([starts[None], x])
        return jnp.swapaxes(x, 0, 1), jnp.swapaxes(u, 0, 1), count.sum(0)

    return jax.vmap(one)(costs, x0)
