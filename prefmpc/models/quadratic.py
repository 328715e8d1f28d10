"""Models σ of what a person minimises: pure functions of a trajectory, smaller is better."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    array_module,
    broadcasts,
    instance,
    nonnegative,
    require_x64,
    sequence,
    shaped,
)
from prefmpc._matrices import psd_matrix, unit_diagonal
from prefmpc._pytree import Stack, bypass_init, constant_like, register_pytree
from prefmpc.preferences.pools import random_weights
from prefmpc.preferences.trajectories import Trajectory, second_moments

DIAGONAL_MIN = 0.01
FIRST_MIN = 1.0


@runtime_checkable
class CostModel(Protocol):
    """What `fit` needs of a σ model: a pytree of weights with four pure functions.

    Register a class of your own with `prefmpc._pytree.register_pytree`, and derive it from `Stack`,
    so that restarts can be stacked. `NonlinearMPC` takes any.

    ``linear_in_features`` promises score(a) − score(b) = score(a − b): then a pair of
    trajectories enters the loss as one difference of features.
    """

    @property
    def linear_in_features(self) -> bool:
        """Whether σ of a difference of features is the difference of σ."""

    def features(self, trajectory: Trajectory) -> Any:
        """Everything that σ needs of a trajectory; computed once, outside the training loop."""

    def score(self, features: Any) -> Any:
        """Return σ (...) from features with the same leading shape."""

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) (...): the score of the features; a ValueError if T does not fit."""

    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bounds on the weights, in the model's own tree structure."""


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class QuadraticCost(Stack):
    """σ(T) = Σ_{k=0}^{N−1} x_kᵀ Q x_k + u_kᵀ R u_k, with Q = L Lᵀ and R likewise.

    Implements eq. (11) of arXiv 2511.22502. The trained weights θ are the entries of the lower
    triangular Cholesky factors, row by row, so that any θ gives positive semidefinite matrices.

    Parameters
    ----------
    Q : array (..., nx, nx)
        Symmetric positive semidefinite.
    R : array (..., nu, nu)
        Symmetric positive definite.

    Raises
    ------
    ValueError
        If Q or R is not symmetric, is indefinite, or holds NaN.
    """

    theta_Q: Any
    theta_R: Any

    linear_in_features = True

    def __init__(self, Q: ArrayLike, R: ArrayLike) -> None:
        Q = psd_matrix("Q", Q)
        R = psd_matrix("R", R, definite=True)
        if Q.shape[:-2] != R.shape[:-2]:
            raise ValueError(
                f"Q and R must have the same batch shape, got {Q.shape[:-2]} and {R.shape[:-2]}"
            )
        object.__setattr__(self, "theta_Q", _pack(_semidefinite_factor(Q)))
        object.__setattr__(self, "theta_R", _pack(_semidefinite_factor(R)))

    @property
    def Q(self) -> Any:
        """State weight (..., nx, nx)."""
        factor = _unpack(self.theta_Q)
        return factor @ factor.swapaxes(-1, -2)

    @property
    def R(self) -> Any:
        """Input weight (..., nu, nu)."""
        factor = _unpack(self.theta_R)
        return factor @ factor.swapaxes(-1, -2)

    @property
    def theta(self) -> Any:
        """All weights θ (..., n_Q + n_R): first the factor of Q, then that of R."""
        return _join(self.theta_Q, self.theta_R)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of models; () for one."""
        return tuple(self.theta_Q.shape[:-1])

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) for every trajectory of a batch, shape (...).

        A stack of models needs a leading shape that broadcasts against the trajectories'.
        """
        instance("trajectory", trajectory, Trajectory)
        broadcasts("trajectory", trajectory.batch_shape, self.batch_shape)
        nx, nu = _size(self.theta_Q), _size(self.theta_R)
        shaped("trajectory.x", trajectory.x, (None, nx), "time, then the model's states")
        shaped("trajectory.u", trajectory.u, (None, nu), "time, then the model's inputs")
        return self.score(self.features(trajectory))

    @staticmethod
    def features(trajectory: Trajectory) -> Any:
        """Return the packed second moments (..., n_Q + n_R): σ sees nothing else of a trajectory.

        The lower triangles of S_x and S_u, off-diagonal entries doubled, so that σ is one dot
        product with the lower triangles of Q and R.
        """
        moments = second_moments(trajectory)
        return _join(*(_pack(S * (2 - np.eye(S.shape[-1]))) for S in moments))

    def score(self, features: Any) -> Any:
        """Return ⟨Q, S_x⟩ + ⟨R, S_u⟩ from the packed second moments."""
        weights = _join(_pack(self.Q), _pack(self.R))
        if not self.batch_shape:
            return features @ weights  # one matrix product in the training loop
        return (features * weights).sum(-1)

    def bounds(self) -> tuple[QuadraticCost, QuadraticCost]:
        """Return the paper's bounds on θ as two models: diagonal ≥ 0.01, its first entry ≥ 1."""

        def lower(theta: Any, first: float) -> Any:
            rows, columns = lower_triangle(_size(theta))
            bound = np.where(rows == columns, DIAGONAL_MIN, -np.inf)
            bound[0] = first
            return np.broadcast_to(bound, theta.shape)

        low = bypass_init(
            QuadraticCost,
            theta_Q=lower(self.theta_Q, FIRST_MIN),
            theta_R=lower(self.theta_R, DIAGONAL_MIN),
        )
        return low, constant_like(low, np.inf)

    @classmethod
    def random(
        cls, nx: int, nu: int, *, key: Any, shape: tuple[int, ...] = (), **options: float
    ) -> QuadraticCost:
        """Draw a stack of models with `prefmpc.preferences.pools.random_weights` (same options)."""
        require_x64()
        return cls(*random_weights(nx, nu, key=key, shape=shape, **options))


