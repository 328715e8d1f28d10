"""Single shooting: σ and the constraints as functions of the inputs, with exact derivatives.

The plant runs once along the inputs; everything else is done for all steps at the same time. With
the sensitivities S = ∂(X, U)/∂U and multipliers λ of the dynamics the curvature of the Lagrangian
is Sᵀ(∇²L + Σ_k λ_{k+1}·∇²f_k)S: no derivative is taken through the loop over time.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._pytree import bypass_init
from prefmpc.mpc._limits import input_size
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import System

ROUNDING = 1e-10
"""Of σ's slopes, what they would be without a reference: less is lost in its digits."""


class Problem(NamedTuple):
    """All that is not a function; None where there is nothing."""

    system: System
    cost: Any
    stages: Any
    last: Any
    ball: Any
    final: Any
    scale: Any


class Given(NamedTuple):
    """What changes from solve to solve; NaN for an input before that is not known."""

    x0: Any
    reference: Any
    before: Any


def _states(problem: Problem, given: Given, U: Any) -> Any:
    """Run the plant along the inputs U (N, nu): the states (N + 1, nx)."""

    def step(x: Any, u: Any) -> tuple[Any, Any]:
        x_next = problem.system.step(x, u)
        return x_next, x_next

    _, x = jax.lax.scan(step, jnp.asarray(given.x0), U)
    return jnp.concatenate([jnp.asarray(given.x0)[None], x])


def _cost(problem: Problem, given: Given, X: Any, U: Any) -> Any:
    """Return σ of the plan, with the terminal cost."""
    names = ("x_r", "u_r", "y_r")
    optional = {} if given.reference is None else dict(zip(names, given.reference, strict=True))
    optional = {name: jnp.asarray(value) for name, value in optional.items()}
    # Where it is not known the first increment is 0.
    optional["u_before"] = jnp.where(jnp.isnan(given.before), U[0], given.before)
    y = problem.system.output(X[:-1])
    total = problem.cost(bypass_init(Trajectory, x=X, u=U, y=y, **optional))
    if problem.final is not None:
        total = total + X[-1] @ problem.final @ X[-1]
    return total


def _on_stage(problem: Problem, path: Any, x: Any, u: Any) -> Any:
    """Return the constraints (m,) ≤ 0 on one stage."""
    rows = []
    if problem.stages is not None:
        H, h = problem.stages
        rows.append(H @ jnp.concatenate([x, u]) - h)
    if path is not None:
        rows.append(path(x, u))
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def _at_end(problem: Problem, x: Any) -> Any:
    """Return the constraints (m,) ≤ 0 on x_N."""
    rows = []
    if problem.last is not None:
        H, h = problem.last
        rows.append(H @ x - h)
    if problem.ball is not None:
        P, level = problem.ball
        rows.append((x @ P @ x - level)[None])
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def rows(problem: Problem, path: Any, horizon: int) -> int:
    """Return the number of constraints."""
    sizes = problem.system.nx, problem.system.nu
    x, u = (jax.ShapeDtypeStruct((size,), np.float64) for size in sizes)
    stage = jax.eval_shape(lambda x, u: _on_stage(problem, path, x, u), x, u)
    return horizon * stage.size + jax.eval_shape(lambda x: _at_end(problem, x), x).size


