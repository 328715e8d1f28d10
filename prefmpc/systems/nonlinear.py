"""Nonlinear plants from JAX functions, discrete or continuous in time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    bounds_pair,
    finite_array,
    function,
    positive_int,
    real_array,
    sample_time,
    shaped,
    to_numpy,
    traced,
)
from prefmpc._pytree import register_pytree, set_fields
from prefmpc.systems.linear import LinearSystem, System

Dynamics = Callable[[Any, Any], Any]
"""x (nx,), u (nu,) → the next state, or ẋ; in `jax.numpy`."""


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class NonlinearSystem(System):
    """The discrete-time plant x⁺ = f(x, u), y = g(x) with u_min ≤ u ≤ u_max.

    Implements eq. (1) of arXiv 2511.22502.

    Parameters
    ----------
    f : function x (nx,), u (nu,) → x⁺ (nx,)
        Written in `jax.numpy`, so that it can be compiled and differentiated.
    g : function x (nx,) → y (ny,), optional
        Default: the output is the state.
    nx, nu : int
    dt, u_min, u_max
        As of `LinearSystem`.

    Raises
    ------
    ValueError
        If f or g fails or returns another shape, if dt ≤ 0, or if the bounds cross.
    """

    f: Dynamics
    g: Callable[[Any], Any]
    u_min: np.ndarray
    u_max: np.ndarray
    dt: float
    nx: int
    nu: int
    ny: int

    def __init__(
        self,
        f: Dynamics,
        g: Callable[[Any], Any] | None = None,
        *,
        nx: int,
        nu: int,
        dt: float,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> None:
        nx, nu = positive_int("nx", nx), positive_int("nu", nu)
        output = _state_itself if g is None else g
        low, high = bounds_pair(("u_min", "u_max"), u_min, u_max, nu)
        if (got := traced_shape("f(x, u)", f, nx, nu)) != (nx,):
            raise ValueError(f"f must return the next state, shape ({nx},), got shape {got}")
        ny = traced_shape("g(x)", output, nx)
        if len(ny) != 1 or not ny[0]:
            raise ValueError(f"g must return an output of shape (ny,), got shape {ny}")
        sizes = {"nx": nx, "nu": nu, "ny": int(ny[0])}
        set_fields(self, f=f, g=output, u_min=low, u_max=high, dt=sample_time(dt), **sizes)

    @classmethod
    def from_continuous(
        cls,
        f: Dynamics,
        g: Callable[[Any], Any] | None = None,
        *,
        nx: int,
        nu: int,
        dt: float,
        substeps: int = 1,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> NonlinearSystem:
        """Discretise ẋ = f(x, u), the input held, by ``substeps`` Runge–Kutta steps a sample.

        The error falls with their fourth power. The rest as in the constructor.
        """
        dt = sample_time(dt)
        got = traced_shape("f(x, u)", f, positive_int("nx", nx), positive_int("nu", nu))
        if got != (nx,):
            raise ValueError(f"f must return ẋ, shape ({nx},), got shape {got}")
        step = RungeKutta(f, dt / positive_int("substeps", substeps), substeps)
        return cls(step, g, nx=nx, nu=nu, dt=dt, u_min=u_min, u_max=u_max)

    def step(self, x: Any, u: Any) -> Any:
        """Return x⁺ = f(x, u), shape (..., nx)."""
        return to_numpy(_over_batch(self.f, real_array("x", x), real_array("u", u)))

    def output(self, x: Any) -> Any:
        """Return y = g(x), shape (..., ny)."""
        return to_numpy(_over_batch(self.g, real_array("x", x)))

    def linearise(self, x: ArrayLike, u: ArrayLike) -> LinearSystem:
        """Return the plant near (x, u): deviations follow δx⁺ = A δx + B δu, δy = C δx.

        A, B and C are the exact Jacobians of f and g there. The input bounds are those of δu.
        Raises a ValueError if (x, u) lies outside of the bounds or the Jacobians are not finite.
        """
        x = np.asarray(shaped("x", finite_array("x", x, ndim=1), (self.nx,)))
        u = np.asarray(shaped("u", finite_array("u", u, ndim=1), (self.nu,)))
        if not ((self.u_min <= u) & (u <= self.u_max)).all():
            raise ValueError(f"u must lie within the input bounds, got {u}")
        A, B = (np.asarray(part) for part in _jacobian(self.f, (0, 1), x, u))
        C = np.asarray(_jacobian(self.g, 0, x))
        low, high = self.u_min - u, self.u_max - u
        return LinearSystem(A, B, C, dt=self.dt, u_min=low, u_max=high)


register_pytree(NonlinearSystem, static=("f", "g", "dt", "nx", "nu", "ny"))


def _state_itself(x: Any) -> Any:
    return x


def traced_shape(name: str, call: Callable[..., Any], *sizes: int) -> tuple[int, ...]:
    """Return the shape of what a user's function of vectors of these sizes makes under JAX.

    ``name`` is the function with its arguments, such as "f(x, u)".
    """
    function(name.partition("(")[0], call, len(sizes))
    vectors = (jax.ShapeDtypeStruct((size,), np.float64) for size in sizes)
    with traced(name, Exception):
        out = jax.eval_shape(lambda *given: call(*given), *vectors)  # JAX takes no ufunc
    if not hasattr(out, "shape"):
        raise ValueError(f"{name} must return one array, got {type(out).__name__}")
    return tuple(out.shape)


@dataclasses.dataclass(frozen=True)
class RungeKutta:
    """The classical Runge–Kutta method as a function of (x, u): ``substeps`` steps of length ``h``.

    Equal ones are compiled once, and one can be pickled if f can.
    """

    f: Dynamics
    h: float
    substeps: int

    def __call__(self, x: Any, u: Any) -> Any:
        """Return the state (nx,) after all steps, with the input held."""
        if self.substeps == 1:
            return self._one(x, u)
        # A loop of known length: compiled once whatever the length, and differentiable.
        return jax.lax.fori_loop(0, self.substeps, lambda _, z: self._one(z, u), x)

    def _one(self, x: Any, u: Any) -> Any:
        f, h = self.f, self.h
        k1 = f(x, u)
        k2 = f(x + h / 2 * k1, u)
        k3 = f(x + h / 2 * k2, u)
        k4 = f(x + h * k3, u)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@jax.jit(static_argnums=0, inline=True)
def _over_batch(call: Callable[..., Any], *arrays: Any) -> Any:
    signature = ",".join("(n)" if i == 0 else "(m)" for i in range(len(arrays))) + "->(k)"
    return jnp.vectorize(call, signature=signature)(*arrays)


@jax.jit(static_argnums=(0, 1))
def _jacobian(call: Callable[..., Any], argnums: Any, *arrays: Any) -> Any:
    return jax.jacfwd(call, argnums=argnums)(*arrays)
