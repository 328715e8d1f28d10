"""Simulated people, and the tools to put them together, against answers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prefmpc import (
    QuadraticPreference,
    SettlingTimePreference,
    Trajectory,
    by_criterion,
    erring,
    lexicographic,
    logistic,
    max_input,
    one_by_one,
    settling_time,
)
from prefmpc._pytree import bypass_init

RNG = np.random.default_rng(0)
POOL = Trajectory(*(RNG.normal(size=(6, *s)) for s in [(4, 2), (3, 1), (3, 5)]))
Q, R = np.diag([2.0, 1.0]), np.eye(1)
PREFERENCE = QuadraticPreference(Q, R)
INF, NAN = np.inf, np.nan


def stage(x, u):
    """A trajectory of one step, whose φ is 2 x₁² + x₂² + u²."""
    return Trajectory(np.array([x, [0, 0]], float), np.array([[u]], float))


def test_the_smaller_phi_is_preferred_and_equals_count_for_the_first():
    small, large, other = stage([1, 0], 0), stage([1, 1], 1), stage([0, 1], 1)  # 2, 4, 2
    assert PREFERENCE(small, large) == 1
    assert PREFERENCE(large, small) == 0
    assert PREFERENCE(small, other) == PREFERENCE(other, small) == 1
    answers = PREFERENCE(POOL[[0, 1, 2]], POOL[[3, 4, 5]])
    assert answers.shape == (3,)
    assert answers.dtype == np.float64


def test_one_by_one_asks_the_same_question_of_every_pair():
    ask = one_by_one(lambda first, second: float(PREFERENCE(first, second)))
    first, second = POOL[[0, 1, 2]], POOL[[3, 4, 5]]
    np.testing.assert_array_equal(ask(first, second), PREFERENCE(first, second))


def responses(*rows):
    """A batch of trajectories from outputs y_0 … y_3 and the largest input of each."""
    y, u = (np.array(column, float) for column in zip(*rows, strict=True))
    inputs = np.zeros((len(rows), 4, 2))
    inputs[:, 1, 1] = u
    return Trajectory(np.zeros((len(rows), 5, 1)), inputs, y[..., None])


AT_1, AT_2, NEVER, TOO_LATE = [1, 0, 0, 0], [-1, 1, 0, 0], [1, 1, 1, 1], [0, 0, 0, 1]


def test_the_response_that_settles_first_is_preferred_whatever_it_takes():
    ask = SettlingTimePreference()
    answers = ask(
        responses((AT_1, 9), (AT_2, 1), (AT_1, 9), (NEVER, 1), (TOO_LATE, 1)),
        responses((AT_2, 1), (AT_1, 9), (NEVER, 1), (AT_2, 9), (AT_2, 9)),
    )
    np.testing.assert_array_equal(answers, [1, 0, 1, 0, 0])
    assert answers.dtype == np.float64


def test_among_equal_settling_times_the_smaller_input_wins():
    first = responses((AT_1, 1), (AT_1, -3), (AT_2, 2), (NEVER, 1), (TOO_LATE, 2), (NEVER, 1))
    second = responses((AT_1, 2), (AT_1, 2), (AT_2, -2), (TOO_LATE, 1), (NEVER, 1), (AT_1, 9))
    np.testing.assert_array_equal(SettlingTimePreference()(first, second), [1, 0, 1, 1, 0, 0])
    half = SettlingTimePreference(tie_break=None)
    np.testing.assert_array_equal(half(first, second), [0.5] * 5 + [0])
    drop = SettlingTimePreference(tie_break=None, ties="drop")
    np.testing.assert_array_equal(drop(first, second), [NAN] * 5 + [0])
    # With Πᵤ nothing is left to drop.
    both = SettlingTimePreference(ties="drop")
    np.testing.assert_array_equal(both(first, second), [1, 0, 1, 1, 0, 0])


def test_epsilon_says_what_settled_means():
    slow, quick = responses(([2, 0.4, 0.4, 0.3], 0)), responses(([2, 0.6, 0.1, 0.1], 0))
    for epsilon, answer in {0.2: 0, 0.3: 0, 0.5: 1, 0.7: 0.5, 3: 0.5}.items():
        ask = SettlingTimePreference(epsilon, tie_break=None)
        np.testing.assert_array_equal(ask(slow, quick), [answer])
        np.testing.assert_array_equal(ask(quick, slow), [1 - answer])


def test_a_single_pair_has_a_single_answer():
    first, second = responses((AT_1, 1), (AT_2, 1))[0], responses((AT_2, 1))[0]
    assert SettlingTimePreference()(first, second) == 1
    assert by_criterion(settling_time)(first, second).shape == ()
    assert logistic(max_input, 1.0)(first, second) == 0.5


def having(values):
    """Trajectories that start in ``values``, for the criterion below; infinite ones too."""
    values = np.asarray(values, float)
    x = np.zeros((len(values), 2, 2))
    x[:, 0, 0], x[:, 0, 1] = np.nan_to_num(values, posinf=0), np.isinf(values)
    return Trajectory(x, np.zeros((len(values), 1, 1)))


def criterion(T):
    return np.where(T.x[..., 0, 1] == 1, INF, T.x[..., 0, 0])


def test_the_smaller_criterion_wins_by_more_than_the_tolerance():
    first, second = having([1, 2, 2, 3, 5, INF, INF]), having([2, 1, 2, 5, 3, INF, 0])
    exact = by_criterion(criterion)
    np.testing.assert_array_equal(exact(first, second), [1, 0, 0.5, 1, 0, 0.5, 0])
    np.testing.assert_array_equal(exact(second, first), [0, 1, 0.5, 0, 1, 0.5, 1])
    blunt = by_criterion(criterion, tolerance=1)
    np.testing.assert_array_equal(blunt(first, second), [0.5, 0.5, 0.5, 1, 0, 0.5, 0])
    np.testing.assert_array_equal(
        by_criterion(max_input)(responses((AT_1, -3)), responses((AT_1, 2))), [0]
    )


def always(*answers):
    return lambda first, second: np.array(answers)


def scripted(*answers):
    """Answers by the first trajectory's number (its x(0)), and remembers what it was asked."""
    asked = []

    def preference(first, second):
        numbers = np.asarray(first.x[:, 0, 0], int)
        asked.append(list(numbers))
        return np.asarray(answers, float)[numbers]

    return preference, asked


