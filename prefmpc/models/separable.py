"""A convex σ of one signal at a time: what each of them costs can be drawn as a curve."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    array_module,
    broadcasts,
    finite_array,
    instance,
    is_whole,
    leading_shape,
    positive_vector,
)
from prefmpc._pytree import Stack, constant_like, register_pytree
from prefmpc.preferences.trajectories import Trajectory

SHAPES = ("absolute", "square", "fourth")
KINK = 7.0
LEAST = 1e-4


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class SeparableCost(Stack):
    """σ(T) = Σ_k Σ_i h_i(v_ki), with v_k = (x_k, u_k) / scale and one curve h_i for each signal.

    Each curve mixes three even, convex shapes with nonnegative weights c_1i, c_2i and c_3i:

        h_i(v) = c_1i·(√(1 + (7v)²) − 1)/7 + c_2i·v² + c_3i·v⁴

    The first grows like the absolute value: far away it asks no more for a metre than near by, so
    that a long way takes longer. The last hardly sees small values and forbids large ones. σ is
    linear in the weights, so that learning them is a convex problem; with c_2i > 0 it is strictly
    convex in the signals, and least at the set point.

    Parameters
    ----------
    c : array (..., 3, n_x + n_u)
        Nonnegative.
    scale : array (n_x + n_u,)
        Positive; the size of each signal, in its unit.

    Raises
    ------
    ValueError
        If a shape does not fit, a weight is negative, or a scale is not positive.
    """

    c: Any
    scale: tuple[float, ...]

    linear_in_features = True

    def __init__(self, c: ArrayLike, *, scale: ArrayLike) -> None:
        size = positive_vector("scale", scale)
        weights = np.asarray(finite_array("c", c))
        if weights.shape[-2:] != (len(SHAPES), size.size):
            raise ValueError(f"c must have shape (..., 3, {size.size}), got {weights.shape}")
        if (weights < 0).any():
            raise ValueError(f"c must not be negative, else σ is not convex; got {weights.min()}")
        object.__setattr__(self, "c", weights)
        object.__setattr__(self, "scale", tuple(float(s) for s in size))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of models; () for one."""
        return tuple(self.c.shape[:-2])

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) for every trajectory of a batch, shape (...)."""
        instance("trajectory", trajectory, Trajectory)
        broadcasts("trajectory", trajectory.batch_shape, self.batch_shape)
        signals = trajectory.x.shape[-1] + trajectory.u.shape[-1]
        if signals != len(self.scale):
            raise ValueError(f"trajectory must have {len(self.scale)} signals, got {signals}")
        return self.score(self.features(trajectory))

    def features(self, trajectory: Trajectory) -> Any:
        """Return the sums over time of the three shapes of every signal, (..., 3·n)."""
        plain = trajectory.deviation()
        xp = array_module(plain.x, plain.u)
        v = xp.concatenate([plain.x[..., :-1, :], plain.u], axis=-1) / np.asarray(self.scale)
        shapes = ((xp.sqrt(1 + (KINK * v) ** 2) - 1) / KINK, v**2, v**4)
        return xp.concatenate([shape.sum(-2) for shape in shapes], axis=-1)

    def score(self, features: Any) -> Any:
        """Return σ (...) from the features."""
        weights = self.c.reshape(*self.batch_shape, -1)
        return (features * weights).sum(-1) if self.batch_shape else features @ weights

    def curve(self, signal: int, values: ArrayLike) -> np.ndarray:
        """Return h_i for values of one signal, in its unit: what a single step of it costs."""
        if not is_whole(signal) or not 0 <= signal < len(self.scale):
            raise ValueError(f"signal must lie in [0, {len(self.scale) - 1}], got {signal}")
        v = np.asarray(finite_array("values", values)) / self.scale[signal]
        absolute, square, fourth = np.moveaxis(np.asarray(self.c)[..., signal], -1, 0)
        return absolute * (np.sqrt(1 + (KINK * v) ** 2) - 1) / KINK + square * v**2 + fourth * v**4

    def bounds(self) -> tuple[SeparableCost, SeparableCost]:
        """Return the bounds on c as two models: at least 1e-4."""
        return constant_like(self, LEAST), constant_like(self, np.inf)

    @classmethod
    def start(cls, scale: ArrayLike, *, shape: tuple[int, ...] = ()) -> SeparableCost:
        """Return small equal weights to start training from; a convex problem needs no restarts."""
        size = positive_vector("scale", scale)
        return cls(
            np.full((*leading_shape("shape", shape), len(SHAPES), size.size), 0.01), scale=size
        )


register_pytree(SeparableCost, static=("scale",))
