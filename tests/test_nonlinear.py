"""Nonlinear plants against SciPy's integrators, physics, finite differences and linear plants."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from prefmpc import (
    LinearSystem,
    NonlinearSystem,
    cart_pendulum,
    kinematic_bicycle,
    oscillating_masses,
    random_states,
    rollout,
    simulate,
)
from prefmpc.systems.plants import GRAVITY

CAR, PENDULUM = kinematic_bicycle(), cart_pendulum()
RNG = np.random.default_rng(0)


def car_flow(x, u):
    _, heading, steering, speed = x
    return np.array([speed * np.sin(heading), speed * np.tan(steering) / 2.7, *u])


def pendulum_flow(x, u, cart=1.0, bob=0.2, length=0.5):
    """The equations of motion as they stand in the docstring, as one linear system."""
    _, angle, speed, rate = x
    sin, cos = np.sin(angle), np.cos(angle)
    mass = np.array([[cart + bob, bob * length * cos], [cos, length]])
    push = np.array([u[0] + bob * length * rate**2 * sin, GRAVITY * sin])
    return np.array([speed, rate, *np.linalg.solve(mass, push)])


PLANTS = {
    "car": (CAR, car_flow, [0.5, 0.1, 0.1, 15.0], [0.2, 1.5]),
    "pendulum": (PENDULUM, pendulum_flow, [0.3, 2.0, -0.4, 3.0], [6.0]),
}


def flow_of(name):
    """The same flow for JAX, without the plant's own code."""
    if name == "car":
        return lambda x, u: jnp.stack(
            [x[3] * jnp.sin(x[1]), x[3] * jnp.tan(x[2]) / 2.7, u[0], u[1]]
        )

    def flow(x, u):
        sin, cos = jnp.sin(x[1]), jnp.cos(x[1])
        mass = jnp.array([[1.2, 0.1 * cos], [cos, 0.5]])
        push = jnp.array([u[0] + 0.1 * x[3] ** 2 * sin, GRAVITY * sin])
        return jnp.concatenate([x[2:], jnp.linalg.solve(mass, push)])

    return flow


def exact(flow, x, u, dt):
    solution = solve_ivp(
        lambda _, z: flow(z, u), (0, dt), x, method="DOP853", rtol=1e-12, atol=1e-13
    )
    return solution.y[:, -1]


@pytest.mark.parametrize("name", PLANTS)
def test_a_step_is_that_of_an_accurate_integrator(name):
    system, flow, x, u = PLANTS[name]
    x, u = np.array(x), np.array(u)
    np.testing.assert_allclose(system.step(x, u), exact(flow, x, u, system.dt), atol=2e-4)
    fine = NonlinearSystem.from_continuous(
        flow_of(name), nx=4, nu=len(u), dt=system.dt, substeps=20
    )
    np.testing.assert_allclose(fine.step(x, u), exact(flow, x, u, system.dt), atol=1e-8)


@pytest.mark.parametrize("name", PLANTS)
def test_the_error_falls_with_the_fourth_power_of_the_step(name):
    system, flow, x, u = PLANTS[name]
    truth = exact(flow, np.array(x), np.array(u), system.dt)
    errors = []
    for substeps in (2, 4, 8):
        made = NonlinearSystem.from_continuous(
            flow_of(name), nx=4, nu=len(u), dt=system.dt, substeps=substeps
        )
        errors.append(np.linalg.norm(made.step(np.array(x), np.array(u)) - truth))
    ratios = np.array(errors[:-1]) / errors[1:]
    np.testing.assert_allclose(ratios, 16, rtol=0.2)


def test_a_linear_flow_gives_the_exactly_discretised_plant():
    A, B = np.array([[0.0, 1], [-4, -0.5]]), np.array([[0.0], [1]])
    linear = LinearSystem.from_continuous(A, B, dt=0.2, u_max=1.0)
    made = NonlinearSystem.from_continuous(
        lambda x, u: A @ x + B @ u, nx=2, nu=1, dt=0.2, substeps=20, u_max=1.0
    )
    x, u = RNG.normal(size=(7, 2)), RNG.normal(size=(7, 1))
    np.testing.assert_allclose(made.step(x, u), linear.step(x, u), atol=1e-8)
    near = made.linearise([0.3, -2.0], [0.4])
    np.testing.assert_allclose(near.A, linear.A, atol=1e-8)
    np.testing.assert_allclose(near.B, linear.B, atol=1e-8)
    np.testing.assert_array_equal(near.C, np.eye(2))
    np.testing.assert_allclose([near.u_min, near.u_max], [[-np.inf], [0.6]])


