"""Control from outputs: a plant that is pushed, and one that is not what the model says."""

from __future__ import annotations

import control
import numpy as np
import pytest

from prefmpc import (
    KalmanEstimator,
    LinearMPC,
    LinearSystem,
    OutputFeedback,
    Polyhedron,
    QuadraticCost,
    oscillating_masses,
    steady_state,
    terminal_ingredients,
)

MASSES = oscillating_masses()
COST = QuadraticCost(np.diag([10.0, 10, 10, 1, 1, 1]), 0.1 * np.eye(2))
NOISE = {"state_noise": [1e-2] * 6, "output_noise": [1e-3] * 3}
FORCES = {**NOISE, "disturbance_noise": [0.3] * 2}
ON_ALL = LinearSystem.from_continuous(
    np.block([[np.zeros((3, 3)), np.eye(3)], [np.zeros((3, 6))]]), np.eye(6, 3, -3), dt=0.2
).B
ANY = {**NOISE, "B_d": ON_ALL, "disturbance_noise": [0.1] * 3}
"""Accelerations of all three masses: as many disturbances as outputs."""


def run(plant, feedback, steps, force=(0.0, 0.0), noise=0.0):
    """Return the outputs (steps, ny) of a plant from rest that a force pushes."""
    rng, x, seen = np.random.default_rng(0), np.zeros(plant.nx), []
    for _ in range(steps):
        y = plant.output(x)
        seen.append(y)
        u = feedback(y + noise * rng.normal(size=y.shape))
        x = plant.step(x, u + np.asarray(force))
    return np.array(seen)


def feedback(model=MASSES, y_r=None, noise=FORCES, **options):
    controller = LinearMPC(model, COST, 15, **options)
    return OutputFeedback(controller, KalmanEstimator(model, **noise), y_r)


@pytest.mark.parametrize("noise", [FORCES, ANY], ids=["at the inputs", "anywhere"])
def test_a_constant_force_leaves_no_offset(noise):
    loop = feedback(noise=noise)
    y = run(MASSES, loop, 120, force=(0.5, 0.0))
    assert np.abs(y).max() > 0.01
    assert np.abs(y[-1]).max() < 1e-6
    if noise is FORCES:
        np.testing.assert_allclose(loop.estimate.d, [0.5, 0], atol=1e-6)
    plain = LinearMPC(MASSES, COST, 15)
    x = np.zeros(6)
    for _ in range(60):
        x = MASSES.step(x, plain(x) + np.array([0.5, 0]))
    assert np.abs(x[:3]).max() > 1e-3  # with the state itself, but not told of the force


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_wrong_model_leaves_no_offset(factor):
    model = oscillating_masses(np.array([1, 0.5, 1]) * factor, [2.2, 1.8, 2, 2.1])
    held = steady_state(MASSES, [0.15, 0.1, 0.05], nearest=True)
    y = run(MASSES, feedback(model, held.y, ANY), 160)
    assert np.abs(y[-1] - held.y).max() < 1e-6
    # What the model alone would hold is somewhere else.
    u = steady_state(model, held.y, nearest=True).u
    rest = MASSES.C @ np.linalg.solve(np.eye(6) - MASSES.A, MASSES.B @ u)
    assert np.abs(rest - held.y).max() > 1e-3


def test_with_noise_and_soft_limits_it_goes_on():
    room = Polyhedron.box([-0.2] * 3 + [-9] * 3 + [-1] * 2, [0.2] * 3 + [9] * 3 + [1] * 2)
    loop = feedback(y_r=[0.19, 0.15, 0.1], constraints=room, soft=200.0)
    y = run(MASSES, loop, 60, force=(0.2, 0.1), noise=0.01)
    assert np.abs(y[30:].mean(axis=0) - loop.target().y).max() < 0.05


def test_the_gain_is_that_of_python_control():
    own = KalmanEstimator(MASSES, **FORCES)
    A = np.block([[MASSES.A, MASSES.B], [np.zeros((2, 6)), np.eye(2)]])
    C = np.concatenate([MASSES.C, np.zeros((3, 2))], axis=1)
    W = np.diag(np.square([1e-2] * 6 + [0.3] * 2))
    L, _, _ = control.dlqe(A, np.eye(8), C, W, 1e-6 * np.eye(3))
    y = np.array([0.3, -0.2, 0.1])
    found = own.corrected(y)
    wanted = np.linalg.solve(A, L @ y)  # that gain is for a prediction
    np.testing.assert_allclose(np.concatenate([found.x, found.d]), wanted, atol=1e-8)


def test_asking_twice_changes_nothing_and_reset_forgets():
    loop = feedback()
    first = loop.solve([0.1, 0, 0]).u
    np.testing.assert_array_equal(loop.solve([0.1, 0, 0]).u, first)
    loop.applied(first)
    assert np.abs(loop.solve([0.1, 0, 0]).u - first).max() > 1e-6
    loop.reset()
    np.testing.assert_allclose(loop.solve([0.1, 0, 0]).u, first, rtol=0, atol=1e-9)


@pytest.mark.parametrize("KalmanEstimator", [KalmanEstimator])
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"system": 1}, "system"),
        ({"state_noise": [0.0] * 6}, "state_noise"),
        ({"output_noise": [1.0]}, "output_noise"),
        ({"disturbance_noise": [1.0]}, "disturbance_noise"),
        ({"B_d": np.eye(2)}, "B_d"),
        ({"C_d": np.eye(2)}, "C_d"),
        ({"B_d": np.zeros((6, 2))}, "B_d and C_d"),
    ],
)
def test_bad_input_of_an_estimator(KalmanEstimator, changed, message):
    with pytest.raises(ValueError, match=message):
        KalmanEstimator(**{"system": MASSES, **FORCES, **changed})


@pytest.mark.parametrize("OutputFeedback", [OutputFeedback])
def test_bad_input_of_output_feedback(OutputFeedback):
    controller, estimator = LinearMPC(MASSES, COST, 3), KalmanEstimator(MASSES, **FORCES)
    cart = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1)
    small = LinearMPC(cart, QuadraticCost(np.eye(2), [[1.0]]), 3)
    ended = LinearMPC(MASSES, COST, 3, terminal=terminal_ingredients(MASSES, COST))
    for given, message in [
        ((None, estimator), "controller"),
        ((controller, None), "estimator"),
        ((small, estimator), "estimator"),
        ((ended, estimator), "controller"),
        ((controller, estimator, [1.0]), "y_r"),
    ]:
        with pytest.raises(ValueError, match=message):
            OutputFeedback(*given)
    with pytest.raises(ValueError, match="y must"):
        OutputFeedback(controller, estimator).solve([0.0])
