"""The study of what σ may see: its parts by hand, and the stored file is what the code gives."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import (
    NonlinearMPC,
    QuadraticCost,
    SignalCost,
    accuracy,
    oscillating_masses,
    random_states,
    select,
)
from prefmpc._random import generator
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS, read_spread
from studies.__main__ import BOOK
from studies.condensed import condensed_weights, learned_weights, plans, trajectory_rows
from studies.signals import (
    CASES,
    JERK_LEARNERS,
    JERK_SIZES,
    LEARNERS,
    SIGNALS_SIZES,
    TESTS,
    asked,
    fresh_pairs,
    jerk_cost,
    jerk_person,
    learn,
    loops_of,
    person,
    plant_weights,
    prior_of,
)

MASSES = oscillating_masses()
SPREAD = read_spread(BOOK / "extensions" / "signals_spread.json")


@pytest.mark.parametrize("signals", [["x"], ["y"], ["y", "dy"], ["x", "du"]])
def test_rows_give_the_signals_of_a_trajectory(signals):
    pool = fresh_pairs(3, key=jax.random.key(3000))
    before = np.array([0.3, -0.2])
    T = jax.tree.map(np.asarray, pool[0])
    T = type(T)(T.x, T.u, T.y, u_before=before)
    v = np.concatenate([T.x[0], before, T.u.ravel()])
    rows = trajectory_rows(MASSES, signals, 10)
    np.testing.assert_allclose(rows @ v, select(T, signals).x[:-1], atol=1e-12)
    Q, R = np.diag(np.arange(1.0, 1 + rows.shape[1])), np.diag([0.5, 2.0])
    cost = SignalCost(QuadraticCost(Q, R), signals)
    assert v @ condensed_weights(rows, Q, R) @ v == pytest.approx(float(cost(T)))


def test_pairs_start_alike_or_not_and_keep_the_bounds():
    pool = fresh_pairs(20, key=jax.random.key(3001), inputs="random inputs")
    np.testing.assert_array_equal(pool.x[::2, 0], pool.x[1::2, 0])
    assert np.abs(pool.u).max() <= 1
    np.testing.assert_allclose(MASSES.step(pool.x[:, :-1], pool.u), pool.x[:, 1:], atol=1e-12)
    other = fresh_pairs(20, key=jax.random.key(3001), same_start=False)
    assert np.abs(other.x[::2, 0] - other.x[1::2, 0]).max(axis=1).min() > 1e-3


def test_a_quadratic_of_x0_and_u_plans_and_loops_like_the_quadratic_of_states():
    known = SignalCost(QuadraticCost(QUADRATIC_Q, QUADRATIC_R), "x")
    W = plant_weights(MASSES, QUADRATIC_Q, QUADRATIC_R)
    same = SignalCost(QuadraticCost(W, 1e-9 * np.eye(2)), "x0")
    x0 = random_states(2 * RADIUS, key=jax.random.key(3002), shape=(3,))
    U = plans(learned_weights(same.model, 6), x0, MASSES)
    assert np.abs(U).max() == pytest.approx(1)  # the bounds are active
    for start, plan in zip(x0, U, strict=True):
        answer = NonlinearMPC(MASSES, same, 10).solve(start)
        np.testing.assert_allclose(answer.trajectory.u, plan, atol=2e-3)
    one, other = (loops_of(MASSES, [cost], x0, 5)[0] for cost in (known, same))
    np.testing.assert_allclose(one.u, other.u, atol=1e-4)


def test_loops_remember_the_last_input():
    x0 = random_states(RADIUS, key=jax.random.key(3003), shape=(1,))
    run = loops_of(MASSES, [jerk_cost()], x0, 3)[0]
    controller = NonlinearMPC(MASSES, jerk_cost(), 10)
    before = np.zeros(2)
    for k in range(3):
        answer = controller.solve(run.x[0, k], u_before=before)
        np.testing.assert_allclose(answer.u, run.u[0, k], atol=1e-3)
        before = run.u[0, k]
    assert float(jerk_person(run)[0]) == pytest.approx(float(jerk_cost()(run)[0]))


def test_the_plant_s_prior_is_bryson_s_rule_in_other_words():
    rule, told = prior_of("(X, U)"), prior_of("(x₀, U), told the plant")
    T = fresh_pairs(4, key=jax.random.key(3004))
    direct = np.asarray(QuadraticCost(rule.Q, rule.R)(T))
    view = SignalCost(QuadraticCost(told.Q, told.R), "x0")
    np.testing.assert_allclose(view(T), direct, rtol=1e-4)  # its R is small, not zero


def test_the_book_s_numbers_are_what_the_code_gives():
    assert len(SPREAD["regret"]) >= 20
    sizes, learners = len(SIGNALS_SIZES), len(LEARNERS)
    assert SPREAD["accuracy"].shape[1:] == (len(CASES), sizes, learners, len(TESTS))
    assert SPREAD["regret"].shape[1:] == (len(CASES), sizes, learners)
    assert SPREAD["jerk regret"].shape[1:] == (len(JERK_SIZES), len(JERK_LEARNERS))
    # One seed again, and of it what is quick to learn: two views, two sizes, and the loops.
    streams = generator(jax.random.key(0)).spawn(6)
    test = asked(fresh_pairs(500, key=streams[2]), person("states"))
    x0 = random_states(RADIUS, key=streams[5], shape=(50,))
    pool, who = fresh_pairs(max(SIGNALS_SIZES), key=streams[0]), person("states")
    names, known = LEARNERS[:2], SignalCost(QuadraticCost(QUADRATIC_Q, QUADRATIC_R), "x")
    for n in (20, 100):
        costs = [learn(name, asked(pool[: 2 * n], who)) for name in names]
        i = SIGNALS_SIZES.index(n)
        share = [accuracy(cost, test) for cost in costs]
        np.testing.assert_allclose(share, SPREAD["accuracy"][0, 0, i, :2, 0], atol=0.0021)
        best, *paid = who(loops_of(MASSES, [known, *costs], x0, 30)).mean(axis=1)
        np.testing.assert_allclose(
            np.array(paid) / best - 1, SPREAD["regret"][0, 0, i, :2], atol=2e-3
        )
