"""Accuracy, regret and shares of wins by hand; closed loops against one solve at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefmpc import (
    BatchedMPC,
    Comparisons,
    LinearMPC,
    LinearSystem,
    MPCError,
    Polyhedron,
    QuadraticCost,
    QuadraticPreference,
    Trajectory,
    WinRate,
    accuracy,
    by_criterion,
    closed_loops,
    oscillating_masses,
    random_states,
    regret,
    simulate,
    win_rate,
)
from prefmpc._pytree import bypass_init
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS

KEY = jax.random.key(2000)
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
POOL = Trajectory(np.zeros((4, 2, 1)), np.zeros((4, 1, 1)))
ASKED = Comparisons(POOL, [0, 0, 1, 2, 3], [1, 2, 0, 1, 0], [1, 0, 0.5, 0.8, 1])


def test_accuracy_by_hand():
    # σ = 1, 2, 3, 2: "first" in pairs 0, 1; "second" in pairs 2 (2 > 1), 3 (3 > 2), 4 (2 > 1).
    # Right with 1, 0, 1 − 0.5, 1 − 0.8, 1 − 1.
    assert accuracy(lambda T: np.array([1.0, 2, 3, 2]), ASKED) == pytest.approx(1.7 / 5)
    # Equal costs count as "first": 1 + 0 + 0.5 + 0.8 + 1.
    assert accuracy(lambda T: jnp.zeros(4), ASKED) == pytest.approx(3.3 / 5)


def runs(costs, start=0.0):
    """Trajectories (..., m) of one step with these costs; state i starts at ``start`` + i."""
    costs = np.asarray(costs, float)
    x = np.zeros((*costs.shape, 2, 1))
    x[..., 0, 0] = start + np.arange(costs.shape[-1])
    return Trajectory(x, costs[..., None, None])


def effort(T):
    return T.u[..., 0, 0]


def test_regret_by_hand():
    controllers = runs([[3, 1], [2, 5], [4, 1]])  # the best from each state: 2 and 1
    lost = regret(effort, controllers)
    np.testing.assert_array_equal(lost, [[1, 0], [0, 4], [2, 0]])
    best = runs([1, 0.5])
    expected = [[2, 0.5], [1, 4.5], [3, 0.5]]
    np.testing.assert_array_equal(regret(effort, controllers, best), expected)
    np.testing.assert_array_equal(regret(effort, controllers[1], best), expected[1])
    np.testing.assert_array_equal(regret(effort, best, best), [0, 0])
    # Two kinds of three controllers: the best is that of all six.
    nested = runs([[[3, 1], [2, 5], [4, 1]], [[9, 9], [1, 9], [9, 0]]])
    np.testing.assert_array_equal(
        regret(effort, nested), [[[2, 1], [1, 5], [3, 1]], [[8, 9], [0, 9], [8, 0]]]
    )


def test_equal_starts_may_differ_by_rounding():
    nearly = runs([3, 1], start=1e-14)
    np.testing.assert_array_equal(regret(effort, nearly, runs([1, 1])), [2, 0])
    assert win_rate(by_criterion(effort), nearly, runs([1, 1])).rate == 0.25


def prefers_less(first, second):
    """No difference counts for the first, like Π_φ."""
    return np.where(effort(first) <= effort(second), 1.0, 0.0)


@pytest.mark.parametrize("equal", [0.0, 0.5, 1.0, np.nan])
def test_nobody_wins_against_itself(equal):
    result = win_rate(lambda a, b: np.full(len(a), equal), runs([1, 2, 3]), runs([1, 2, 3]))
    assert result.rate == 0.5
    assert result.count == 3
    assert result.low == pytest.approx(1 - result.high)


def test_shares_of_wins_by_hand():
    # One win, one draw, two losses.
    ours, theirs = runs([1, 2, 3, 4]), runs([2, 2, 2, 2])
    assert win_rate(prefers_less, ours, theirs).rate == pytest.approx(1.5 / 4)
    assert win_rate(prefers_less, theirs, ours).rate == pytest.approx(2.5 / 4)
    assert win_rate(by_criterion(effort), ours, theirs).rate == pytest.approx(1.5 / 4)

    def drops_ties(first, second):
        answer = by_criterion(effort)(first, second)
        return np.where(answer == 0.5, np.nan, answer)

    dropped = win_rate(drops_ties, ours, theirs)
    assert (dropped.rate, dropped.count) == (pytest.approx(1.5 / 4), 4)
    # Somebody who is unsure: 0.7 in one order, 0.3 in the other.
    unsure = win_rate(lambda a, b: np.where(effort(a) < effort(b), 0.7, 0.3), ours, runs([9] * 4))
    assert unsure.rate == pytest.approx(0.7)


def test_wilson_s_interval():
    # z = 1.96: (0.8 + z²/20 ± z·√(0.8·0.2/10 + z²/400)) / (1 + z²/10) = 0.7167 ± 0.2266
    ours, theirs = runs([0] * 8 + [2] * 2), runs([1] * 10)
    eight = win_rate(prefers_less, ours, theirs)
    assert (eight.rate, eight.count) == (0.8, 10)
    assert eight.low == pytest.approx(0.4902, abs=5e-5)
    assert eight.high == pytest.approx(0.9433, abs=5e-5)
    assert str(eight) == "80 % [49, 94]"
    assert str(WinRate(1.0, 0.722, 1.0, 10)) == "100 % [72, 100]"
    # z = 1 (68.27 %): (0.85 ± √(0.016 + 0.0025)) / 1.1
    narrow = win_rate(prefers_less, ours, theirs, confidence=0.6826895)
    assert narrow.low == pytest.approx((0.85 - np.sqrt(0.0185)) / 1.1, abs=1e-6)
    assert narrow.high == pytest.approx((0.85 + np.sqrt(0.0185)) / 1.1, abs=1e-6)


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_the_borders_of_the_interval_are_just_not_rejected(won):
    result = win_rate(prefers_less, runs(1 - np.array(won)), runs([0.5] * len(won)))
    rate, n = np.mean(won), len(won)
    assert result.rate == pytest.approx(rate)
    assert 0 <= result.low <= rate <= result.high <= 1
    for p in (result.low, result.high):
        # The score test: |rate − p| = z·√(p (1 − p) / n).
        assert (rate - p) ** 2 == pytest.approx(1.959964**2 * p * (1 - p) / n, abs=1e-6)


def test_simulate_by_hand():
    # x⁺ = x + u with u = −x/2: 4, 2, 1; y = 3 x.
    system = LinearSystem([[1]], [[1]], [[3]], dt=1)
    T = simulate(system, lambda x: -x / 2, [4.0], 2)
    np.testing.assert_array_equal(T.x, [[4], [2], [1]])
    np.testing.assert_array_equal(T.u, [[-2], [-1]])
    np.testing.assert_array_equal(T.y, [[12], [6]])
    many = simulate(system, lambda x: -x / 2, [[4.0], [8.0]], 2)
    np.testing.assert_array_equal(many.x[..., 0], [[4, 2, 1], [8, 4, 2]])


@pytest.fixture(scope="module")
def stacked():
    """Two costs, three states for both, twelve steps; and the same by one solve at a time."""
    costs = QuadraticCost([QUADRATIC_Q, np.eye(6)], [QUADRATIC_R, 0.1 * np.eye(2)])
    x0 = random_states(8 * RADIUS, key=KEY, shape=(3,))
    single = [simulate(MASSES, LinearMPC(MASSES, costs[i], 10), x0, 12) for i in range(2)]
    return costs, x0, single


def assert_equal_loops(loops, single, atol=1e-5):
    np.testing.assert_allclose(loops.x, single.x, rtol=0, atol=atol)
    np.testing.assert_allclose(loops.u, single.u, rtol=0, atol=atol)
    np.testing.assert_allclose(loops.y, single.y, rtol=0, atol=atol)


def test_closed_loops_are_those_of_linear_mpc(stacked):
    costs, x0, single = stacked
    shared = closed_loops(MASSES, costs, x0, horizon=10, steps=12)
    assert shared.trajectories.x.shape == (2, 3, 13, 6)
    assert shared.solved.shape == shared.iterations.shape == (2, 3)
    assert shared.solved.all()
    assert (np.abs(shared.trajectories.u) == 1).any()  # the bounds matter
    for i in range(2):
        assert_equal_loops(shared.trajectories[i], single[i])
    # States of its own for each cost: the second gets them in another order.
    own = closed_loops(MASSES, costs, np.stack([x0, x0[::-1]]), horizon=10, steps=12)
    assert_equal_loops(own.trajectories[0], single[0])
    assert_equal_loops(own.trajectories[1][::-1], single[1])


def test_no_closed_loop_beats_the_optimum(stacked):
    costs, x0, single = stacked
    best = BatchedMPC(MASSES, PAPER, 12).solve(x0)
    fast = closed_loops(MASSES, costs, x0, horizon=10, steps=12).trajectories
    for loops in (fast, single[0], single[1]):
        lost = regret(PAPER, loops, best.trajectory)
        assert lost.shape == loops.batch_shape
        assert (lost >= -1e-9).all()
    lost = regret(PAPER, fast, best.trajectory)
    # The person's own controller sees 10 steps of 12; the other minimises something else.
    assert (lost[0] < 0.01 * best.cost).all()
    assert lost[0].mean() < lost[1].mean()
    np.testing.assert_array_equal(regret(PAPER, best.trajectory, best.trajectory), 0)
    np.testing.assert_allclose(regret(PAPER, fast), lost - lost.min(0), atol=1e-9)
    person = QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
    assert win_rate(person, best.trajectory, fast[1]).rate == 1
    assert win_rate(person, fast[0], fast[1]).rate == pytest.approx((lost[0] < lost[1]).mean())


def test_a_single_cost_has_no_leading_axis(stacked):
    _, x0, single = stacked
    loops = closed_loops(MASSES, PAPER, x0, horizon=10, steps=12)
    assert loops.solved.shape == (3,)
    assert_equal_loops(loops.trajectories, single[0])


def test_a_plant_that_no_input_can_hold_diverges_as_it_should():
    # x⁺ = 2 x + u with |u| ≤ 1: from 3 the input stays at −1, and x_k = 1 + 2·2ᵏ.
    system = LinearSystem([[2]], [[1]], dt=1, u_min=-1, u_max=1)
    loops = closed_loops(system, QuadraticCost([[1]], [[1]]), [[3.0]], horizon=5, steps=20)
    assert loops.solved.all()
    np.testing.assert_array_equal(loops.trajectories.u, -np.ones((1, 20, 1)))
    expected = 1 + 2 * 2.0 ** np.arange(21)
    np.testing.assert_allclose(loops.trajectories.x[0, :, 0], expected, rtol=1e-12)


def test_an_infeasible_problem_on_the_way_stops_the_simulation():
    wall = Polyhedron.box(
        [-np.inf] * 3 + [-0.01] * 3 + [-1] * 2, [np.inf] * 3 + [0.01] * 3 + [1] * 2
    )
    controller = LinearMPC(MASSES, PAPER, 5, constraints=wall)
    with pytest.raises(MPCError, match="infeasible"):
        simulate(MASSES, controller, [0.3, 0, 0, 0, 0, 0], 3)


def loops(system=MASSES, costs=PAPER, x0=RADIUS[None], horizon=2, steps=2, **options):
    return closed_loops(system, costs, x0, horizon=horizon, steps=steps, **options)


def still(x):
    return np.zeros(2)


TWO = runs([1, 2])
SHIFTED = runs([1, 2], start=1)
APART = jax.tree.map(lambda *leaves: np.stack(leaves), TWO, SHIFTED)


def failing(trajectories, *which):
    """The same trajectories, some with NaN from the first input on."""
    x, u = trajectories.x.copy(), trajectories.u.copy()
    x[list(which), 1:], u[list(which)] = np.nan, np.nan
    return bypass_init(Trajectory, x=x, u=u, y=x[..., :-1, :])


def test_a_failed_loop_never_wins():
    good = runs([1.0, 1, 1, 1])
    failed = failing(good, 0, 1, 2, 3)
    for preference in (
        QuadraticPreference([[1]], [[1]]),
        lambda a, b: np.zeros(len(a)),  # of somebody who always takes the second
        lambda a, b: np.full(len(a), np.nan),
    ):
        assert win_rate(preference, good, failed).rate == 1
        assert win_rate(preference, failed, good).rate == 0
        assert win_rate(preference, failed, failed).rate == 0.5
    # 1 fails: lost, 2 fail of both: half, the others are equal: half.
    mixed = win_rate(QuadraticPreference([[1]], [[1]]), failing(good, 0, 1), failing(good, 1))
    assert mixed.rate == pytest.approx((0 + 0.5 + 0.5 + 0.5) / 4)
    with pytest.raises(ValueError, match="trajectories must be finite, got 2 of 4 with NaN"):
        regret(effort, failing(good, 0, 1), good)
    with pytest.raises(ValueError, match="best must be finite, got 1 of 4"):
        regret(effort, good, failing(good, 2))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_same_starts_whatever_the_unit(unit):
    def scaled(start):
        T = runs([1.0, 2], start)
        return Trajectory(unit * T.x, T.u)

    prefers_first = by_criterion(effort)
    assert win_rate(prefers_first, scaled(1.0), scaled(1.0 + 1e-12)).rate == 0.5
    with pytest.raises(ValueError, match="second must start in the same states"):
        win_rate(prefers_first, scaled(1.0), scaled(1.001))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: accuracy(lambda T: np.zeros(3), ASKED), r"one cost a trajectory \(4,\), got"),
        (lambda: accuracy(lambda T: np.full(4, np.nan), ASKED), "model must return finite costs"),
        (lambda: accuracy(PAPER, POOL), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: accuracy(1.0, ASKED), "model must be a function"),
        (lambda: accuracy(PAPER, ASKED), r"trajectory.x must have shape \(..., any, 6\)"),
        (lambda: regret("σ", APART), "cost must be a function"),
        (lambda: regret(effort, [[1, 2]]), "trajectories must be a Trajectory, got list"),
        (lambda: regret(effort, TWO), r"\(controllers, states\) .*got \(2,\); or pass best"),
        (lambda: regret(effort, TWO[0]), r"trajectories must have shape \(controllers, states\)"),
        (lambda: regret(effort, APART), "trajectories must start in the same states"),
        (lambda: regret(effort, TWO, [1, 2]), "best must be a Trajectory, got list"),
        (lambda: regret(effort, TWO, SHIFTED), "best must start in the same states"),
        (lambda: regret(effort, TWO, runs([1, 2, 3])), "best must start in the same states"),
        (lambda: regret(effort, APART, TWO), "best must start in the same states"),
        (lambda: win_rate("Π", TWO, TWO), "preference must be a function"),
        (
            lambda: win_rate(lambda a, b: 1.0, TWO, TWO),
            r"one answer in \[0, 1\] .*got shape \(\)",
        ),
        (
            lambda: win_rate(lambda a, b: [7, 7], TWO, TWO),
            r"one answer in \[0, 1\] .*with 7",
        ),
        (lambda: win_rate(prefers_less, [1, 2], TWO), "first must be a Trajectory, got list"),
        (lambda: win_rate(prefers_less, TWO, None), "second must be a Trajectory, got NoneType"),
        (
            lambda: win_rate(prefers_less, APART, APART),
            r"first must have shape \(m,\), got \(2, 2\)",
        ),
        (lambda: win_rate(prefers_less, TWO, TWO[0]), r"second must have shape \(m,\), got \(\)"),
        (lambda: win_rate(prefers_less, TWO, SHIFTED), "second must start in the same states"),
        (lambda: win_rate(prefers_less, TWO, TWO[:1]), "second must start in the same states"),
        *[
            (
                lambda share=share: win_rate(prefers_less, TWO, TWO, confidence=share),
                r"confidence must lie in \(0, 1\)",
            )
            for share in (1, 0, -1)
        ],
        (lambda: win_rate(prefers_less, TWO, TWO, confidence="1"), "confidence must be a number"),
        (lambda: simulate("plant", still, RADIUS, 2), "system must be a System, got str"),
        (lambda: simulate(MASSES, still, RADIUS[:5], 2), r"x0 must have shape \(..., 6\)"),
        (lambda: simulate(MASSES, still, RADIUS * np.nan, 2), "x0 must be finite"),
        (lambda: simulate(MASSES, still, RADIUS, 0), "steps must be a whole number"),
        (lambda: simulate(MASSES, 1.0, RADIUS, 2), "controller must be a function"),
        (lambda: simulate(MASSES, lambda x: x, RADIUS, 2), r"finite input of shape \(2,\)"),
        (lambda: simulate(MASSES, lambda x: [np.nan, 0], RADIUS, 2), "finite input.*at step 0"),
        (
            lambda: simulate(MASSES, lambda x: None, RADIUS, 2),
            "controller returns must be an array",
        ),
        (lambda: loops(system=MASSES.A), "system must be a LinearSystem, got ndarray"),
        (lambda: loops(costs=QUADRATIC_Q), "costs? must be a QuadraticCost, got ndarray"),
        (lambda: loops(costs=QuadraticCost(np.eye(2), np.eye(2))), "must weigh 6 states"),
        (lambda: loops(x0=[[1, 2]]), r"x0 must have shape \(..., 6\)"),
        (lambda: loops(x0=np.full((2, 6), np.inf)), "x0 must be finite"),
        (lambda: loops(x0=np.ones((2, 2, 6))), "x0 must have shape"),
        (lambda: loops(horizon=0), "horizon must be a whole number of at least 1"),
        (lambda: loops(steps=-1), "steps must be a whole number of at least 1"),
        (lambda: loops(tol=np.nan), "tol must be finite"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