def test_one_is_asked_after_another_until_somebody_decides():
    T = Trajectory(np.arange(6.0)[:, None, None] * np.ones((2, 1)), np.zeros((6, 1, 1)))
    one, _ = scripted(1, 0, 0.5, NAN, 0.7, 0.5)
    two, asked_two = scripted(0, 1, 0, 1, 0, NAN)
    three, asked_three = scripted(NAN, NAN, NAN, NAN, NAN, 0.5)
    np.testing.assert_array_equal(lexicographic(one)(T, T), [1, 0, 0.5, NAN, 0.7, 0.5])
    np.testing.assert_array_equal(lexicographic(one, two)(T, T), [1, 0, 0, 1, 0.7, NAN])
    np.testing.assert_array_equal(lexicographic(one, two, three)(T, T), [1, 0, 0, 1, 0.7, 0.5])
    # Only about what is still open; a person's time is dear.
    assert asked_two == [[2, 3, 5], [2, 3, 5]]
    assert asked_three == [[5]]
    # Nobody decides: the last answer stands. A single pair works as well.
    nobody = lexicographic(scripted(0.5, NAN)[0], scripted(NAN, 0.5)[0])
    np.testing.assert_array_equal(nobody(T[:2], T[:2]), [NAN, 0.5])
    assert lexicographic(one, two)(T[3], T[3]) == 1


def prefers_less_input(first, second):
    """Πᵤ as the paper's text has it."""
    return np.where(max_input(first) <= max_input(second), 1.0, 0.0)


