"""Input-convex networks as σ, and the soft constraints that are one of them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import choice, finite_array, flag, instance, leading_shape
from prefmpc._pytree import bypass_init, constant_like, register_pytree
from prefmpc.models._network import (
    ACTIVATIONS,
    Over,
    StageNetwork,
    check_layers,
    drawn_from,
    last_size,
)
from prefmpc.systems.sets import Polyhedron

Activation = Literal["softplus", "relu", "squared_relu"]


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class ICNNCost(StageNetwork):
    """An input-convex network as σ: a convex function of the trajectory, whatever its weights.

    With v = (x_k, u_k) / scale, summed over the stages k = 0 … N−1 (``over="stage"``), or
    v = (x_0 … x_{N−1}, u_0 … u_{N−1}) / scale (``over="trajectory"``):

        z_1 = g(V_1 v + b_1),  z_{i+1} = g(U_i z_i + V_{i+1} v + b_{i+1}),
        σ = c·z_L + floor·‖v‖²

    with a convex nondecreasing g and nonnegative U_i, c (Amos, Xu and Kolter, 2017). A sum of
    convex functions with nonnegative weights is convex, and so is g of it.

    Build one with `random`; train it with `fit`, whose bounds keep it convex.

    Parameters
    ----------
    V : sequence of arrays (..., width_i, n_v)
    b : sequence of arrays (..., width_i)
    U : sequence of arrays (..., width_{i+1}, width_i)
        Nonnegative.
    c : array (..., width_L)
        Nonnegative.
    scale : array (n_x + n_u,)
        Positive; the size of each signal, so that v is of order one.
    activation : {"softplus", "relu", "squared_relu"}
        g(a) = log(1 + eᵃ), max(a, 0) or max(a, 0)².
    floor : float
        Nonnegative. Positive: σ is strictly convex.
    over : {"stage", "trajectory"}
    bias : bool
        False: all b are 0 and stay so. With a ReLU, squared or not, σ is then 0 at the origin and
        nowhere smaller: the set point is kept, whatever is learned.
    even : bool
        True: z_L is averaged over v and −v. An even convex function is nowhere smaller than at
        the origin, so that the set point is kept with biases too.

    Raises
    ------
    ValueError
        If a shape does not fit, or a weight that must not be negative is.
    """

    V: tuple[Any, ...]
    b: tuple[Any, ...]
    U: tuple[Any, ...]
    c: Any
    scale: tuple[float, ...]
    activation: Activation
    floor: float
    over: Over
    bias: bool
    even: bool

    reading = "V"

    def __init__(
        self,
        V: Sequence[ArrayLike],
        b: Sequence[ArrayLike],
        U: Sequence[ArrayLike],
        c: ArrayLike,
        *,
        scale: ArrayLike,
        activation: Activation = "softplus",
        floor: float = 0.0,
        over: Over = "stage",
        bias: bool = True,
        even: bool = False,
    ) -> None:
        choice("activation", activation, get_args(Activation))
        bias, even = flag("bias", bias), flag("even", even)
        given = {"V": V, "b": b, "U": U}
        layers = {name: check_layers(name, value) for name, value in given.items()}
        if not len(layers["V"]) == len(layers["b"]) == len(layers["U"]) + 1 >= 1:
            raise ValueError(
                "V, b and U must hold L, L and L − 1 layers with L ≥ 1, "
                f"got {len(layers['V'])}, {len(layers['b'])} and {len(layers['U'])}"
            )
        widths, n_v = [last_size(layer) for layer in layers["b"]], last_size(layers["V"][0])
        shapes: dict[str, list[tuple[int, ...]]] = {
            "V": [(width, n_v) for width in widths],
            "b": [(width,) for width in widths],
            "U": [(after, before) for before, after in itertools.pairwise(widths)],
            "c": [(widths[-1],)],
        }
        options = {"activation": activation, "bias": bias, "even": even}
        self._set(layers, shapes, c, scale=scale, over=over, floor=floor, **options)
        for i, offset in enumerate(self.b):
            if not bias and offset.any():
                raise ValueError(f"b[{i}] must be zero for a network without bias")
        signed = {**{f"U[{i}]": layer for i, layer in enumerate(self.U)}, "c": self.c}
        for name, array in signed.items():
            if (array < 0).any():
                raise ValueError(
                    f"{name} must not be negative, else σ is not convex; got {array.min():.3g}"
                )

    @property
    def columns(self) -> int:
        """Number of entries of v."""
        return int(self.V[0].shape[-1])

    def _units(self, v: Any) -> Any:
        act = ACTIVATIONS[self.activation]
        z = act(v @ self.V[0].T + self.b[0])
        for V, b, U in zip(self.V[1:], self.b[1:], self.U, strict=True):
            z = act(z @ U.T + v @ V.T + b)
        return z

    def bounds(self) -> tuple[ICNNCost, ICNNCost]:
        """Return the bounds that keep σ convex as two models: U ≥ 0, c ≥ 0; without bias b = 0."""
        low, high, zero = (constant_like(self, value) for value in (-np.inf, np.inf, 0.0))
        held = {} if self.bias else {"b": zero.b}
        return _with(low, U=zero.U, c=zero.c, **held), _with(high, **held)

    @classmethod
    def random(
        cls,
        scale: ArrayLike,
        *,
        key: Any,
        widths: Sequence[int] = (16, 16),
        steps: int | None = None,
        shape: tuple[int, ...] = (),
        activation: Activation = "softplus",
        floor: float = 0.0,
        bias: bool = True,
        even: bool = False,
    ) -> ICNNCost:
        """Draw a stack of networks to start training from.

        Parameters
        ----------
        scale : array (n_x + n_u,)
            The size of each state and input.
        widths : sequence of int
            Units of each hidden layer.
        steps : int, optional
            The network then looks at whole trajectories of so many steps, instead of stages.
        shape : leading shape of the stack.
        activation, floor, bias, even : as for the class.
        """
        size, (n_v, *sizes), over, rng = drawn_from(scale, widths, steps, key)
        shape, bias = leading_shape("shape", shape), flag("bias", bias)
        V = [rng.standard_normal((*shape, width, n_v)) / np.sqrt(n_v) for width in sizes]
        b = [bias * 0.1 * rng.standard_normal((*shape, width)) for width in sizes]
        U = [
            rng.uniform(0, 2 / before, (*shape, after, before))
            for before, after in itertools.pairwise(sizes)
        ]
        c = rng.uniform(0, 2 / sizes[-1], (*shape, sizes[-1]))
        options: dict[str, Any] = {"activation": activation, "bias": bias, "even": even}
        return cls(V, b, U, c, scale=size, over=over, floor=floor, **options)


def soft_constraints(constraints: Polyhedron, weight: ArrayLike) -> ICNNCost:
    """Return the penalty Σ_k weightᵀ max(H z_k − h, 0), z_k = (x_k, u_k), as a σ of its own.

    Added to another σ by `SumCost` it lets the constraints be broken, at a price for each unit of
    H z − h. If the weights exceed the multipliers of the same constraints made hard, the plan is
    the same as with hard ones wherever these can be met. With H = [I; −I] and h = 0 it is
    ``Σ weight·|z|``.

    Parameters
    ----------
    constraints : Polyhedron
        Over (x, u), with at least one row.
    weight : float or array (m,)
        Nonnegative.
    """
    instance("constraints", constraints, Polyhedron)
    if not len(constraints.h):
        raise ValueError("constraints must have at least one row, got none")
    price = np.asarray(finite_array("weight", weight))
    if price.shape not in ((), constraints.h.shape) or (price < 0).any():
        raise ValueError(
            f"weight must be one or {len(constraints.h)} nonnegative numbers, got {price}"
        )
    c = np.broadcast_to(price, constraints.h.shape)
    ones = np.ones(constraints.dim)
    return ICNNCost([constraints.H], [-constraints.h], [], c, scale=ones, activation="relu")


register_pytree(ICNNCost, static=("scale", "activation", "floor", "over", "bias", "even"))


def _with(model: ICNNCost, **values: Any) -> ICNNCost:
    return bypass_init(ICNNCost, **{**vars(model), **values})
