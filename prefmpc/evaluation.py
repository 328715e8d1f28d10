"""How good is a model, and how good is the controller that it makes?"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import function, instance, positive_int, real_array, share, single
from prefmpc.mpc.solution import Controller, check_state
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import Preference, asked, evaluated, failed_loses
from prefmpc.preferences.trajectories import Trajectory, check_finite, from_flat
from prefmpc.systems.linear import System

__all__ = ["WinRate", "accuracy", "regret", "simulate", "win_rate"]

SAME_START = 1e-9
"""So far apart two states may be to count as the same, relative to the largest on the way."""


def accuracy(model: Callable[[Trajectory], Any], comparisons: Comparisons) -> float:
    """Return the share of comparisons in [0, 1] whose answer the model gives.

    Implements the accuracy of section III-A of arXiv 2511.22502: π prefers the first where
    σ(first) ≤ σ(second), eq. (3). A soft label p counts as the probability that a person who
    prefers the first with probability p answers like the model.

    ``model`` is any function that maps a batch of trajectories (n_t,) to costs (n_t,).
    """
    function("model", model, 1)
    instance("comparisons", comparisons, Comparisons)
    costs = _finite("model", model, comparisons.trajectories)
    first_wins = costs[comparisons.first] <= costs[comparisons.second]
    return float(np.where(first_wins, comparisons.labels, 1 - comparisons.labels).mean())


def regret(
    cost: Callable[[Trajectory], Any],
    trajectories: Trajectory,
    best: Trajectory | None = None,
) -> np.ndarray:
    """Return σ(T) − min σ over what is possible from the same x(0): what a controller gives away.

    Parameters
    ----------
    cost : function of a batch of trajectories to numbers
        The measure that counts: the person's own cost if it is known (never the learned one).
    trajectories : Trajectory
        Leading shape (..., m): closed loops of several controllers from the same m states.
    best : Trajectory, optional
        Leading shape (m,): the best that is possible from each state, for instance
        ``BatchedMPC(system, person, horizon=steps).solve(x0).trajectory``. Default: the best
        among ``trajectories``, over all leading axes but the last.

    Returns
    -------
    array (..., m)

    Raises
    ------
    ValueError
        If the trajectories do not start in the same states: costs from different x(0) do not
        compare. If one is not finite: a closed loop that failed has no cost.
    """
    function("cost", cost, 1)
    instance("trajectories", trajectories, Trajectory)
    values = _costs(cost, "trajectories", trajectories)
    if best is None:
        if len(trajectories.batch_shape) < 2:
            raise ValueError(
                "trajectories must have shape (controllers, states) to find the best among them, "
                f"got {trajectories.batch_shape}; or pass best"
            )
        _same_starts("trajectories", trajectories, trajectories[(0,) * (values.ndim - 1)])
        return values - values.min(axis=tuple(range(values.ndim - 1)))
    instance("best", best, Trajectory)
    _same_starts("best", best, trajectories)
    if best.batch_shape != trajectories.batch_shape[-1:]:
        raise ValueError(
            f"best must have shape {trajectories.batch_shape[-1:]}, got {best.batch_shape}"
        )
    return values - _costs(cost, "best", best)


@dataclasses.dataclass(frozen=True)
class WinRate:
    """Share of initial states from which A is preferred to B, with its confidence interval.

    Attributes
    ----------
    rate, low, high : float in [0, 1]
    count : int
        Number of initial states. The interval is about them: another draw of states, the same two
        controllers.
    """

    rate: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        return f"{100 * self.rate:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def win_rate(
    preference: Preference, first: Trajectory, second: Trajectory, *, confidence: float = 0.95
) -> WinRate:
    """Return how often Π prefers the closed loop of one controller to that of another.

    Both orders are asked, and no difference (or no answer) counts half, so that a controller wins
    against itself in half of the cases whatever Π says about equal ones. A closed loop that failed
    (with NaN) loses against one that did not, whatever Π says; two such count half. The interval is
    Wilson's.

    Parameters
    ----------
    first, second : Trajectory
        Leading shape (m,): closed loops of controllers A and B from the same m states.

    Raises
    ------
    ValueError
        If the trajectories do not start in the same states, or ``confidence`` is not in (0, 1).
    """
    function("preference", preference, 2)
    for name, value in {"first": first, "second": second}.items():
        instance(name, value, Trajectory)
        if len(value.batch_shape) != 1:
            raise ValueError(f"{name} must have shape (m,), got {value.batch_shape}")
    _same_starts("second", second, first)
    confidence, count = share("confidence", confidence), len(first)
    orders = (first, second), (second, first)
    answers = [failed_loses(asked("preference", preference, *pair), *pair) for pair in orders]
    wins, losses = np.nan_to_num(answers, nan=0.5)
    rate = float((wins + 1 - losses).mean() / 2)
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return WinRate(rate, float(max(centre - half, 0)), float(min(centre + half, 1)), count)


def _costs(cost: Callable[[Trajectory], Any], name: str, trajectories: Trajectory) -> np.ndarray:
    check_finite(name, trajectories, "closed loops that failed have no cost")
    return _finite("cost", cost, trajectories)


def _finite(name: str, cost: Callable[[Trajectory], Any], trajectories: Trajectory) -> np.ndarray:
    values = evaluated(name, cost, trajectories, "cost")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must return finite costs, got NaN or infinite ones")
    return values


def _same_starts(name: str, trajectory: Trajectory, other: Trajectory) -> None:
    a, b = np.asarray(trajectory.x[..., 0, :]), np.asarray(other.x[..., 0, :])
    fits = a.shape[-2:] == b.shape[-2:]
    if fits:
        # In each state's own unit. A loop that failed may have lost its start.
        all_states = np.abs(np.asarray(trajectory.x)).reshape(-1, a.shape[-1])
        size = np.max(all_states, axis=0, initial=0.0, where=np.isfinite(all_states))
        fits = not (np.abs(a - b) > SAME_START * size).any()
    if not fits:
        raise ValueError(
            f"{name} must start in the same states as what it is compared with: "
            "costs from different x(0) do not compare"
        )


def simulate(
    system: System, controller: Callable[[Any], ArrayLike], x0: ArrayLike, steps: int
) -> Trajectory:
    """Run plant and controller in closed loop: u(t) = controller(x(t)).

    Parameters
    ----------
    controller : callable
        x (nx,) → u (nu,): an MPC object, or any Python function. Input limits are its own affair:
        the plant gets what it returns.
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
        If x0, an input that the controller returns, or a state that the plant reaches is not
        finite, or has a wrong shape.
    MPCError
        If an MPC controller finds no solution on the way.
    """
    instance("system", system, System)
    single("system", system, "; closed_loops takes stacks")
    function("controller", controller, 1)
    x0 = np.asarray(check_state(x0, system.nx))
    steps = positive_int("steps", steps)
    starts = x0.reshape(-1, system.nx)
    x = np.empty((len(starts), steps + 1, system.nx))
    u = np.empty((len(starts), steps, system.nu))
    x[:, 0] = starts
    for i in range(len(starts)):
        if isinstance(controller, Controller):
            controller.reset()  # nothing is carried over from one loop to the next
        for k in range(steps):
            action = np.asarray(real_array("what controller returns", controller(x[i, k])))
            if action.shape != (system.nu,) or not np.isfinite(action).all():
                raise ValueError(
                    f"controller must return a finite input of shape ({system.nu},), "
                    f"got {action} at step {k}"
                )
            u[i, k] = action
            x[i, k + 1] = system.step(x[i, k], action)
            if not np.isfinite(x[i, k + 1]).all():
                raise ValueError(
                    f"system must return finite states, got {x[i, k + 1]} at step {k + 1} "
                    f"from x = {x[i, k]}, u = {action}"
                )
    return from_flat(system, x, u, x0.shape[:-1])