@given(arrays(float, (2, 8, 4), elements=st.integers(0, 1)), st.integers(0, 100))
def test_the_paper_s_preference_is_settling_first_then_effort(y, seed):
    u = np.random.default_rng(seed).integers(-1, 2, (2, 8, 4, 1)).astype(float)
    first, second = (Trajectory(np.zeros((8, 5, 1)), u[i], y[i, ..., None]) for i in (0, 1))
    put_together = lexicographic(by_criterion(settling_time), prefers_less_input)
    expected = SettlingTimePreference()(first, second)
    assert set(expected) <= {0, 1}
    np.testing.assert_array_equal(put_together(first, second), expected)


def test_wrong_answers_come_with_their_rate():
    T = having([0] * 5)
    person = always(1, 0, 0.5, 0.7, NAN)
    # 0.9·0.7 + 0.1·0.3 = 0.66
    np.testing.assert_allclose(erring(person, 0.1)(T, T), [0.9, 0.1, 0.5, 0.66, NAN], rtol=1e-14)
    np.testing.assert_array_equal(erring(person, 0)(T, T), person(T, T))
    np.testing.assert_allclose(erring(person, 1)(T, T), [0, 1, 0.5, 0.3, NAN], atol=1e-15)
    np.testing.assert_array_equal(erring(person, 0.5)(T, T), [0.5] * 4 + [NAN])


def test_choices_by_the_logistic_function():
    # P = 1 / (1 + exp(gap / 2)) at the gaps 0, 2, −2, 2 ln 3 and −2 ln 3.
    first, second = having([3, 5, 3, 2 * np.log(3), 0]), having([3, 3, 5, 0, 2 * np.log(3)])
    expected = [0.5, 1 / (1 + np.e), np.e / (1 + np.e), 0.25, 0.75]
    np.testing.assert_allclose(logistic(criterion, 2.0)(first, second), expected, rtol=1e-14)


def test_an_infinite_criterion_loses_for_certain_and_a_huge_gap_overflows_nowhere():
    first, second = having([INF, INF, 3, 1e300, 0, 1e4]), having([INF, 3, INF, 0, 1e300, 0])
    np.testing.assert_array_equal(logistic(criterion, 1.0)(first, second), [0.5, 0, 1, 0, 1, 0])


NUMBERS = st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1.0, INF])
VALUES = st.lists(NUMBERS, min_size=4, max_size=4)


@given(VALUES, VALUES, st.floats(1e-3, 1e3))
def test_both_orders_of_a_pair_give_the_same_person(a, b, scale):
    first, second = having(a), having(b)
    unsure = logistic(criterion, scale)
    p, q = unsure(first, second), unsure(second, first)
    np.testing.assert_allclose(p + q, 1, atol=1e-15)
    sure = by_criterion(criterion)(first, second)
    np.testing.assert_array_equal(sure + by_criterion(criterion)(second, first), 1)
    assert (np.sign(p - 0.5) * np.sign(sure - 0.5) >= 0).all()


def broken(trajectories, *, field="x"):
    """The same trajectories with NaN from the second step on, in the states or in the inputs."""
    parts = {name: getattr(trajectories, name).copy() for name in ("x", "u", "y")}
    parts[field][..., 1:, :] = NAN
    return bypass_init(Trajectory, **parts)


LOSES_TO_NONE = {
    "quadratic": PREFERENCE,
    "settling": SettlingTimePreference(),
    "settling alone": SettlingTimePreference(tie_break=None),
    "criterion": by_criterion(max_input, 1e9),
    "criterion with NaN": by_criterion(lambda T: T.x.sum((-1, -2))),
    "lexicographic": lexicographic(by_criterion(max_input, 1e9), lambda a, b: np.zeros(len(a))),
    "logistic": logistic(lambda T: np.full(T.batch_shape, INF), 1.0),
    "one by one": one_by_one(lambda a, b: float("nan") if np.isnan(a.x).any() else 0.5),
}