@pytest.mark.parametrize("name", PLANTS)
def test_the_jacobians_are_those_of_finite_differences(name):
    system, _, x, u = PLANTS[name]
    for _ in range(3):
        at = np.array(x) + 0.1 * RNG.normal(size=4)
        near = system.linearise(at, u)

        def slope(call, value):
            steps = 1e-5 * np.eye(len(value))
            return np.stack([(call(value + e) - call(value - e)) / 2e-5 for e in steps], axis=1)

        options = {"rtol": 1e-7, "atol": 1e-8}
        np.testing.assert_allclose(
            near.A, slope(lambda z: system.step(z, np.array(u)), at), **options
        )
        np.testing.assert_allclose(
            near.B, slope(lambda v, at=at: system.step(at, v), np.array(u)), **options
        )
        np.testing.assert_allclose(near.C, slope(system.output, at), **options)
        assert near.dt == system.dt


def test_a_pendulum_keeps_its_energy():
    def energy(x):
        _, angle, speed, rate = np.moveaxis(x, -1, 0)
        across, up = speed + 0.5 * rate * np.cos(angle), 0.5 * rate * np.sin(angle)
        return (speed**2 + 0.2 * (across**2 + up**2)) / 2 + 0.2 * GRAVITY * 0.5 * np.cos(angle)

    starts = np.array([[0, 1.0, 0, 0], [0, 3.0, -1, 2], [0, 0.1, 0.5, -4]])
    seen = []
    for dt in (0.05, 0.025):
        plant = cart_pendulum(dt=dt)
        T = rollout(plant, starts, np.zeros((1, 4)), round(2 / dt))
        seen.append(np.abs(energy(T.x) - energy(T.x)[:, :1]).max())
    assert seen[0] < 1e-2
    assert seen[1] < seen[0] / 16  # an error of the integrator, not of the equations
    # The other first integral: nothing pushes the whole along the rail.
    momentum = 1.2 * T.x[..., 2] + 0.1 * T.x[..., 3] * np.cos(T.x[..., 1])
    assert np.abs(momentum - momentum[:, :1]).max() < 1e-4


def test_a_car_drives_a_circle():
    plant = kinematic_bicycle(dt=0.05)
    steering, speed = 0.1, 5.0
    radius = 2.7 / np.tan(steering)
    T = rollout(plant, np.array([0, 0, steering, speed]), np.zeros((2, 4)), 400)
    turned = speed / radius * 0.05 * np.arange(401)
    assert turned[-1] > 3  # most of a half circle
    np.testing.assert_allclose(T.x[:, 1], turned, atol=1e-12)
    np.testing.assert_allclose(T.x[:, 0], radius * (1 - np.cos(turned)), atol=1e-6)
    np.testing.assert_allclose(T.y[:, 2], speed**2 / radius)
    np.testing.assert_array_equal(T.y[:, [0, 1, 3]], T.x[:-1, [0, 1, 3]])


def test_batches_and_compiled_programs_step_alike():
    x, u = RNG.normal(size=(2, 3, 4)), RNG.normal(size=(2, 3, 1))
    moved, seen = PENDULUM.step(x, u), PENDULUM.output(x)
    assert isinstance(moved, np.ndarray)
    assert moved.shape == (2, 3, 4)
    assert seen.shape == (2, 3, 2)
    np.testing.assert_allclose(moved[1, 2], PENDULUM.step(x[1, 2], u[1, 2]), rtol=1e-14)
    np.testing.assert_allclose(jax.jit(PENDULUM.step)(x, u), moved, rtol=1e-13)
    law = rollout(PENDULUM, x[0], lambda z: -z[:1], 5)
    assert law.y.shape == (3, 5, 2)
    np.testing.assert_allclose(law.x[:, 1], PENDULUM.step(x[0], -x[0, :, :1]), rtol=1e-13)
    loop = simulate(PENDULUM, lambda z: -z[:1], x[0], 5)
    np.testing.assert_allclose(loop.x, law.x, rtol=1e-12)
    np.testing.assert_allclose(loop.y, law.y, rtol=1e-12)


