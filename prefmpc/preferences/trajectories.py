"""Trajectories T = (X, U, Y): the container, the quadratic cost φ, rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    array_module,
    finite_array,
    flag,
    function,
    instance,
    is_traced,
    nonnegative,
    positive_int,
    real_array,
    shaped,
    single,
    to_numpy,
    traced,
)
from prefmpc._matrices import psd_matrix
from prefmpc._pytree import Stack, bypass_init, register_pytree, set_fields
from prefmpc.systems.linear import LinearSystem, System


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Trajectory(Stack):
    """One trajectory, or a batch of them: x_0 … x_N, u_0 … u_{N−1}, y_0 … y_{N−1}.

    Time stands before the channel and batches lead. Below eq. (1) of arXiv 2511.22502.

    Parameters
    ----------
    x : array (..., N + 1, nx)
        States.
    u : array (..., N, nu)
        Inputs.
    y : array (..., N, ny), optional
        Outputs. Default: the states x_0 … x_{N−1}.
    x_r, u_r, y_r : array (nx,), (nu,), (ny,) or (..., nx), (..., nu), (..., ny), optional
        The set point that the trajectory was meant to reach, one for all or one for each; give x_r
        and u_r together. Default of y_r: x_r where the outputs are the states.
    u_before : array (nu,) or (..., nu), optional
        The input that was applied before u_0; without it the first increment Δu_0 counts as 0.

    Raises
    ------
    ValueError
        If an array holds NaN or infinite values, or the shapes do not fit each other.
    """

    x: Any
    u: Any
    y: Any
    x_r: Any = None
    u_r: Any = None
    y_r: Any = None
    u_before: Any = None

    def __init__(
        self,
        x: ArrayLike,
        u: ArrayLike,
        y: ArrayLike | None = None,
        *,
        x_r: ArrayLike | None = None,
        u_r: ArrayLike | None = None,
        y_r: ArrayLike | None = None,
        u_before: ArrayLike | None = None,
    ) -> None:
        states = shaped("x", finite_array("x", x), (None, None), "time, then states")
        inputs = shaped("u", finite_array("u", u), (None, None), "time, then inputs")
        horizon = inputs.shape[-2]
        if horizon < 1:
            raise ValueError(f"u must hold at least one step, got shape {inputs.shape}")
        for name, array in {"x": states, "u": inputs}.items():
            if not array.shape[-1]:
                raise ValueError(f"{name} must have at least one channel, got {array.shape}")
        if states.shape[-2] != horizon + 1:
            raise ValueError(
                f"x must hold one step more than u (x_0 … x_N against u_0 … u_{{N−1}}), "
                f"got {states.shape[-2]} states for {horizon} inputs"
            )
        outputs = states[..., :-1, :] if y is None else finite_array("y", y)
        shaped("y", outputs, (horizon, None), "one output for each input")
        batches = [array.shape[:-2] for array in (states, inputs, outputs)]
        if not batches[0] == batches[1] == batches[2]:
            raise ValueError(
                "x, u and y must have the same leading batch shape, "
                f"got {batches[0]}, {batches[1]} and {batches[2]}"
            )
        values = {"x": states, "u": inputs, "y": outputs}
        if (x_r is None) != (u_r is None):
            raise ValueError("x_r and u_r must be given together, got one of them")
        if y_r is None and y is None:
            y_r = x_r
        elif x_r is None and y_r is not None:
            raise ValueError("y_r must be given together with x_r and u_r, got y_r alone")
        for name, value in {"x_r": x_r, "u_r": u_r, "y_r": y_r, "u_before": u_before}.items():
            if value is not None:
                values[name] = _reference(name, value, values[name[0]])
        set_fields(self, **values)

    def deviation(self) -> Trajectory:
        """Return the same trajectory as deviations from its set point, which is then zero.

        Outputs stay as they are if there is no y_r. A trajectory without a set point is returned
        unchanged.
        """
        if self.x_r is None:
            return self
        y = self.y if self.y_r is None else self.y - self.y_r[..., None, :]
        x, u = self.x - self.x_r[..., None, :], self.u - self.u_r[..., None, :]
        before = None if self.u_before is None else self.u_before - self.u_r
        return bypass_init(Trajectory, x=x, u=u, y=y, u_before=before)

    @property
    def horizon(self) -> int:
        """Number of steps N."""
        return int(self.u.shape[-2])

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape; () for a single trajectory."""
        return tuple(self.u.shape[:-2])

    def __len__(self) -> int:
        """Size of the leading batch dimension."""
        if not self.batch_shape:
            raise TypeError("a single trajectory has no length; its number of steps is .horizon")
        return self.batch_shape[0]


