"""The studies of the extensions: the stored files are what the code gives, and their parts."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.optimize import minimize

from prefmpc import (
    Comparisons,
    LinearMPC,
    Trajectory,
    accuracy,
    bryson,
    fit_map,
    oscillating_masses,
    random_states,
    terminal_ingredients,
)
from prefmpc._random import generator
from studies import RADIUS, read_spread
from studies.__main__ import BOOK
from studies.onesided import (
    CONTROLLERS,
    FORCES,
    LEARNERS,
    ONESIDED_SIZES,
    REACH,
    constant_system,
    fit_offset,
    one_sided,
    option_pairs,
    person_loops,
    with_constant,
)
from studies.stability import (
    CHECKS,
    HORIZONS,
    PLANTS,
    STILL,
    feasible_states,
    follow,
    learned,
    naive,
    stability_case,
)

ONESIDED = read_spread(BOOK / "extensions" / "onesided_spread.json")
STABILITY = read_spread(BOOK / "extensions" / "stability_spread.json")
MASSES = oscillating_masses()


def test_the_one_sided_person_by_hand():
    x = np.zeros((3, 6))
    x[0, :3], x[1, 0], x[2, 0] = [0.1, -0.2, 0.0], 0.3, 9.0  # x_N does not count
    T = Trajectory(x, [[1.0, 0.0], [0.0, -2.0]])
    assert one_sided(T) == pytest.approx(100 * 0.01 + 10 * 0.04 + 100 * 0.09 + 0.2 * 5)


def test_options_start_alike_and_come_once():
    data = option_pairs(30, key=jax.random.key(2800))
    first, second = data.pairs
    np.testing.assert_array_equal(first.x[:, 0], second.x[:, 0])
    assert np.abs(first.u - second.u).max(axis=(1, 2)).min() > 1e-3
    assert len(np.unique(np.stack([data.first, data.second]))) == 60
    np.testing.assert_array_equal(data.labels, one_sided(first) < one_sided(second))


def test_the_controller_that_knows_the_person_finds_the_optimum():
    x0 = random_states(RADIUS, key=jax.random.key(2801), shape=(2,))
    run = person_loops(MASSES, x0, 1)
    for i in range(2):

        def cost(u, i=i):
            U = u.reshape(10, 2)
            x = [x0[i]]
            for k in range(10):
                x.append(MASSES.A @ x[-1] + MASSES.B @ U[k])
            return float(one_sided(Trajectory(np.stack(x), U)))

        options = {"ftol": 1e-14, "maxiter": 500}
        best = minimize(cost, np.zeros(20), method="SLSQP", bounds=[(-1, 1)] * 20, options=options)
        np.testing.assert_allclose(run.u[i, 0], best.x[:2], atol=2e-3)


def test_a_constant_state_is_a_centre_of_its_own():
    data = option_pairs(5, key=jax.random.key(2802))
    moved = with_constant(data.trajectories)
    np.testing.assert_array_equal(moved.x[..., 6], 1)
    system = constant_system(MASSES)
    x, u = moved.x[:, 0], moved.u[:, 0]
    np.testing.assert_allclose(x @ system.A.T + u @ system.B.T, moved.x[:, 1], atol=1e-12)


def test_the_book_s_one_sided_accuracies_are_what_the_code_gives():
    assert len(ONESIDED["accuracy"]) >= 10
    assert ONESIDED["accuracy"].shape[1:] == (len(ONESIDED_SIZES), len(LEARNERS))
    assert ONESIDED["won"].shape[1:] == (len(ONESIDED_SIZES), len(CONTROLLERS))
    # What is quick to learn again; the chapter itself learns a network again.
    streams = generator(jax.random.key(0)).spawn(4)
    test = option_pairs(1000, key=streams[0])
    data = option_pairs(max(ONESIDED_SIZES), key=streams[1]).subset(np.arange(100))
    prior, stored = bryson(REACH, FORCES), ONESIDED["accuracy"][0, 0]
    for i, structure in enumerate(("full", "diagonal")):
        model = fit_map(data, prior, structure=structure).model
        assert accuracy(model, test) == pytest.approx(stored[i], abs=0.002)
    extended = Comparisons(with_constant(test.trajectories), test.first, test.second, test.labels)
    assert accuracy(fit_offset(data), extended) == pytest.approx(stored[3], abs=0.002)


def test_the_book_s_stability_is_what_the_code_gives():
    checks = STABILITY["checks"]
    assert len(checks) >= 100
    assert checks.shape[1:] == (len(PLANTS), len(CHECKS))
    assert (checks[..., CHECKS.index("largest state")] <= STILL).all()  # rounded in the file
    assert (checks[..., CHECKS.index("largest rise")] < 1e-6).all()
    assert (checks[..., CHECKS.index("unsolved")] == 0).all()
    again = stability_case(key=jax.random.key(0), plants=("pendulum",), loops=20)
    np.testing.assert_array_equal(again["rows"], STABILITY["rows"][0, :1])
    row, stored = (dict(zip(CHECKS, c, strict=True)) for c in (again["checks"][0], checks[0, 0]))
    assert row["accuracy"] == pytest.approx(stored["accuracy"], abs=0.003)
    assert row["largest state"] < STILL
    assert row["largest rise"] < 1e-6
    assert row["unsolved"] == 0
    assert row["steps"] <= stored["steps"] + 1
    assert row["naive fails"] == pytest.approx(stored["naive fails"], abs=0.1)
    np.testing.assert_allclose(again["regret"][0], STABILITY["regret"][0, 0], atol=2e-3)


@pytest.mark.parametrize("plant", PLANTS)
def test_feasible_states_are_feasible_and_reach_to_the_edge(plant):
    system, cost, share = learned(plant, key=jax.random.key(2803))
    assert share > 0.8
    end = terminal_ingredients(system, cost)
    horizon = HORIZONS[plant]
    options = {"key": jax.random.key(2804), "unit": np.ones(system.nx)}
    x0 = feasible_states(system, end, horizon, 30, **options)
    controller = LinearMPC(system, cost, horizon, terminal=end)
    assert all(controller.solve(x).success for x in x0)
    # At most 20 times further out on the same ray there is no plan; somewhere it was close.
    assert not any(controller.solve(21 * x).success for x in x0)
    assert any(not controller.solve(1.2 * x).success for x in x0)


def test_what_a_loop_s_checks_would_catch():
    system, cost, _ = learned("pendulum", key=jax.random.key(2803))
    end = terminal_ingredients(system, cost)
    x0 = np.array([0.1, 0.1])
    final, rise, unsolved, steps = follow(LinearMPC(system, cost, 5, terminal=end), x0, 400)
    assert (final < STILL, rise < 1e-6, unsolved, steps < 400) == (True, True, 0, True)
    final, rise, *_ = follow(LinearMPC(system, cost, 5), x0, 40)  # no ingredients: it falls
    assert final > 0.1
    assert rise > 1e-3
    outside = follow(LinearMPC(system, cost, 5, terminal=end), np.array([5.0, 0.0]), 40)
    assert outside[2:] == (1, 0)
    assert naive(system, cost, x0[None], 5) == 1
    assert naive(system, cost, x0[None], 20) == 0
