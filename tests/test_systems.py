"""Plants against python-control and against matrices written by hand; sets by definition."""

from __future__ import annotations

import dataclasses

import control
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prefmpc import LinearSystem, Polyhedron, oscillating_masses

NAN, INF = np.nan, np.inf


@st.composite
def continuous_plants(draw):
    nx, nu = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    entries = st.floats(-3, 3, width=32)
    return draw(arrays(float, (nx, nx), elements=entries)), draw(
        arrays(float, (nx, nu), elements=entries)
    )


@given(continuous_plants(), st.floats(0.01, 1.0))
def test_zero_order_hold_is_that_of_python_control(plant, dt):
    A, B = plant
    C, D = np.eye(len(A)), np.zeros(B.shape)
    reference = control.c2d(control.ss(A, B, C, D), dt, method="zoh")
    ours = LinearSystem.from_continuous(A, B, dt=dt)
    scale = max(1.0, np.abs(reference.A).max())
    np.testing.assert_allclose(ours.A, reference.A, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(ours.B, reference.B, rtol=0, atol=1e-12 * scale)


def test_double_integrator_has_the_textbook_discretisation():
    ours = LinearSystem.from_continuous([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], dt=0.5)
    np.testing.assert_allclose(ours.A, [[1, 0.5], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(ours.B, [[0.125], [0.5]], atol=1e-15)
    assert (ours.nx, ours.nu, ours.ny, ours.dt) == (2, 1, 1, 0.5)


def test_masses_against_the_matrix_written_by_hand():
    # m = 1, 0.5, 1 kg, k = 2 N/m: each row is −(k_left + k_right)/m next to k/m.
    continuous = np.zeros((6, 6))
    continuous[:3, 3:] = np.eye(3)
    continuous[3:, :3] = [[-4, 2, 0], [4, -8, 4], [0, 2, -4]]
    force = np.zeros((6, 2))
    force[3, 0] = force[5, 1] = 1
    C = np.eye(3, 6)
    reference = control.c2d(control.ss(continuous, force, C, np.zeros((3, 2))), 0.2, method="zoh")
    ours = oscillating_masses()
    np.testing.assert_allclose(ours.A, reference.A, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.B, reference.B, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ours.C, C)
    np.testing.assert_array_equal([ours.u_min, ours.u_max], [[-1, -1], [1, 1]])
    # No damping: every mode keeps its energy.
    np.testing.assert_allclose(np.abs(np.linalg.eigvals(ours.A)), 1, atol=1e-12)


@pytest.mark.parametrize("n", [2, 5])
def test_any_number_of_masses_keeps_its_energy(n):
    m, k = np.linspace(0.5, 2, n), np.linspace(1, 3, n + 1)
    plant = oscillating_masses(m, k, dt=0.1, u_max=np.inf)
    assert (plant.nx, plant.nu, plant.ny) == (2 * n, 2, n)
    assert np.isinf(plant.u_max).all()

    def energy(x):  # with walls at rest at both ends
        stretch = np.diff(np.concatenate([[0.0], x[:n], [0.0]]))
        return m @ x[n:] ** 2 / 2 + k @ stretch**2 / 2

    x = np.random.default_rng(0).normal(size=2 * n)
    assert energy(plant.A @ x) == pytest.approx(energy(x), rel=1e-12)
    # A force on the first mass from rest first moves the first mass: Δv ≈ dt/m.
    assert plant.B[n, 0] == pytest.approx(0.1 / m[0], rel=0.02)
    assert plant.B[-1, 1] == pytest.approx(0.1 / m[-1], rel=0.02)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 3), st.floats(0.2, 1.5))
def test_lqr_is_that_of_python_control(seed, nx, nu, radius):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    Q, R = (M @ M.T + 0.1 * np.eye(len(M)) for M in (rng.normal(size=(n, n)) for n in (nx, nu)))
    K, P = LinearSystem(A, B, dt=1.0).lqr(Q, R)
    K_reference, P_reference, _ = control.dlqr(A, B, Q, R)
    scale = max(1, np.abs(K_reference).max())
    np.testing.assert_allclose(K, K_reference, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(P, P_reference, rtol=1e-8, atol=1e-8 * np.abs(P).max())


def test_lqr_of_the_masses_is_the_limit_of_value_iteration(masses):
    Q, R = np.diag([40.0, 40, 40, 5, 5, 5]), 0.2 * np.eye(2)
    P = Q
    for _ in range(500):
        K = np.linalg.solve(R + masses.B.T @ P @ masses.B, masses.B.T @ P @ masses.A)
        P = Q + masses.A.T @ P @ (masses.A - masses.B @ K)
    ours_K, ours_P = masses.lqr(Q, R)
    np.testing.assert_allclose(ours_K, K, atol=1e-9)
    np.testing.assert_allclose(ours_P, P, rtol=1e-9)


def test_scalar_lqr_by_hand():
    # a = 2, b = r = 1, q = 0: P = (a² − 1) r / b² = 3 and K = b P a / (r + b² P) = 6/4.
    K, P = LinearSystem([[2]], [[1]], dt=1).lqr([[0]], [[1]])
    assert (K.item(), P.item()) == pytest.approx((1.5, 3.0))


def test_python_control_round_trip(masses):
    there = masses.to_control()
    assert there.dt == 0.2
    back = LinearSystem.from_control(there, u_min=-1, u_max=1)
    for name in ("A", "B", "C", "dt", "u_min", "u_max"):
        np.testing.assert_array_equal(getattr(back, name), getattr(masses, name))


def test_from_python_control():
    A, B, C = [[0, 1], [-1, 0]], [[0], [1]], [[1, 0]]
    continuous = LinearSystem.from_control(control.ss(A, B, C, 0), dt=0.1, u_max=2)
    sampled = control.c2d(control.ss(A, B, C, 0), 0.1)
    np.testing.assert_allclose(continuous.A, sampled.A, atol=1e-14)
    assert (continuous.dt, continuous.u_min.item(), continuous.u_max.item()) == (0.1, -INF, 2)
    assert LinearSystem.from_control(control.ss(A, B, C, 0, 1)).dt == 1.0  # a whole number
    unspecified = LinearSystem.from_control(control.ss(A, B, C, 0, True), dt=0.3)
    np.testing.assert_array_equal(unspecified.A, A)
    assert unspecified.dt == 0.3


def test_system_is_a_frozen_pytree(masses):
    with pytest.raises(dataclasses.FrozenInstanceError):
        masses.dt = 0.1
    moved = jax.jit(lambda system, x: system.A @ x)(masses, np.ones(6))
    np.testing.assert_allclose(moved, masses.A @ np.ones(6), rtol=1e-12)
    assert jax.tree.map(lambda leaf: leaf, masses).dt == masses.dt


EYE, ONE = np.eye(2), np.ones((2, 1))


def plant(A=EYE, B=ONE, C=None, dt=1.0, **bounds):
    return LinearSystem(A, B, C, dt=dt, **bounds)


def sampled(dt, D=0.0):
    return control.ss([[0.5]], [[1]], [[1]], [[D]], dt)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: plant(A=[[1, NAN], [0, 1]]), r"A must be finite.*index \(0, 1\)"),
        (lambda: plant(A=np.ones((2, 3))), r"A must be square.*\(2, 3\)"),
        (lambda: plant(A=np.ones((0, 0))), "A must be square"),
        (lambda: plant(A=[["a", "b"], ["c", "d"]]), "A must be an array of real numbers"),
        (lambda: plant(A=EYE * 1j), "A must be an array of real numbers"),
        (lambda: plant(B=np.ones((3, 1))), r"B must have shape \(2, nu\), got \(3, 1\)"),
        (lambda: plant(B=[1, 2]), "B must have 2 dimension"),
        (lambda: plant(B=np.ones((2, 0))), "B must have shape"),
        (lambda: plant(C=np.ones((1, 3))), r"C must have shape \(ny, 2\)"),
        (lambda: plant(dt=0.0), "dt must be a positive number of seconds, got 0"),
        (lambda: plant(dt=-0.1), "dt must be a positive.*-0.1"),
        (lambda: plant(dt=NAN), "dt must be a positive.*nan"),
        (lambda: plant(u_min=1, u_max=-1), "u_min must lie below u_max.*got 1 and -1 at index 0"),
        (lambda: plant(u_min=INF), "u_min must be below infinity"),
        (lambda: plant(u_min=NAN), "u_min must not contain NaN"),
        (lambda: plant(u_max=[1, 2, 3]), r"u_max must be a number or have shape \(1,\)"),
        (lambda: LinearSystem.from_continuous(EYE, ONE, dt=-1), "dt must be a positive"),
        (lambda: LinearSystem.from_continuous(EYE, [[INF], [0]], dt=1), "B must be finite"),
        (lambda: LinearSystem.from_control(sampled(0)), "dt must be given for a continuous"),
        (lambda: LinearSystem.from_control(sampled(True)), "dt must be given"),
        (lambda: LinearSystem.from_control(sampled(0.1), dt=0.2), "own sample time 0.1, got 0.2"),
        (lambda: LinearSystem.from_control(sampled(0.1, D=1)), "D = 0"),
        (lambda: plant().lqr(EYE, [[0]]), "R must be positive definite"),
        (lambda: plant().lqr(-EYE, [[1]]), "Q must be positive semidefinite.*-1"),
        (lambda: plant().lqr([[1, 2], [0, 1]], [[1]]), "Q must be symmetric"),
        (lambda: plant().lqr(np.eye(3), [[1]]), r"shapes \(2, 2\) and \(1, 1\)"),
        (
            lambda: plant(A=np.diag([1.1, 0.5]), B=[[0], [1]]).lqr(EYE, [[1]]),
            r"\(A, B\) must be stabilisable.*1\.1",
        ),
        (lambda: LinearSystem([[1]], [[1]], dt=1).lqr([[0]], [[1]]), "Q must see every undamped"),
        (lambda: oscillating_masses([1]), "masses must be at least two positive numbers"),
        (lambda: oscillating_masses([1, -1]), "masses must be at least two positive numbers"),
        (lambda: oscillating_masses([1, NAN]), "masses must be finite"),
        (lambda: oscillating_masses(stiffness=-1), "stiffness must be one or 4 nonnegative"),
        (lambda: oscillating_masses(stiffness=[1, 2]), "stiffness must be one or 4 nonnegative"),
        (lambda: oscillating_masses(u_max=-1), "u_max must be at least 0"),
        (lambda: Polyhedron([[1, 0]], [1, 2]), "same number of rows"),
        (lambda: Polyhedron([[NAN, 0]], [1]), "H must be finite"),
        (lambda: Polyhedron([[1, 0]], [-INF]), "h must be above minus infinity"),
        (lambda: Polyhedron(np.zeros((1, 0)), [1]), "H must have at least one column"),
        (lambda: Polyhedron.box([0, 0], [1, -1]), "lower must lie below upper.*index 1"),
        (lambda: Polyhedron.box([0, 0], [1, 2, 3]), r"upper must be a number or have shape \(2,\)"),
        (lambda: Polyhedron.box([0, 0], [1, 1]).contains([1, 1, 1]), r"z must have shape \(..., 2"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_equal_bounds_lock_and_infinite_limits_bound_nothing():
    locked = plant(u_min=0.5, u_max=0.5)
    np.testing.assert_array_equal(locked.u_min, locked.u_max)
    assert Polyhedron.box([0, 1], [1, 1]).contains([[0.5, 1], [0.5, 0.9]]).tolist() == [True, False]
    half = Polyhedron([[1, 0], [0, 1]], [1, INF])
    np.testing.assert_array_equal(half.H, [[1, 0]])
    np.testing.assert_array_equal(half.h, [1])
    assert half.contains([0.5, 1e300])
    assert Polyhedron([[1, 0]], [INF]).contains([1e9, 0])


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_on_a_limit_in_any_unit(unit):
    box = Polyhedron(np.eye(2), unit * np.array([1.0, 0.0]))
    z = unit * np.array([[1 + 1e-12, 0], [1 + 1e-6, 0], [1, 1e-6]])
    assert box.contains(z).tolist() == [True, False, False]


@given(arrays(float, (20, 3), elements=st.floats(-3, 3)))
def test_a_box_holds_what_lies_between_its_bounds(z):
    box = Polyhedron.box([-1, -INF, 0], [1, 2, INF])
    assert box.dim == 3
    assert len(box.h) == 4  # open sides make no half-space
    expected = (np.abs(z[:, 0]) <= 1) & (z[:, 1] <= 2) & (z[:, 2] >= 0)
    np.testing.assert_array_equal(box.contains(z, tol=0), expected)
