"""A plain neural network as σ: it can be anything, convex or not."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import choice, leading_shape
from prefmpc._pytree import constant_like, register_pytree
from prefmpc.models._network import (
    ACTIVATIONS,
    Over,
    StageNetwork,
    check_layers,
    drawn_from,
    last_size,
)

MLPActivation = Literal["relu", "tanh", "softplus"]


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class MLPCost(StageNetwork):
    """A feed-forward network as σ (arXiv 2511.22502, section II-B); it need not be convex.

    With v = (x_k, u_k) / scale, summed over the stages k = 0 … N−1 (``over="stage"``), or
    v = (x_0 … x_{N−1}, u_0 … u_{N−1}) / scale (``over="trajectory"``):

        z_1 = g(W_1 v + b_1),  z_{i+1} = g(W_{i+1} z_i + b_{i+1}),  σ = c·z_L + floor·‖v‖²

    Nothing keeps it from falling without end where there were no data: give it a ``floor``, or
    add a `QuadraticCost` by `SumCost`. Build one with `random`; train it with `fit_network`.

    Parameters
    ----------
    W : sequence of arrays (..., width_i, width_{i−1}), with width_0 = n_v
    b : sequence of arrays (..., width_i)
    c : array (..., width_L)
    scale : array (n_x + n_u,)
        Positive; the size of each signal, so that v is of order one.
    activation : {"tanh", "softplus", "relu"}
        g(a) = tanh(a), log(1 + eᵃ) or max(a, 0). The last is not smooth.
    floor : float
        Nonnegative.
    over : {"stage", "trajectory"}

    Raises
    ------
    ValueError
        If a shape does not fit, or something is not finite.
    """

    W: tuple[Any, ...]
    b: tuple[Any, ...]
    c: Any
    scale: tuple[float, ...]
    activation: MLPActivation
    floor: float
    over: Over

    reading = "W[0]"

    def __init__(
        self,
        W: Sequence[ArrayLike],
        b: Sequence[ArrayLike],
        c: ArrayLike,
        *,
        scale: ArrayLike,
        activation: MLPActivation = "tanh",
        floor: float = 0.0,
        over: Over = "stage",
    ) -> None:
        choice("activation", activation, get_args(MLPActivation))
        layers = {"W": check_layers("W", W), "b": check_layers("b", b)}
        if not len(layers["W"]) == len(layers["b"]) >= 1:
            raise ValueError(
                f"W and b must hold the same number of layers, at least one, "
                f"got {len(layers['W'])} and {len(layers['b'])}"
            )
        widths = [last_size(layers["W"][0]), *map(last_size, layers["b"])]
        shapes: dict[str, list[tuple[int, ...]]] = {
            "W": [(after, before) for before, after in itertools.pairwise(widths)],
            "b": [(width,) for width in widths[1:]],
            "c": [(widths[-1],)],
        }
        self._set(layers, shapes, c, scale=scale, over=over, floor=floor, activation=activation)

    @property
    def columns(self) -> int:
        """Number of entries of v."""
        return int(self.W[0].shape[-1])

    def _units(self, v: Any) -> Any:
        g = ACTIVATIONS[self.activation]
        z = v
        for W, b in zip(self.W, self.b, strict=True):
            z = g(z @ W.T + b)
        return z

    def bounds(self) -> tuple[MLPCost, MLPCost]:
        """Return infinite bounds: every weight may be anything."""
        return constant_like(self, -np.inf), constant_like(self, np.inf)

    @classmethod
    def random(
        cls,
        scale: ArrayLike,
        *,
        key: Any,
        widths: Sequence[int] = (16, 16),
        steps: int | None = None,
        shape: tuple[int, ...] = (),
        activation: MLPActivation = "tanh",
        floor: float = 0.0,
    ) -> MLPCost:
        """Draw a stack of networks to start training from (weights of Glorot's size).

        Parameters
        ----------
        scale : array (n_x + n_u,)
            The size of each state and input.
        widths : sequence of int
            Units of each hidden layer.
        steps : int, optional
            The network then looks at whole trajectories of so many steps, instead of stages.
        shape : leading shape of the stack.
        activation, floor : as for the class.
        """
        size, sizes, over, rng = drawn_from(scale, widths, steps, key)
        shape = leading_shape("shape", shape)

        def layer(after: int, before: int) -> np.ndarray:
            return rng.standard_normal((*shape, after, before)) * np.sqrt(2 / (after + before))

        W = [layer(after, before) for before, after in itertools.pairwise(sizes)]
        b = [0.1 * rng.standard_normal((*shape, width)) for width in sizes[1:]]
        c = layer(1, sizes[-1])[..., 0, :]
        return cls(W, b, c, scale=size, activation=activation, floor=floor, over=over)


register_pytree(MLPCost, static=("scale", "activation", "floor", "over"))
