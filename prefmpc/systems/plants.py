"""Two standard nonlinear plants: a car that steers, and a pendulum on a cart."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from prefmpc._checks import positive
from prefmpc.systems.nonlinear import NonlinearSystem

GRAVITY = 9.81


def kinematic_bicycle(
    *,
    wheelbase: float = 2.7,
    dt: float = 0.2,
    steering_rate: float = 0.4,
    brake: float = 4.0,
    throttle: float = 2.0,
) -> NonlinearSystem:
    """Return a car as a kinematic bicycle whose wheels roll without slip.

    State (lateral position p in m, heading ψ in rad, steering angle δ in rad, speed v in m/s),
    input (steering rate in rad/s, acceleration in m/s²), output (p, ψ, lateral acceleration
    v²·tan(δ)/L in m/s², v), with the rear axle as the point of reference:

        ṗ = v sin ψ,  ψ̇ = v tan(δ)/L,  δ̇ = u₁,  v̇ = u₂

    The position along the road is left out: nothing here depends on it. See Rajamani, Vehicle
    Dynamics and Control (2012), section 2.2. Good as long as the tyres slip little, which for
    lateral accelerations below about half of gravity they do.

    Parameters
    ----------
    wheelbase : float
        L in m.
    dt : float
        Sample time in s.
    steering_rate : float
        Largest rate of the steering angle in rad/s, both ways.
    brake, throttle : float
        Largest deceleration and acceleration in m/s².

    Raises
    ------
    ValueError
        If a number is not positive.
    """
    given = {"wheelbase": wheelbase, "steering_rate": steering_rate}
    for name, value in {**given, "brake": brake, "throttle": throttle}.items():
        positive(name, value)
    return NonlinearSystem.from_continuous(
        _Rolling(float(wheelbase)),
        _BicycleOutput(float(wheelbase)),
        nx=4,
        nu=2,
        dt=dt,
        u_min=np.array([-steering_rate, -brake]),
        u_max=np.array([steering_rate, throttle]),
    )


# Plants made twice are equal, so that they are compiled once; and these can be pickled.


@dataclasses.dataclass(frozen=True)
class _Rolling:
    wheelbase: float

    def __call__(self, x: Any, u: Any) -> Any:
        _, heading, steering, speed = x
        turn = speed * jnp.tan(steering) / self.wheelbase
        return jnp.stack([speed * jnp.sin(heading), turn, u[0], u[1]])


@dataclasses.dataclass(frozen=True)
class _BicycleOutput:
    wheelbase: float

    def __call__(self, x: Any) -> Any:
        p, heading, steering, speed = x
        return jnp.stack([p, heading, speed**2 * jnp.tan(steering) / self.wheelbase, speed])


def cart_pendulum(
    *,
    cart: float = 1.0,
    bob: float = 0.2,
    length: float = 0.5,
    dt: float = 0.05,
    force: float = 10.0,
) -> NonlinearSystem:
    """Return a pendulum on a cart: a point mass on a light rod, no friction.

    State (position p in m, angle θ in rad from upright, their rates), input the force on the cart
    in N, output (p, θ):

        (M + m) p̈ + m l θ̈ cos θ − m l θ̇² sin θ = u
        l θ̈ + p̈ cos θ − g sin θ = 0

    See Åström and Furuta, Swinging up a pendulum by energy control, Automatica 36 (2000).

    Parameters
    ----------
    cart, bob : float
        Masses M and m in kg.
    length : float
        l in m.
    dt : float
        Sample time in s.
    force : float
        Largest force in N, both ways.

    Raises
    ------
    ValueError
        If a number is not positive.
    """
    for name, value in {"cart": cart, "bob": bob, "length": length, "force": force}.items():
        positive(name, value)
    flow = _CartPendulum(float(cart), float(bob), float(length))
    return NonlinearSystem.from_continuous(
        flow, _position_and_angle, nx=4, nu=1, dt=dt, u_min=-force, u_max=force
    )


@dataclasses.dataclass(frozen=True)
class _CartPendulum:
    cart: float
    bob: float
    length: float

    def __call__(self, x: Any, u: Any) -> Any:
        _, angle, speed, rate = x
        bob, length = self.bob, self.length
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        push = u[0] + bob * length * rate**2 * sin - bob * GRAVITY * sin * cos
        acceleration = push / (self.cart + bob * sin**2)
        return jnp.stack([speed, rate, acceleration, (GRAVITY * sin - acceleration * cos) / length])


def _position_and_angle(x: Any) -> Any:
    return x[:2]
