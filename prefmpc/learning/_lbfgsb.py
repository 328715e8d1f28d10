"""The one place that knows jaxopt: bound-constrained quasi-Newton minimisation of a pytree."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

HISTORY = 10


def minimise(
    function: Callable[[Any], Any],
    start: Any,
    bounds: tuple[Any, Any],
    *,
    l1: Any = None,
    max_iterations: Any,
    tol: Any,
) -> tuple[Any, Any, Any]:
    """Minimise function(θ) + l1·‖θ‖₁ over lower ≤ θ ≤ upper with L-BFGS-B.

    ‖θ‖₁ is not smooth, so with ``l1`` the solver works on θ = p − q with p, q ≥ 0, where it is
    the sum of p and q. The start is clipped into the bounds: jaxopt, started outside of them,
    returns a point that is neither feasible nor optimal and says nothing. Nothing else is
    promised about the result: the caller checks the bounds, finiteness and the returned error.

    Returns
    -------
    (θ, iterations, error)
        ``error`` is the largest entry of the projected gradient, NaN if the objective or an entry
        of its gradient is not finite.
    """
    x0, unravel = ravel_pytree(start)
    lower, upper = ravel_pytree(bounds[0])[0], ravel_pytree(bounds[1])[0]

    def plain(x: Any) -> Any:
        return function(unravel(x))

    def split(z: Any) -> Any:
        p, q = jnp.split(z, 2)
        return function(unravel(p - q)) + l1 * jnp.sum(z)

    if l1 is None:
        x, iterations, error = _run(plain, x0, (lower, upper), max_iterations, tol)
        return unravel(x), iterations, error
    z0 = jnp.concatenate([jnp.maximum(x0, 0), jnp.maximum(-x0, 0)])
    low = jnp.concatenate([jnp.maximum(lower, 0), jnp.maximum(-upper, 0)])
    high = jnp.concatenate([jnp.maximum(upper, 0), jnp.maximum(-lower, 0)])
    z, iterations, error = _run(split, z0, (low, high), max_iterations, tol)
    p, q = jnp.split(z, 2)
    return unravel(p - q), iterations, error


def _run(
    function: Callable[[Any], Any], x0: Any, bounds: tuple[Any, Any], limit: Any, tol: Any
) -> tuple[Any, Any, Any]:
    # The loop is ours, so that tol and the iteration limit are traced: no new compilation when
    # they change.
    # unroll="auto" would make every line search take its full number of steps under vmap.
    solver = jaxopt.LBFGSB(function, history_size=HISTORY, unroll=False)
    x0 = jnp.clip(x0, *bounds)

    def unfinished(carry: tuple[Any, Any]) -> Any:
        _, state = carry
        return (state.error > tol) & (state.iter_num < limit)

    def step(carry: tuple[Any, Any]) -> tuple[Any, Any]:
        x, state = carry
        x_new, state_new = solver.update(x, state, bounds)
        return x_new, state_new

    x, state = jax.lax.while_loop(unfinished, step, (x0, solver.init_state(x0, bounds)))
    # A maximum may pass over NaN, and the projection turns an infinite slope into a short step.
    known = jnp.isfinite(state.value) & jnp.isfinite(state.grad).all()
    return x, state.iter_num, jnp.where(known, state.error, jnp.nan)
