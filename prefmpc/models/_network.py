"""What networks over stages or whole trajectories have in common, whatever their layers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    array_module,
    choice,
    finite_array,
    instance,
    nonnegative,
    positive_int,
    positive_vector,
    require_x64,
    sequence,
    shaped,
)
from prefmpc._pytree import Stack
from prefmpc._random import generator
from prefmpc.preferences.trajectories import Trajectory

Over = Literal["stage", "trajectory"]

ACTIVATIONS: dict[str, Any] = {
    "softplus": jax.nn.softplus,
    "relu": jax.nn.relu,
    "squared_relu": lambda a: jax.nn.relu(a) ** 2,
    "tanh": jnp.tanh,
}


class StageNetwork(Stack):
    """A network of v = (x_k, u_k) / scale, over single stages or all of them at once."""

    scale: tuple[float, ...]
    over: Over
    c: Any
    floor: float
    even = False

    reading: ClassVar[str]
    """Name of the weights that v is multiplied with."""

    linear_in_features = False

    @property
    def columns(self) -> int:
        """Number of entries of v."""
        raise NotImplementedError

    def _units(self, v: Any) -> Any:
        """Return the last layer's units (..., width) for v (..., n_v)."""
        raise NotImplementedError

    def _set(
        self,
        layers: dict[str, list[np.ndarray]],
        shapes: dict[str, list[tuple[int, ...]]],
        c: ArrayLike,
        *,
        scale: ArrayLike,
        over: Over,
        floor: float,
        **options: Any,
    ) -> None:
        """Set all fields; a ValueError unless the layers have these shapes after leading ones."""
        choice("over", over, get_args(Over))
        size = positive_vector("scale", scale)
        out = np.asarray(finite_array("c", c))
        for name, arrays in {**layers, "c": [out]}.items():
            for i, (array, shape) in enumerate(zip(arrays, shapes[name], strict=True)):
                if array.shape != (*out.shape[:-1], *shape):
                    label = name if name == "c" else f"{name}[{i}]"
                    wanted = (*out.shape[:-1], *shape)
                    raise ValueError(f"{label} must have shape {wanted}, got {array.shape}")
        columns = next(iter(layers.values()))[0].shape[-1]
        multiple = "a multiple of " if over == "trajectory" else ""
        if (columns % size.size or not columns) if multiple else columns != size.size:
            raise ValueError(
                f"{self.reading} must have {multiple}{size.size} columns, the entries of v, "
                f"got {columns}"
            )
        values = {**{name: tuple(arrays) for name, arrays in layers.items()}, "c": out, **options}
        values |= {"scale": tuple(map(float, size)), "floor": nonnegative("floor", floor)}
        for name, value in {**values, "over": over}.items():
            object.__setattr__(self, name, value)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of models; () for one."""
        return tuple(self.c.shape[:-1])

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) for every trajectory of a batch, shape (...). For a single model."""
        instance("trajectory", trajectory, Trajectory)
        if self.batch_shape:
            raise ValueError(f"the model must be a single one, got a stack {self.batch_shape}")
        nx, nu = trajectory.x.shape[-1], trajectory.u.shape[-1]
        if nx + nu != len(self.scale):
            raise ValueError(
                f"trajectory must have {len(self.scale)} states and inputs, got {nx} and {nu}"
            )
        features = self.features(trajectory)
        if self.over == "trajectory":
            steps = self.columns // len(self.scale)
            shaped("trajectory.u", trajectory.u, (steps, nu), "as many steps as the model has")
        if array_module(features, *jax.tree.leaves(self)) is np:
            return np.asarray(_score(self, features))
        return self.score(features)

    @staticmethod
    def features(trajectory: Trajectory) -> Any:
        """Return the stages (x_k, u_k) or their deviations, shape (..., N, nx + nu)."""
        trajectory = trajectory.deviation()
        xp = array_module(trajectory.x, trajectory.u)
        return xp.concatenate([trajectory.x[..., :-1, :], trajectory.u], axis=-1)

    def score(self, features: Any) -> Any:
        """Return σ (...) from stages (..., N, nx + nu)."""
        v = features / np.asarray(self.scale)
        if self.over == "trajectory":
            v = v.reshape(*v.shape[:-2], 1, -1)
        units = self._units(v)
        if self.even:
            units = (units + self._units(-v)) / 2
        return (units @ self.c).sum(-1) + self.floor * (v * v).sum((-2, -1))


def last_size(array: np.ndarray) -> int:
    """Return the size of the last dimension, 0 if there is none."""
    return array.shape[-1] if array.ndim else 0


def check_layers(name: str, value: Any) -> list[np.ndarray]:
    """Return the weights of all layers as arrays, or raise a ValueError."""
    layers = sequence(name, value, "a sequence of arrays, one a layer")
    return [np.asarray(finite_array(f"{name}[{i}]", layer)) for i, layer in enumerate(layers)]


def drawn_from(
    scale: ArrayLike, widths: Sequence[int], steps: int | None, key: Any
) -> tuple[np.ndarray, list[int], Over, np.random.Generator]:
    """Return what random networks start with: the sizes of the signals and of all layers, v first.

    Raises a ValueError if there is no layer, or a number is not positive.
    """
    require_x64()
    size = positive_vector("scale", scale)
    sizes = [
        positive_int(f"widths[{i}]", width) for i, width in enumerate(sequence("widths", widths))
    ]
    if not sizes:
        raise ValueError("widths must name at least one layer, got none")
    n_v = size.size if steps is None else size.size * positive_int("steps", steps)
    return size, [n_v, *sizes], "stage" if steps is None else "trajectory", generator(key)


@jax.jit
def _score(model: StageNetwork, features: Any) -> Any:
    return model.score(features)