@pytest.mark.parametrize("name", LOSES_TO_NONE)
@pytest.mark.parametrize("field", ["x", "u", "y"])
def test_a_failed_loop_is_worse_than_every_other(name, field):
    preference = LOSES_TO_NONE[name]
    # The bad ones are as bad as it gets: they never settle, and push hard.
    bad = Trajectory(1e3 + POOL.x, 1e3 + POOL.u, 1e3 + POOL.y)
    failed = broken(POOL, field=field)
    np.testing.assert_array_equal(preference(bad, failed), 1)
    np.testing.assert_array_equal(preference(failed, bad), 0)
    np.testing.assert_array_equal(preference(failed, failed), 0.5)
    if name != "one by one":
        assert preference(bad[0], failed[0]) == 1
    np.testing.assert_allclose(erring(preference, 0.1)(bad, failed), 0.9)
    np.testing.assert_allclose(erring(preference, 0.1)(failed, bad), 0.1)


def test_no_answer_about_two_failed_loops_where_ties_are_dropped():
    failed = broken(POOL)
    assert np.isnan(SettlingTimePreference(tie_break=None, ties="drop")(failed, failed)).all()


def test_nobody_is_asked_about_a_failed_loop():
    asked = []
    ask = one_by_one(lambda a, b: asked.append(a) or 1.0)
    first = Trajectory(*(np.concatenate([leaf[:2], leaf[:2]]) for leaf in (POOL.x, POOL.u, POOL.y)))
    second = bypass_init(Trajectory, x=first.x.copy(), u=first.u, y=first.y)
    second.x[1] = NAN
    np.testing.assert_array_equal(ask(first, second), 1)
    assert len(asked) == 3


def constant(value):
    return lambda T: np.full(T.batch_shape, value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: QuadraticPreference(-Q, R), "Q must be positive semidefinite"),
        (lambda: QuadraticPreference(Q, [[np.nan]]), "R must be finite"),
        (lambda: QuadraticPreference(np.eye(3), R)(POOL, POOL), r"Q must have shape \(..., 2, 2\)"),
        (lambda: one_by_one("ask"), "ask must be a function"),
        (
            lambda: one_by_one(lambda a, b: "left")(POOL, POOL),
            "ask returns must be an array",
        ),
        (lambda: SettlingTimePreference(-0.1), "epsilon must be finite and at least 0, got -0.1"),
        (lambda: SettlingTimePreference(NAN), "epsilon must be finite"),
        (lambda: SettlingTimePreference("0.1"), "epsilon must be a number of at least 0"),
        (lambda: SettlingTimePreference(tie_break="u"), 'tie_break must be "max_input" or None'),
        (lambda: SettlingTimePreference(ties="skip"), 'ties must be "half" or "drop", got .skip'),
        (lambda: SettlingTimePreference()(POOL.y, POOL.y), "first must be a Trajectory"),
        (lambda: by_criterion(1.0), "criterion must be a function, got 1.0"),
        (lambda: by_criterion(max_input, -1), "tolerance must be finite and at least 0"),
        (lambda: by_criterion(max_input, INF), "tolerance must be finite"),
        (lambda: by_criterion(lambda T: 1)(POOL, POOL), r"one number a trajectory \(6,\), got"),
        (lambda: by_criterion(lambda T: T.u)(POOL, POOL), r"got shape \(6, 3, 1\)"),
        (lambda: by_criterion(constant(NAN))(POOL, POOL), r"got shape \(6,\) with NaN"),
        (lambda: lexicographic(), "at least one preference, got none"),
        (lambda: lexicographic(PREFERENCE, "Πᵤ"), r"preferences\[1\] must be a function"),
        (lambda: erring("Π", 0.1), "preference must be a function"),
        (lambda: erring(PREFERENCE, 1.1), r"rate must lie in \[0, 1\], got 1.1"),
        (lambda: erring(PREFERENCE, -0.1), "rate must be finite and at least 0"),
        (lambda: erring(PREFERENCE, NAN), "rate must be finite"),
        (lambda: logistic(None, 1.0), "criterion must be a function"),
        (lambda: logistic(max_input, 0), "scale must be positive, got 0"),
        (lambda: logistic(max_input, -1), "scale must be positive, got -1"),
        (lambda: logistic(max_input, INF), "scale must be positive and finite"),
        (lambda: logistic(constant(NAN), 1)(POOL, POOL), "one number a trajectory.*with NaN"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
