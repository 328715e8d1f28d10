"""What networks over stages or whole trajectories have in common, whatever their layers."""

from __future__ import annotations

from typing import Any, Literal, Self, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, instance, shaped
from prefmpc._pytree import check_index
from prefmpc.trajectories import Trajectory

Over = Literal["stage", "trajectory"]

ACTIVATIONS: dict[str, Any] = {
    "softplus": jax.nn.softplus,
    "relu": jax.nn.relu,
    "squared_relu": lambda a: jax.nn.relu(a) ** 2,
    "tanh": jnp.tanh,
}


class StageNetwork:
    """A network of v = (x_k, u_k) / scale, over single stages or all of them at once."""

    scale: tuple[float, ...]
    over: Over
    c: Any

    linear_in_features = False

    @property
    def columns(self) -> int:
        """Number of entries of v."""
        raise NotImplementedError

    floor: float
    even = False

    def _units(self, v: Any) -> Any:
        """Return the last layer's units (..., width) for v (..., n_v)."""
        raise NotImplementedError

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of models; () for one."""
        return tuple(self.c.shape[:-1])

    def __getitem__(self, index: Any) -> Self:
        """Index the leading dimensions of a stack of models."""
        if not self.batch_shape:
            raise IndexError(f"a single {type(self).__name__} has no batch dimension to index")
        check_index(index, self.batch_shape[0])
        return jax.tree.map(lambda leaf: leaf[index], self)

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
    if over not in get_args(Over):
        raise ValueError(f"over must be one of {get_args(Over)}, got {over!r}")
    size = np.asarray(finite_array("scale", scale, ndim=1))
    if size.size == 0 or (size <= 0).any():
        raise ValueError(f"scale must hold positive numbers, got {size}")
    return size


def check_columns(name: str, columns: int, signals: int, over: str) -> None:
    """Raise a ValueError unless a first layer fits the number of signals."""
    if (columns % signals or columns == 0) if over == "trajectory" else columns != signals:
        raise ValueError(
            f"{name} must have {'a multiple of ' if over == 'trajectory' else ''}{signals} "
            f"columns, the entries of v, got {columns}"
        )


def _plain(*trees: Any) -> bool:
    return all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(trees))


@jax.jit
def _score(model: StageNetwork, features: Any) -> Any:
    return model.score(features)