register_pytree(Trajectory)


def failed(trajectory: Trajectory) -> np.ndarray:
    """Say which trajectories (...) hold NaN or infinite values: closed loops that failed."""
    parts = (trajectory.x, trajectory.u, trajectory.y)
    return ~np.all([np.isfinite(np.asarray(part)).all((-2, -1)) for part in parts], axis=0)


def check_finite(name: str, trajectories: Trajectory, note: str) -> None:
    """Raise a ValueError if a trajectory holds NaN or infinite values."""
    if (bad := failed(trajectories)).any():
        raise ValueError(
            f"{name} must be finite, got {int(bad.sum())} of {bad.size} with NaN or infinite "
            f"values ({note}), the first at index {int(np.argmax(bad))}"
        )


def _reference(name: str, value: ArrayLike, signal: Any) -> Any:
    wanted = (*signal.shape[:-2], signal.shape[-1])
    array = finite_array(name, value)
    if array.shape not in (wanted, wanted[-1:]):
        raise ValueError(f"{name} must have shape {wanted[-1:]} or {wanted}, got {array.shape}")
    return array_module(array).broadcast_to(array, wanted)


class Moments(NamedTuple):
    """Second moments S_x = Σ_k x_k x_kᵀ (..., nx, nx) and S_u = Σ_k u_k u_kᵀ (..., nu, nu)."""

    Sx: Any
    Su: Any


def second_moments(trajectory: Trajectory) -> Moments:
    """Return Σ_k x_k x_kᵀ and Σ_k u_k u_kᵀ over k = 0 … N−1.

    All that a quadratic cost can see of a trajectory: φ_N = ⟨Q, S_x⟩ + ⟨R, S_u⟩. The final state
    x_N is left out, as in eq. (10) of arXiv 2511.22502. With a set point: of the deviations.
    """
    instance("trajectory", trajectory, Trajectory)
    trajectory = trajectory.deviation()
    x = trajectory.x[..., :-1, :]
    u = trajectory.u
    return Moments(x.swapaxes(-1, -2) @ x, u.swapaxes(-1, -2) @ u)


def phi(trajectory: Trajectory, Q: ArrayLike, R: ArrayLike) -> Any:
    """Return φ_N(T; Q, R) = Σ_{k=0}^{N−1} x_kᵀ Q x_k + u_kᵀ R u_k, shape (...).

    Implements eq. (10) of arXiv 2511.22502; with a set point, of the deviations from it.
    Q (nx, nx) and R (nu, nu) must be positive semidefinite; anything else raises a ValueError.
    """
    instance("trajectory", trajectory, Trajectory)
    trajectory = trajectory.deviation()
    Q, R = psd_matrix("Q", Q, stack=False), psd_matrix("R", R, stack=False)
    shaped("Q", Q, (trajectory.x.shape[-1],) * 2, "the trajectory's states")
    shaped("R", R, (trajectory.u.shape[-1],) * 2, "the trajectory's inputs")
    x, u = trajectory.x[..., :-1, :], trajectory.u
    return ((x @ Q) * x).sum((-1, -2)) + ((u @ R) * u).sum((-1, -2))


def max_input(trajectory: Trajectory) -> Any:
    """Return max_k ‖u_k‖∞, shape (...): the largest input of any channel, in its unit."""
    instance("trajectory", trajectory, Trajectory)
    return abs(trajectory.u).max((-2, -1))


def settling_time(trajectory: Trajectory | ArrayLike, epsilon: float = 0.1) -> np.ndarray:
    """Return κ_ε, the first step from which ‖y‖₂ ≤ ε for good, shape (...); inf if there is none.

    Implements the settling time of section III-B of arXiv 2511.22502 on y_0 … y_{N−1}: κ = 0 if
    the output never leaves the ball, and κ = inf if it is still outside at the last step.

    Parameters
    ----------
    trajectory : Trajectory, or array of outputs (..., N, ny)
        An output that is not finite is outside the ball.
    epsilon : float
        Radius of the ball, in the unit of y. Its border belongs to it.
    """
    if isinstance(trajectory, Trajectory):
        y = np.asarray(trajectory.y)
    else:
        outputs = finite_array("trajectory", trajectory)
        y = np.asarray(shaped("trajectory", outputs, (None, None), "outputs over time"))
    steps = y.shape[-2]
    if steps < 1 or not y.shape[-1]:
        raise ValueError(f"trajectory must hold at least one step and output, got {y.shape}")
    with np.errstate(over="ignore"):  # an infinite norm is outside
        outside = ~(np.linalg.norm(y, axis=-1) <= nonnegative("epsilon", epsilon))
    since = np.argmax(outside[..., ::-1], axis=-1)  # steps since it was last outside
    kappa = np.where(outside.any(axis=-1), steps - since, 0)
    return np.where(kappa == steps, np.inf, kappa)