def test_a_linear_plant_steps_like_its_matrices():
    masses = oscillating_masses()
    x = random_states(1.0 + np.arange(6), key=jax.random.key(2600), shape=(3,))
    made = NonlinearSystem(
        lambda x, u: masses.A @ x + masses.B @ u, lambda x: masses.C @ x, nx=6, nu=2, dt=0.2
    )
    u = RNG.normal(size=(3, 2))
    np.testing.assert_allclose(made.step(x, u), masses.step(x, u), atol=1e-13)
    np.testing.assert_allclose(made.output(x), masses.output(x), atol=1e-13)


def growing(x, u):
    """Leaves the numbers once x > 1."""
    return jnp.where(x > 1, jnp.nan, x + u)


def test_a_plant_that_leaves_the_numbers_is_named_with_the_step():
    system = NonlinearSystem(growing, nx=1, nu=1, dt=1)
    with pytest.raises(ValueError, match=r"system must return finite states.* at step 4 from x"):
        simulate(system, lambda x: [0.5], [0.0], 6)
    with pytest.raises(ValueError, match=r"system must return finite states.* at step 4 of run 1"):
        rollout(system, [[-9.0], [0.0]], lambda x: 0.5 + 0 * x, 6)
    steep = NonlinearSystem(lambda x, u: jnp.sqrt(x) + u, nx=1, nu=1, dt=1)
    with pytest.raises(ValueError, match="A must be finite, got 1 bad value"):
        steep.linearise([0.0], [0.0])


def plant(f=lambda x, u: x, **options):
    return NonlinearSystem(f, **{"nx": 2, "nu": 1, "dt": 0.1, **options})


def continuous(f=lambda x, u: x, **options):
    return NonlinearSystem.from_continuous(f, **{"nx": 2, "nu": 1, "dt": 0.1, **options})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: NonlinearSystem(3, nx=2, nu=1, dt=0.1), "f must be a function, got 3"),
        (lambda: plant(g=3), "g must be a function"),
        (lambda: plant(lambda x, u: x[:1]), r"f must return the next state, shape \(2,\), got.*1"),
        (lambda: plant(lambda x, u: (x, u)), r"f\(x, u\) must return one array, got tuple"),
        (lambda: plant(lambda x, u: np.sin(x)), r"f\(x, u\) must work on JAX arrays, but raised"),
        (lambda: plant(lambda x: x), r"f must be a function of 2 argument"),
        (lambda: plant(g=lambda x: x[0]), r"g must return an output of shape \(ny,\), got"),
        (lambda: plant(g=lambda x: x[:0]), "g must return an output"),
        (lambda: plant(nx=0), "nx must be a whole number of at least 1"),
        (lambda: plant(nu=1.5), "nu must be a whole number"),
        (lambda: plant(dt=0), "dt must be a positive number of seconds"),
        (lambda: plant(u_min=1.0, u_max=0.0), "u_min must lie below u_max"),
        (lambda: plant(u_max=[1.0, 2.0]), "u_max must be a number or have shape"),
        (lambda: continuous(None), "f must be a function"),
        (lambda: continuous(lambda x, u: u), r"f must return ẋ, shape \(2,\), got shape \(1,\)"),
        (lambda: continuous(substeps=0), "substeps must be a whole number of at least 1"),
        (lambda: continuous(dt=-1), "dt must be a positive number"),
        (lambda: continuous(nx=-2), "nx must be a whole number"),
        (lambda: CAR.linearise([0, 0, 0, 10], [9.0, 0]), "u must lie within the input bounds"),
        (lambda: CAR.linearise([0, 0, 0], [0, 0]), r"x must have shape \(..., 4\)"),
        (lambda: CAR.linearise([0, 0, 0, np.nan], [0, 0]), "x must be finite"),
        (lambda: kinematic_bicycle(wheelbase=0), "wheelbase must be positive, got 0"),
        (lambda: kinematic_bicycle(brake=-1), "brake must be positive"),
        (lambda: kinematic_bicycle(throttle=np.nan), "throttle must be positive and finite"),
        (lambda: kinematic_bicycle(dt=0), "dt must be a positive"),
        (lambda: cart_pendulum(cart=0), "cart must be positive"),
        (lambda: cart_pendulum(length=-1), "length must be positive"),
        (lambda: cart_pendulum(force=0), "force must be positive"),
        (lambda: rollout(CAR, [0, 0, 0], np.zeros((2, 4)), 2), r"x0 must have shape \(..., 4\)"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
