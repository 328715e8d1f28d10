"""Convex σ and convex sets as cvxpy expressions, in units in which all is of order one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from prefmpc._checks import instance, nonnegative, sequence, single
from prefmpc.models.networks import ICNNCost
from prefmpc.models.quadratic import QuadraticCost, SumCost
from prefmpc.mpc._limits import per_unit
from prefmpc.mpc.solution import check_dimension, check_weights
from prefmpc.mpc.terminal import stage_constraints
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron, SecondOrderCone


def check_convex(cost: Any, nx: int, nu: int, horizon: int) -> None:
    """Raise a ValueError unless ``cost`` is a convex model that fits nx states and nu inputs."""
    single("cost", cost)
    if isinstance(cost, SumCost):
        for model in cost.models:
            check_convex(model, nx, nu, horizon)
        return
    if isinstance(cost, QuadraticCost):
        check_weights(cost, nx, nu)
        return
    if not isinstance(cost, ICNNCost):
        raise ValueError(
            "cost must be a convex σ (QuadraticCost, ICNNCost, or SumCost of these), "
            f"got {type(cost).__name__}"
        )
    for name, leaf in (*((f"U[{i}]", leaf) for i, leaf in enumerate(cost.U)), ("c", cost.c)):
        if not (np.asarray(leaf) >= 0).all():
            raise ValueError(f"cost must be convex, but its {name} has negative entries or NaN")
    if len(cost.scale) != nx + nu:
        raise ValueError(f"cost must see {nx + nu} signals, got {len(cost.scale)}")
    nonnegative("cost.floor", cost.floor)
    columns = cost.columns
    if cost.over == "trajectory" and columns != horizon * (nx + nu):
        raise ValueError(
            f"horizon must be {columns // (nx + nu)}, for which cost was made, got {horizon}"
        )


def quadratic(cost: Any) -> bool:
    """Say whether a convex σ is a quadratic one, or a sum of these."""
    if isinstance(cost, SumCost):
        return all(map(quadratic, cost.models))
    return isinstance(cost, QuadraticCost)


def weights(cost: Any, nx: int, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and R that say how much a convex σ cares for states and inputs, roughly.

    Exact for a quadratic σ. A network has the sizes of the signals in its ``scale``.
    """
    if isinstance(cost, SumCost):
        Q, R = np.zeros((nx, nx)), np.zeros((nu, nu))
        for weight, model in zip(cost.weights, cost.models, strict=True):
            parts = weights(model, nx, nu)
            Q, R = Q + weight * parts[0], R + weight * parts[1]
        return Q, R
    if isinstance(cost, QuadraticCost):
        return np.asarray(cost.Q), np.asarray(cost.R)
    steps = np.concatenate([np.eye(cost.columns), -np.eye(cost.columns), [np.zeros(cost.columns)]])
    values = np.asarray(cost._units(steps)) @ np.asarray(cost.c)
    rises = float(np.abs(values - values[-1]).max()) + cost.floor
    W = np.diag(rises / np.asarray(cost.scale) ** 2)
    return W[:nx, :nx], W[nx:, nx:]


def expression(cp: Any, cost: Any, X: Any, U: Any) -> Any:
    """Return a σ that fits (`check_convex`) as a cvxpy expression of X (N, nx) and U (N, nu)."""
    N = X.shape[0]
    if isinstance(cost, SumCost):
        parts = zip(cost.weights, cost.models, strict=True)
        return sum(float(weight) * expression(cp, model, X, U) for weight, model in parts)
    if isinstance(cost, QuadraticCost):
        factors = factor(np.asarray(cost.Q)), factor(np.asarray(cost.R))
        return cp.sum_squares(X @ factors[0]) + cp.sum_squares(U @ factors[1])
    v = cp.multiply(cp.hstack([X, U]), np.tile(1 / np.asarray(cost.scale), (N, 1)))
    if cost.over == "trajectory":
        v = cp.reshape(v, (1, cost.columns), order="C")
    act = {
        "softplus": cp.logistic,
        "relu": cp.pos,
        "squared_relu": lambda a: cp.square(cp.pos(a)),
    }[cost.activation]
    ones = np.ones((v.shape[0], 1))

    def units(v: Any) -> Any:
        z = act(v @ np.asarray(cost.V[0]).T + ones @ np.asarray(cost.b[0])[None])
        for V, b, W in zip(cost.V[1:], cost.b[1:], cost.U, strict=True):
            z = act(z @ np.asarray(W).T + v @ np.asarray(V).T + ones @ np.asarray(b)[None])
        return z

    last = (units(v) + units(-v)) / 2 if cost.even else units(v)
    total = cp.sum(last @ np.asarray(cost.c))
    return total + cost.floor * cp.sum_squares(v) if cost.floor else total


def stage_limits(
    cp: Any,
    system: LinearSystem,
    constraints: Polyhedron | None,
    output_cones: Sequence[SecondOrderCone],
    signals: tuple[Any, Any],
    units: tuple[np.ndarray, np.ndarray],
    fixed: tuple[np.ndarray, list[np.ndarray]] | None = None,
) -> list[Any]:
    """Return (x, u) ∈ Z for all rows of X (N, nx) and U (N, nu), in ``units``, for cvxpy.

    Left out are the rows of ``constraints`` (N, m) and the cones (N,) that are ``fixed``. Raises
    a ValueError if a set does not fit.
    """
    X, U = signals
    Z = stage_constraints(system, constraints)
    check_cones(system, output_cones)
    wanted = np.ones((X.shape[0], len(Z.h)), dtype=bool)
    if fixed is not None and constraints is not None:
        wanted[:, len(Z.h) - len(constraints.h) :] = ~fixed[0]
    H, h = per_unit(Z.H * np.concatenate(units), Z.h)
    limits = []
    for pattern in np.unique(wanted, axis=1).T:
        rows, stages = (wanted == pattern[:, None]).all(axis=0), np.flatnonzero(pattern)
        if rows.any() and stages.size:
            stacked = cp.hstack([X[stages], U[stages]])
            limits.append(stacked @ H[rows].T <= np.tile(h[rows], (stages.size, 1)))
    for i, cone in enumerate(output_cones):
        free = np.ones(X.shape[0], dtype=bool) if fixed is None else ~fixed[1][i]
        if not free.any():
            continue
        stages = np.flatnonzero(free)
        F, c = cone.F @ system.C * units[0], cone.c @ system.C * units[0]
        size = np.abs(np.concatenate([F, c[None]])).max()
        size = size if size > 0 else 1.0
        side = X[stages] @ (c / size) + cone.d / size
        limits.append(cp.norm(X[stages] @ (F / size).T + cone.g / size, 2, axis=1) <= side)
    return limits


def check_cones(system: LinearSystem, output_cones: Sequence[SecondOrderCone]) -> None:
    """Raise a ValueError unless all are cones over y."""
    for i, cone in enumerate(sequence("output_cones", output_cones)):
        instance(f"output_cones[{i}]", cone, SecondOrderCone)
        check_dimension(f"output_cones[{i}]", cone.dim, system.ny)


def factor(matrix: np.ndarray) -> np.ndarray:
    """Return F with F Fᵀ = matrix, each row as accurate as the row of the matrix."""
    sizes = np.sqrt(np.diag(matrix))
    sizes = np.where(sizes > 0, sizes, 1.0)
    values, vectors = np.linalg.eigh(matrix / sizes / sizes[:, None])
    return sizes[:, None] * vectors * np.sqrt(np.clip(values, 0, None))