def settling_text(kappa: ArrayLike, steps: int) -> str:
    """Return a settling time in steps as text: "7", "6.5", or ">30" if it never settled."""
    value = nonnegative("kappa", kappa, allow_inf=True)
    steps = positive_int("steps", steps)
    return f">{steps}" if np.isinf(value) else f"{value:g}"


def rollout(
    system: System,
    x0: ArrayLike,
    law: Callable[[Any], Any] | ArrayLike,
    steps: int,
    *,
    saturate: bool = False,
) -> Trajectory:
    """Run the plant for ``steps`` steps under a feedback law, for a whole batch of x(0) at once.

    The input limits of ``system`` are not applied unless ``saturate`` is set: a law that must
    respect them does so itself.

    Parameters
    ----------
    x0 : array (..., nx)
    law : callable or array (..., nu, nx)
        A JAX function x (nx,) → u (nu,), or a gain K for u = −K x, one for all or one for each
        x(0).
    steps : int
    saturate : bool
        Apply what the plant can give of the law's u: clip(u, u_min, u_max).

    Returns
    -------
    Trajectory
        x (..., steps + 1, nx), u (..., steps, nu), y (..., steps, ny).

    Raises
    ------
    ValueError
        If x0 holds NaN, a shape does not fit, ``steps`` is below 1, or a nonlinear plant leaves
        the numbers.
    """
    instance("system", system, System)
    single("system", system, "; closed_loops takes stacks")
    starts = shaped("x0", finite_array("x0", x0), (system.nx,), "the system's states")
    steps = positive_int("steps", steps)
    batch = starts.shape[:-1]
    flat = starts.reshape(-1, system.nx)
    gains = None
    if callable(law):
        function("law", law, 1)
        feedback: Callable[..., Any] = law
    else:
        K = shaped("law", finite_array("law", law), (system.nu, system.nx), "a gain K")
        if K.shape[:-2] not in ((), batch):
            raise ValueError(f"law must hold one gain or one for each x0 {batch}, got {K.shape}")
        gains = array_module(K).broadcast_to(K, (*batch, system.nu, system.nx))
        gains, feedback = gains.reshape(-1, system.nu, system.nx), _feedback
    with traced("law(x)"):
        x, u = to_numpy(_rollout(system, flat, steps, feedback, gains, flag("saturate", saturate)))
    if not isinstance(system, LinearSystem) and not is_traced(x):
        check_finite_states(x)
    return from_flat(system, x, u, batch)


def check_finite_states(x: np.ndarray) -> None:
    """Raise a ValueError if the states (m, steps + 1, nx) of a simulation stop being numbers."""
    bad = ~np.isfinite(x).all(axis=-1)
    if bad.any():
        run, step = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"system must return finite states, got {x[run, step]} at step {step} of run {run}"
        )


def from_flat(system: System, x: Any, u: Any, batch: tuple[int, ...]) -> Trajectory:
    """Build a trajectory from x and u with one leading dimension: give it the shape ``batch``.

    The outputs are those of the plant. Nothing is checked: a failed solve may have left NaN behind.
    """
    x = x.reshape(*batch, *x.shape[1:])
    u = u.reshape(*batch, *u.shape[1:])
    return bypass_init(Trajectory, x=x, u=u, y=system.output(x[..., :-1, :]))


def _feedback(x: Any, K: Any) -> Any:
    return -K @ x


@jax.jit(static_argnums=(2, 3, 5))
def _rollout(
    system: System, x0: Any, steps: int, law: Callable[..., Any], gains: Any, saturate: bool
) -> Any:
    """Return x (m, steps + 1, nx) and u (m, steps, nu) under law(x), or law(x, K) with gains."""

    def run(start: Any, gain: Any) -> tuple[Any, Any]:
        def step(x: Any, _: None) -> tuple[Any, tuple[Any, Any]]:
            u = real_array("what law returns", law(x) if gain is None else law(x, gain))
            if u.shape != (system.nu,):
                raise ValueError(f"law must return shape ({system.nu},), got {u.shape}")
            if saturate:
                u = jnp.clip(u, system.u_min, system.u_max)
            x_next = system.step(x, u)
            return x_next, (x_next, u)

        _, (x, u) = jax.lax.scan(step, start, None, length=steps)
        return jnp.concatenate([start[None], x]), u

    return jax.vmap(run)(x0, gains)