def path_sizes(path: Any, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the sizes (m,) of path(x, u) where nothing moves: limits, or what terms are."""
    cx, cu = jax.jacfwd(path, argnums=(0, 1))(x, u)
    limit = jnp.abs(cx @ x + cu @ u - path(x, u))
    return np.asarray(jnp.maximum(limit, jnp.abs(cx) @ np.abs(x) + jnp.abs(cu) @ np.abs(u)))


class _Layout(NamedTuple):
    """How one vector holds a problem and what is given; and the parts that are not numbers."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    path: Any
    horizon: int


@dataclasses.dataclass(frozen=True, eq=False)
class Known:
    """A layout that is hashed by its identity: a compiled program is found at once."""

    layout: _Layout

    def unpack(self, flat: Any) -> tuple[Problem, Given]:
        """Return the problem and what is given for it."""
        leaves, at = [], 0
        for shape in self.layout.shapes:
            size = int(np.prod(shape))
            leaves.append(flat[at : at + size].reshape(shape))
            at += size
        return jax.tree.unflatten(self.layout.tree, leaves)


@lru_cache(maxsize=1024)
def _known(layout: _Layout) -> Known:
    return Known(layout)


def packed(problem: Problem, given: Given, path: Any, horizon: int) -> tuple[Known, Any]:
    """Return the layout of a problem and all its numbers in one array on the device."""
    # One array goes to the compiled programs: with the twenty of a problem, handing them over
    # takes longer than all that is computed.
    leaves, tree = jax.tree.flatten((problem, given))
    layout = _Layout(tree, tuple(np.shape(leaf) for leaf in leaves), path, horizon)
    flat = np.concatenate([np.ravel(leaf) for leaf in leaves])
    return _known(layout), jax.device_put(flat)


def _unpacked(known: Known, flat: Any, z: Any) -> tuple[Any, ...]:
    problem, given = known.unpack(flat)
    U = (z * problem.scale).reshape(known.layout.horizon, problem.system.nu)
    return problem, given, known.layout.path, _states(problem, given, U), U


@jax.jit(static_argnums=0)
def values(known: Known, flat: Any, z: Any) -> tuple[Any, Any]:
    """Return σ and the constraints c ≤ 0 (m,) for scaled inputs z (N·nu,)."""
    problem, given, path, X, U = _unpacked(known, flat, z)
    stages = jax.vmap(lambda x, u: _on_stage(problem, path, x, u))(X[:-1], U)
    c = jnp.concatenate([stages.ravel(), _at_end(problem, X[-1])])
    return _cost(problem, given, X, U), c


def _sensitivities(problem: Problem, X: Any, U: Any) -> tuple[Any, Any, Any]:
    """Return A_k and B_k, ∂x_k/∂z (N + 1, nx, n) and ∂u_k/∂z (N, nu, n)."""
    N, nu = U.shape
    A, B = jax.vmap(jax.jacfwd(problem.system.step, argnums=(0, 1)))(X[:-1], U)
    Su = (jnp.eye(N * nu) * problem.scale).reshape(N, nu, N * nu)

    def step(S: Any, stage: Any) -> tuple[Any, Any]:
        a, forced = stage
        S_next = a @ S + forced
        return S_next, S_next

    start = jnp.zeros((X.shape[1], N * nu))
    _, Sx = jax.lax.scan(step, start, (A, B @ Su))
    return (A, B), jnp.concatenate([start[None], Sx]), Su


class Slopes(NamedTuple):
    """Derivatives with respect to z, and the sizes of what they are sums and differences of.

    The size of a slope of σ is the sum of its terms' absolute values, that of a constraint is as in
    `_limits.row_sizes`.
    """

    gradient: Any
    """∇σ (n,)"""
    jacobian: Any
    """∂c/∂z (m, n)"""
    size: Any
    """(n,)"""
    rows: Any
    """(m,): the largest along the plan, for constraints that come again in each stage."""
    near: Any
    """(m,): each in its own stage."""

    @classmethod
    def of(cls, table: Any, sizes: Any) -> Slopes:
        """Take apart what `slopes` returns."""
        table = np.asarray(table)
        return cls(table[0], table[2:], table[1], *np.asarray(sizes))


@jax.jit(static_argnums=0)
def slopes(known: Known, flat: Any, z: Any) -> tuple[Any, Any]:
    """Return what `Slopes` are made of: each array more that is returned takes time."""
    problem, given, path, X, U = _unpacked(known, flat, z)
    (A, B), Sx, Su = _sensitivities(problem, X, U)
    largest_u = input_size(jnp.asarray(problem.system.u_min), problem.system.u_max)
    reach_u = jnp.maximum(jnp.abs(U), largest_u)

    def joined(x: Any, u: Any) -> Any:
        return jnp.concatenate([x.ravel(), u.ravel()])

    def largest(part: Any) -> Any:
        return jnp.where(jnp.isfinite(part), jnp.abs(part), 0.0).max(0)

    S = jnp.concatenate([Sx.reshape(-1, z.size), Su.reshape(-1, z.size)])
    gradient = jax.grad(lambda x, u: _cost(problem, given, x, u), argnums=(0, 1))
    (gx, gu), hessian_times = jax.linearize(gradient, X, U)
    rounding = [ROUNDING * largest(part) for part in hessian_times(jnp.abs(X), reach_u)]
    # Late in a plan all pulls end, and there are inputs that nothing needs: these count beside
    # the largest of their kind, and in shares of their range beside the largest of all.
    limited = jnp.isfinite(problem.system.u_min) & jnp.isfinite(problem.system.u_max)
    shares = jnp.where(limited, jnp.abs(z).reshape(U.shape), 0.0)
    usual = jnp.where(limited, shares.max() * problem.scale.reshape(U.shape), jnp.abs(U).max(0))
    priced = jnp.maximum(largest(gu), largest(hessian_times(jnp.zeros_like(X), usual)[1]))
    least = joined(
        jnp.broadcast_to(rounding[0], X.shape), jnp.broadcast_to(rounding[1] + priced, U.shape)
    )
    partials = joined(gx, gu)
    size = jnp.maximum(jnp.abs(partials), least) @ jnp.abs(S)

    on_stage = jax.vmap(lambda x, u: _on_stage(problem, path, x, u))
    cx, cu = jax.vmap(jax.jacfwd(lambda x, u: _on_stage(problem, path, x, u), argnums=(0, 1)))(
        X[:-1], U
    )
    stages = (cx @ Sx[:-1] + cu @ Su).reshape(-1, z.size)
    limit = jnp.einsum("kmx,kx->km", cx, X[:-1]) + jnp.einsum("kmu,ku->km", cu, U)
    limit = jnp.abs(limit - on_stage(X[:-1], U))  # h of a row H x ≤ h
    step = jnp.einsum("kij,kj->ki", jnp.abs(A), jnp.abs(X[:-1])) + jnp.abs(B) @ largest_u
    reach = jnp.maximum(jnp.abs(X[:-1]), step)
    reach = jnp.einsum("kmx,kx->km", jnp.abs(cx), reach)
    near = jnp.maximum(limit, reach + jnp.einsum("kmu,ku->km", jnp.abs(cu), reach_u))

    ex = jax.jacfwd(lambda x: _at_end(problem, x))(X[-1])
    limit = jnp.abs(ex @ X[-1] - _at_end(problem, X[-1]))
    ends = jnp.maximum(limit, jnp.abs(ex) @ jnp.abs(X).max(0))
    table = jnp.concatenate([(partials @ S)[None], size[None], stages, ex @ Sx[-1]])
    along = jnp.tile(near.max(0), len(U))
    rows = [jnp.concatenate([along, ends]), jnp.concatenate([near.ravel(), ends])]
    return table, jnp.stack(rows)


@jax.jit(static_argnums=0)
def curvature(known: Known, flat: Any, z: Any, multipliers: Any) -> Any:
    """Return ∇²σ + Σ_i multiplier_i ∇²c_i, (n, n)."""
    problem, given, path, X, U = _unpacked(known, flat, z)
    (A, _), Sx, Su = _sensitivities(problem, X, U)
    nx, n = X.shape[1], z.size
    S = jnp.concatenate([Sx.reshape(-1, n), Su.reshape(-1, n)])
    at = jnp.concatenate([X.ravel(), U.ravel()])
    on_stages, at_end = jnp.split(multipliers, [multipliers.size - _at_end(problem, X[-1]).size])

    def lagrangian(flat_plan: Any) -> Any:
        x, u = flat_plan[: X.size].reshape(X.shape), flat_plan[X.size :].reshape(U.shape)
        c = jax.vmap(lambda a, b: _on_stage(problem, path, a, b))(x[:-1], u).ravel()
        return _cost(problem, given, x, u) + on_stages @ c + at_end @ _at_end(problem, x[-1])

    slope = jax.grad(lagrangian)(at)[: X.size].reshape(X.shape)

    def back(price: Any, stage: Any) -> tuple[Any, Any]:
        a, g = stage
        return a.T @ price + g, price

    # λ_{k+1} for k = 0 … N−1: what one unit of x_{k+1} costs from there on.
    _, prices = jax.lax.scan(back, slope[-1], (A, slope[:-1]), reverse=True)

    def dynamics_hessian(x: Any, u: Any, price: Any) -> Any:
        stage = jnp.concatenate([x, u])
        return jax.hessian(lambda w: price @ problem.system.step(w[:nx], w[nx:]))(stage)

    hessians = jax.vmap(dynamics_hessian)(X[:-1], U, prices)
    stages = jnp.concatenate([Sx[:-1], Su], axis=1)
    linearised = S.T @ jax.hessian(lagrangian)(at) @ S
    return linearised + jnp.einsum("kin,kij,kjm->nm", stages, hessians, stages)


@jax.jit(static_argnums=0)
def along(known: Known, flat: Any, U: Any) -> tuple[Any, Any]:
    """Return σ and the states (N + 1, nx) along the inputs U (N, nu)."""
    problem, given = known.unpack(flat)
    X = _states(problem, given, U)
    return _cost(problem, given, X, U), X
