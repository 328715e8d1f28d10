"""What every controller returns, and the error that a failed solve raises when called."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, instance, is_traced, shaped
from prefmpc._pytree import bypass_init
from prefmpc._results import Result
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem, System


class MPCError(RuntimeError):
    """An MPC problem had no usable solution; ``solution`` holds the details."""

    def __init__(self, solution: MPCSolution) -> None:
        super().__init__(f"MPC problem {solution.status}: {solution.message}")
        self.solution = solution


@dataclasses.dataclass(frozen=True)
class MPCSolution(Result):
    """Solution of one MPC problem, or of a batch of them.

    Attributes
    ----------
    u : array (..., nu)
        The input to apply now, u*_0; NaN unless the status is "solved".
    trajectory : Trajectory
        The predicted optimal trajectory T*, with ``horizon`` steps; NaN unless solved.
    cost : array (...)
        σ(T*), with the terminal cost if there is one; NaN unless solved.
    status : str, or array of str (...)
        "solved", "infeasible", "max_iterations" or "failed".
    message : str
        A sentence that says what the status means here.
    iterations : int, or int array (...)
    residual : float, or array (...)
        How far from optimal, computed from the plan whatever the solver says of itself: for
        `LinearMPC` and `ConvexMPC` the largest violation of the optimality conditions relative to
        the sizes of their terms (of "infeasible": what the proof lacks); for `BatchedMPC` the
        largest error of an input relative to the largest input of the plan, estimated; for
        `NonlinearMPC` the part of ∇σ that no active constraint balances, relative to the sizes
        of its terms.
    seconds : float
        Wall time of the solve.
    broken : array (N, m), optional
        By how much the plan breaks each soft row of the constraints at each stage, in the row's
        own unit, 0 where it keeps to it; None without soft rows.
    """

    GOOD = "solved"

    u: np.ndarray
    trajectory: Trajectory
    cost: Any
    status: Any
    message: str
    iterations: Any
    residual: Any
    seconds: float
    broken: np.ndarray | None = None

    def _error(self) -> MPCError:
        return MPCError(self)


class Controller:
    """What has ``solve(x0) -> MPCSolution`` can be called: u = controller(x)."""

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for the state x0."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget what earlier solves left behind, such as a plan to start from."""

    def applied(self, u: np.ndarray) -> None:
        """Take note of an input that the plant received."""

    def __call__(self, x0: ArrayLike) -> np.ndarray:
        """Return the inputs to apply, (..., nu). Raises an `MPCError` if any solve failed."""
        solution = self.solve(x0)
        solution.check()
        self.applied(solution.u)
        return solution.u


def check_problem(system: Any, cost: Any) -> None:
    """Raise a ValueError unless ``cost`` is a QuadraticCost that fits the LinearSystem."""
    instance("system", system, LinearSystem)
    instance("cost", cost, QuadraticCost)
    check_weights(cost, system.nx, system.nu)


def check_weights(cost: QuadraticCost, nx: int, nu: int) -> None:
    """Raise a ValueError unless the weights are finite, for nx states and nu inputs."""
    sizes = (cost.Q.shape[-1], cost.R.shape[-1])
    if sizes != (nx, nu):
        raise ValueError(
            f"cost must weigh {nx} states and {nu} inputs like the system, "
            f"got {sizes[0]} and {sizes[1]}"
        )
    weights = cost.theta_Q, cost.theta_R
    if not any(map(is_traced, weights)) and not all(np.isfinite(w).all() for w in weights):
        raise ValueError("cost must have finite weights, got NaN or infinite ones")


def check_dimension(name: str, dim: int, wanted: int) -> None:
    """Raise a ValueError unless the set ``name`` has the wanted dimension."""
    if dim != wanted:
        raise ValueError(f"{name} must have dimension {wanted}, got {dim}")


def infeasible_message(x0: np.ndarray, horizon: int) -> str:
    """Say what "infeasible" means for this problem."""
    return (
        f"no input sequence keeps x(0) = {np.array2string(x0, precision=4)} "
        f"within the constraints over {horizon} steps"
    )


def fixed_message(x0: np.ndarray) -> str:
    """Say what "infeasible" means where no input has a part in it."""
    return (
        f"no input sequence keeps x(0) = {np.array2string(x0, precision=4)} within the "
        "constraints: it breaks one that no input moves, at once or some steps later"
    )


def check_state(x0: ArrayLike, nx: int) -> Any:
    """Return x0 (..., nx) as a float64 array, or raise a ValueError that names it."""
    return shaped("x0", finite_array("x0", x0), (nx,), "the system's states")


def check_single_state(x0: ArrayLike, nx: int) -> np.ndarray:
    """Return one x0 (nx,) as a float64 array, or raise a ValueError that names it."""
    state = np.asarray(check_state(x0, nx))
    if state.ndim != 1:
        raise ValueError(f"x0 must have shape ({nx},), got {state.shape}")
    return state


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a solve ended, in the words of `MPCSolution`."""

    status: str
    message: str
    iterations: int = 0
    residual: float = 0.0


def explained(found: Any, x0: np.ndarray, horizon: int, *, limited: bool) -> Outcome:
    """Return how a convex solve ended, in words that fit the problem.

    ``found`` has the fields of an `Outcome`. ``limited`` says whether there is more to keep to
    than input bounds.
    """
    status, message = found.status, found.message
    if status == "infeasible" and limited:
        message = infeasible_message(x0, horizon)
    elif status == "infeasible":
        # A solver's proof rules out the plans of moderate size only.
        status = "failed"
        message = (
            "input bounds alone always leave a plan, but here every one leads so far out that "
            "float64 cannot tell the best"
        )
    return Outcome(status, message, found.iterations, found.residual)


def mpc_solution(
    system: System,
    horizon: int,
    outcome: Outcome,
    began: float,
    plan: tuple[np.ndarray, np.ndarray] | None = None,
    cost: float = np.nan,
) -> MPCSolution:
    """Return the answer of a controller: the plan (states, inputs) if it is solved, else NaN."""
    if plan is None or outcome.status != "solved":
        plan = np.full((horizon + 1, system.nx), np.nan), np.full((horizon, system.nu), np.nan)
        cost = np.nan
    states, inputs = plan[0], np.clip(plan[1], system.u_min, system.u_max)
    return MPCSolution(
        u=inputs[0],
        # Built without validation: the values of a failed solve are NaN on purpose.
        trajectory=bypass_init(Trajectory, x=states, u=inputs, y=system.output(states[:-1])),
        cost=cost,
        seconds=time.perf_counter() - began,
        **vars(outcome),
    )
