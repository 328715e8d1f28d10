"""The study of many set points: its parts by hand, and the stored file is what the code gives."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from stored_studies import WHOLE

from prefmpc import (
    LinearMPC,
    QuadraticCost,
    SteadyState,
    Trajectory,
    oscillating_masses,
    phi,
    random_states,
    rollout,
    simulate,
    steady_state,
)
from studies import RADIUS, read_spread
from studies import references as study
from studies.__main__ import BOOK

SPREAD = read_spread(BOOK / "extensions" / "references_spread.json")
MASSES = oscillating_masses()


def at(points: SteadyState, i: int) -> SteadyState:
    return study.each(points)[i]


def test_set_points_are_steady_states_that_can_be_held():
    points = study.set_points(MASSES, 20, key=jax.random.key(2900))
    np.testing.assert_allclose(MASSES.step(points.x, points.u), points.x, atol=1e-12)
    assert np.abs(points.u).max() <= study.HELD
    found = steady_state(MASSES, points.y[3])
    np.testing.assert_allclose(found.u, points.u[3], atol=1e-6)
    np.testing.assert_allclose(MASSES.step(study.FAR.x, study.FAR.u), study.FAR.x, atol=1e-12)


def test_moves_start_alike_go_to_one_set_point_and_keep_to_the_bounds():
    pairs = study.options(30, key=jax.random.key(2901))
    assert pairs.batch_shape == (30, 2)
    np.testing.assert_array_equal(pairs.x[:, 0, 0], pairs.x[:, 1, 0])
    np.testing.assert_array_equal(pairs.x_r[:, 0], pairs.x_r[:, 1])
    assert len(np.unique(pairs.x_r[:, 0, 1])) == 30
    assert np.abs(pairs.u).max() <= 1
    again = rollout(MASSES, pairs.x[0, 0, 0], lambda x: x[:2] * 0, 1)
    np.testing.assert_allclose(again.x[1] + MASSES.B @ pairs.u[0, 0, 0], pairs.x[0, 0, 1])
    off = pairs.x[:, 0, 0] - pairs.x_r[:, 0]
    assert (np.abs(off) <= RADIUS).all()
    home = study.options(30, key=jax.random.key(2901), many=False)
    assert not home.x_r.any()
    assert not home.u_r.any()


def test_people_by_hand():
    x = np.zeros((2, 6))
    x[0] = [0.3, 0.4, 0.1, 0, 1.0, 0]
    T = Trajectory(x, [[0.5, -0.2]], x_r=[0.2, 0.2, 0.2, 0, 0, 0], u_r=[0.4, 0.4])
    position = 40 * (0.01 + 0.04 + 0.01)
    assert study.minds_deviations(T) == pytest.approx(position + 5 + 2 * (0.01 + 0.36))
    assert study.minds_force(T) == pytest.approx(position + 5 + 2 * (0.25 + 0.04))
    near = study.gentle_near_the_wall(T)
    assert near == pytest.approx(position + (1 + 1000 * 0.04) + 2 * (0.01 + 0.36))
    assert phi(T.deviation(), study.known("near the wall", 0.2).Q, study.R) == pytest.approx(near)


def test_copies_mix_the_weights_of_the_knots():
    pairs = study.options(10, key=jax.random.key(2902))[:, 0]
    rng = np.random.default_rng(2903)
    n = len(study.KNOTS)
    model = QuadraticCost(np.diag(rng.uniform(1, 9, 6 * n)), np.diag(rng.uniform(1, 9, 2 * n)))
    scores = model(study.gated(pairs))
    for i in range(10):
        here = study.mixed(model, float(pairs.x_r[i, 1]))
        assert here(pairs[i]) == pytest.approx(float(scores[i]))
    np.testing.assert_allclose(study.shares(np.array([-0.9, -0.1, 0.2])).sum(-1), 1)


def test_the_controllers_are_those_of_the_library():
    points = study.set_points(MASSES, 1, key=jax.random.key(2904))
    goal = at(points, 0)
    x0 = goal.x + random_states(RADIUS, key=jax.random.key(2905))
    cost = study.known("deviations", 0.0)
    ours = study.controlled(MASSES, [cost], goal, x0, absolute=False, steps=5)[0]
    library = LinearMPC(MASSES, cost, study.HORIZON)
    run = simulate(MASSES, lambda x: library.solve(x, reference=goal).u, x0, 5)
    np.testing.assert_allclose(ours.u, run.u, atol=1e-5)
    # The whole force: at the origin the same; at a set point it stays short.
    origin = at(study.origin(MASSES, 1), 0)
    both = [
        study.controlled(MASSES, [cost], origin, x0, absolute=reading, steps=5).u
        for reading in (False, True)
    ]
    np.testing.assert_allclose(*both, atol=1e-7)
    end = study.controlled(MASSES, [cost], study.FAR, study.FAR.x, absolute=True, steps=60)
    assert 0.34 < end.x[0, -1, 1] < 0.37


def test_where_it_would_rest():
    deviations = study.known("deviations", 0.4)
    np.testing.assert_allclose(study.rest(deviations, study.FAR, MASSES), 0.4, atol=1e-9)
    whole = study.seen(deviations, "many, absolute force")
    q, r = study.Q[0, 0], study.R[0, 0]
    expected = 3 * q / (3 * q + 8 * r) * 0.4  # if all masses stood at one place
    assert study.rest(whole, study.FAR, MASSES)[1] == pytest.approx(expected, abs=0.01)


def test_the_book_s_file_is_what_the_code_gives():
    shape = len(study.PEOPLE), len(study.LEARNERS)
    assert len(SPREAD["accuracy"]) >= 20
    assert SPREAD["accuracy"].shape[1:] == shape == SPREAD["short"].shape[1:]
    assert SPREAD["cost"].shape[1:] == (shape[0], len(study.CONTROLLERS))
    # Without the networks, and for one person: what is quick to learn again.
    first, n = 0 if WHOLE else 2, len(study.CONTROLLERS)
    people = study.PEOPLE[first:]
    again = study.references_case(key=jax.random.key(0), people=people, network=False)
    accuracy, short, cost = (SPREAD[name][0, first:] for name in ("accuracy", "short", "cost"))
    np.testing.assert_allclose(again["accuracy"][:, :n], accuracy[:, :n], atol=0.003)
    np.testing.assert_allclose(again["short"][:, :n], short[:, :n], atol=1.1)
    np.testing.assert_allclose(again["cost"], cost, rtol=5e-3)
    assert np.isnan(again["accuracy"][:, n:]).all()