register_pytree(QuadraticCost)


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class SumCost:
    """A weighted sum of σ models: σ(T) = Σ_i weight_i·σ_i(T).

    Trained with `fit`, all models learn together; the weights stay as they are.

    Parameters
    ----------
    models : sequence of σ models
        Single ones, or stacks with the same leading shape.
    weights : sequence of float, optional
        Nonnegative, so that a sum of convex models is convex. Default: ones.

    Raises
    ------
    ValueError
        If there is no model, one is not a σ model, or a weight is negative.
    """

    models: tuple[Any, ...]
    weights: tuple[float, ...]

    linear_in_features = False

    def __init__(self, models: Sequence[Any], weights: Sequence[float] | None = None) -> None:
        parts = [] if isinstance(models, CostModel) else sequence("models", models)
        if not parts:
            raise ValueError("models must be a sequence of at least one σ model")
        for i, model in enumerate(parts):
            check_model(f"models[{i}]", model)
        stacks = {model.batch_shape for model in parts if hasattr(model, "batch_shape")}
        if len(stacks) > 1:
            raise ValueError(f"models must have the same leading shape, got {sorted(stacks)}")
        factors = [1.0] * len(parts) if weights is None else sequence("weights", weights)
        if len(factors) != len(parts):
            raise ValueError(f"weights must be {len(parts)} numbers, got {len(factors)}")
        values = tuple(nonnegative(f"weights[{i}]", w) for i, w in enumerate(factors))
        object.__setattr__(self, "models", tuple(parts))
        object.__setattr__(self, "weights", values)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of sums; () for one."""
        shapes = (m.batch_shape for m in self.models if hasattr(m, "batch_shape"))
        return tuple(next(shapes, ()))

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) for every trajectory of a batch, shape (...)."""
        parts = zip(self.weights, self.models, strict=True)
        return sum(weight * model(trajectory) for weight, model in parts)

    def features(self, trajectory: Trajectory) -> Any:
        """Return the features of every model."""
        return tuple(model.features(trajectory) for model in self.models)

    def score(self, features: Any) -> Any:
        """Return σ (...) from the features of every model."""
        parts = zip(self.weights, self.models, features, strict=True)
        return sum(weight * model.score(part) for weight, model, part in parts)

    def bounds(self) -> tuple[SumCost, SumCost]:
        """Return the bounds of all models as two sums."""
        low, high = zip(*(model.bounds() for model in self.models), strict=True)
        return (
            bypass_init(SumCost, models=low, weights=self.weights),
            bypass_init(SumCost, models=high, weights=self.weights),
        )


register_pytree(SumCost, static=("weights",))


def check_model(name: str, value: Any, wanted: str = "a σ model") -> None:
    """Raise a ValueError unless ``value`` is a σ model."""
    if isinstance(value, type) or not isinstance(value, CostModel):
        raise ValueError(f"{name} must be {wanted}, got {type(value).__name__}")


@cache
def lower_triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the lower triangle of an n × n matrix, row by row."""
    return np.tril_indices(n)


def _size(theta: Any) -> int:
    """Return n for a packed triangle of n (n + 1) / 2 entries."""
    return (int(np.sqrt(8 * theta.shape[-1] + 1)) - 1) // 2


def _pack(matrix: Any) -> Any:
    """Return the lower triangle (..., n (n + 1) / 2), row by row."""
    rows, columns = lower_triangle(matrix.shape[-1])
    return matrix[..., rows, columns]


def _join(first: Any, second: Any) -> Any:
    return array_module(first, second).concatenate([first, second], axis=-1)


def _unpack(theta: Any) -> Any:
    """Return the lower triangular matrix (..., n, n) with the entries ``theta``."""
    n = _size(theta)
    rows, columns = lower_triangle(n)
    # A product with a constant, since XLA's scatter (and its gradient) is slow on a CPU.
    places = np.zeros((rows.size, n * n))
    places[np.arange(rows.size), rows * n + columns] = 1.0
    return (theta @ places).reshape(*theta.shape[:-1], n, n)


def _semidefinite_factor(matrix: np.ndarray) -> np.ndarray:
    """Return the lower triangular L with L Lᵀ = matrix and a nonnegative diagonal."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        if matrix.ndim > 2:  # each by itself: a singular one does not touch the others
            return np.stack([_semidefinite_factor(one) for one in matrix])
        # A singular matrix has no unique Cholesky factor; the QR of a square root gives one.
        scaled, size = unit_diagonal(matrix)
        values, vectors = np.linalg.eigh(scaled)
        root = vectors * np.sqrt(np.clip(values, 0, None))
        lower = np.asarray(np.linalg.qr(root.T, mode="r")).T
        return size[:, None] * lower * np.where(np.diagonal(lower) < 0, -1.0, 1.0)
