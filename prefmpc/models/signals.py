"""Which signals of a trajectory σ sees: states, outputs, increments, x(0) alone, set points."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from prefmpc._checks import array_module, instance, sequence
from prefmpc._pytree import Stack, bypass_init, register_pytree
from prefmpc.models.quadratic import CostModel, check_model
from prefmpc.preferences.trajectories import Trajectory

Name = Literal["x", "y", "du", "dy", "x_r", "u_r", "x0"]
Signal = str
"""A name, or some channels of one: "y", "y[0,2]"."""

_CHANNELS = re.compile(r"([a-z_0]+?)(?:\[(\d+(?:,\d+)*)\])?")


def select(trajectory: Trajectory, signals: Sequence[Signal]) -> Trajectory:
    """Return a trajectory with the chosen signals in the place of the states.

    A σ model of (X, U) applied to it is a model of those signals and U. Implements the remark
    on what σ may depend on (arXiv 2511.22502, section II-B).

    Parameters
    ----------
    trajectory : Trajectory
        Any leading shape. With a set point, x, y and u are deviations from it.
    signals : sequence of str, at least one of
        "x" and "y": states and outputs;
        "du" and "dy": the increments u_k − u_{k−1} and y_k − y_{k−1}; the first one is
        u_0 − u_before, and 0 if that is not known;
        "x_r" and "u_r": the set point, the same at every step;
        a name with channels, such as "y[0,2]": these alone;
        "x0", which stands alone: σ of (x_0, U). The result has a single step, whose state is
        (x_0, u_0 … u_{N−1}) and whose input is u_0.

    Raises
    ------
    ValueError
        If a signal is not known, named twice, or not there.
    """
    instance("trajectory", trajectory, Trajectory)
    names = check_signals(signals)
    plain = trajectory.deviation()
    xp = array_module(trajectory.x, trajectory.u, trajectory.y)
    if names == ("x0",):
        steps = plain.u.reshape(*plain.u.shape[:-2], -1)
        state = xp.concatenate([plain.x[..., 0, :], steps], axis=-1)[..., None, :]
        first = plain.u[..., :1, :]
        return _view(xp, state, first)
    parts = [_channels(name, trajectory, plain, xp) for name in names]
    return _view(xp, xp.concatenate(parts, axis=-1), plain.u)


def check_signals(signals: Sequence[Signal]) -> tuple[Signal, ...]:
    """Return the signals as a tuple, or raise a ValueError."""
    names = (signals,) if isinstance(signals, str) else tuple(sequence("signals", signals))
    known = get_args(Name)
    if not names or not all(_split(n)[0] in known for n in names) or len(set(names)) < len(names):
        raise ValueError(f"signals must name different ones of {known}, got {signals!r}")
    if "x0" in names and len(names) > 1:
        raise ValueError(f'signals must hold "x0" alone or not at all, got {signals!r}')
    return names


def _split(signal: Any) -> tuple[str, list[int] | None]:
    """Return the name and the channels of "y[0,2]"; None for all of them."""
    found = _CHANNELS.fullmatch(signal) if isinstance(signal, str) else None
    if found is None:
        return "", None
    name, channels = found.groups()
    if channels is None:
        return name, None
    return ("" if name == "x0" else name), [int(c) for c in channels.split(",")]


def _view(xp: Any, states: Any, inputs: Any) -> Trajectory:
    # No σ weighs the last state: it only has to be there.
    x = xp.concatenate([states, states[..., -1:, :]], axis=-2)
    return bypass_init(Trajectory, x=x, u=inputs, y=states)


def _channels(signal: Signal, trajectory: Trajectory, plain: Trajectory, xp: Any) -> Any:
    name, channels = _split(signal)
    values = _signal(name, trajectory, plain, xp)
    if channels is None:
        return values
    if max(channels) >= values.shape[-1]:
        raise ValueError(f"signals must name channels below {values.shape[-1]}, got {signal!r}")
    return values[..., np.asarray(channels)]


def _signal(name: str, trajectory: Trajectory, plain: Trajectory, xp: Any) -> Any:
    """Return one signal (..., N, n)."""
    if name == "x":
        return plain.x[..., :-1, :]
    if name == "y":
        if trajectory.x_r is not None and trajectory.y_r is None:
            raise ValueError('signals must not hold "y" where a set point comes without its y_r')
        return plain.y
    if name in ("du", "dy"):
        values = plain.u if name == "du" else plain.y
        before = plain.u_before if name == "du" else None
        first = values[..., :1, :] if before is None else before[..., None, :]
        return values - xp.concatenate([first, values[..., :-1, :]], axis=-2)
    value = trajectory.x_r if name == "x_r" else trajectory.u_r
    if value is None:
        raise ValueError(f'signals must not hold "{name}" where trajectories have no set point')
    steps = trajectory.u.shape[-2]
    return xp.broadcast_to(value[..., None, :], (*value.shape[:-1], steps, value.shape[-1]))


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class SignalCost(Stack):
    """A σ model of chosen signals and the inputs: σ(T) = model(select(T, signals)).

    ``SignalCost(QuadraticCost(Q, R), "y")`` is σ(Y, U) = Σ_k y_kᵀQy_k + u_kᵀRu_k.

    Parameters
    ----------
    model : σ model
        Its states are the chosen signals, stacked in the order in which they are named.
    signals : sequence of str
        See `select`.

    Raises
    ------
    ValueError
        If the model is not a σ model or a signal is not known.
    """

    model: Any
    signals: tuple[Signal, ...]

    def __init__(self, model: CostModel, signals: Sequence[Signal]) -> None:
        check_model("model", model)
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "signals", check_signals(signals))

    @property
    def linear_in_features(self) -> bool:
        """As the model itself."""
        return bool(self.model.linear_in_features)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape of a stack of models; () for one."""
        return tuple(getattr(self.model, "batch_shape", ()))

    def __call__(self, trajectory: Trajectory) -> Any:
        """Return σ(T) for every trajectory of a batch, shape (...)."""
        return self.model(select(trajectory, self.signals))

    def features(self, trajectory: Trajectory) -> Any:
        """Return what the model needs of the chosen signals."""
        return self.model.features(select(trajectory, self.signals))

    def score(self, features: Any) -> Any:
        """Return σ (...) from the features."""
        return self.model.score(features)

    def bounds(self) -> tuple[SignalCost, SignalCost]:
        """Return the bounds of the model."""
        low, high = (
            bypass_init(SignalCost, model=side, signals=self.signals)
            for side in self.model.bounds()
        )
        return low, high


register_pytree(SignalCost, static=("signals",))
