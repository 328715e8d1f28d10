"""What networks over stages or whole trajectories have in common, whatever their layers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import (
    choice,
    finite_array,
    instance,
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

    linear_in_features = False

    @property
    def columns(self) -> int:
        """Number of entries of v."""
        raise NotImplementedError

    def _units(self, v: Any) -> Any:
        """Return the last layer's units (..., width) for v (..., n_v)."""
        raise NotImplementedError

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
        if _plain(features, self):
            return np.asarray(_score(self, features))
        return self.score(features)

    @staticmethod
    def features(trajectory: Trajectory) -> Any:
        """Return the stages (x_k, u_k) or their deviations, shape (..., N, nx + nu)."""
        trajectory = trajectory.deviation()
        xp = np if _plain(trajectory) else jnp
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


def check_scale(scale: ArrayLike, over: str) -> np.ndarray:
    """Return the sizes of the signals, or raise a ValueError."""
    choice("over", over, get_args(Over))
    return positive_vector("scale", scale)


def check_layers(name: str, value: Any) -> list[np.ndarray]:
    """Return the weights of all layers as arrays, or raise a ValueError."""
    layers = sequence(name, value, "a sequence of arrays, one a layer")
    return [np.asarray(finite_array(f"{name}[{i}]", layer)) for i, layer in enumerate(layers)]


def check_columns(name: str, columns: int, signals: int, over: str) -> None:
    """Raise a ValueError unless a first layer fits the number of signals."""
    if (columns % signals or columns == 0) if over == "trajectory" else columns != signals:
        raise ValueError(
            f"{name} must have {'a multiple of ' if over == 'trajectory' else ''}{signals} "
            f"columns, the entries of v, got {columns}"
        )


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


def _plain(*trees: Any) -> bool:
    return all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(trees))


@jax.jit
def _score(model: StageNetwork, features: Any) -> Any:
    return model.score(features)
