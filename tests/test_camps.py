"""Camps: people who want different things are told apart, and others are not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from test_people import DATA, PRIOR, asked

from prefmpc import Comparisons, find_camps, fit_raters

WANTED = np.array([[2.0, 0.3, 0.5], [0.2, 3.0, 1.5]])
TWO = asked(WANTED[[0, 1, 0, 1, 0, 0]], 25, 11)


def test_two_camps_are_found_and_named():
    with pytest.warns(UserWarning, match=r"hide 2 camps, \[0, 2, 4, 5\] and \[1, 3\]"):
        found = find_camps(TWO, PRIOR)
    assert found.success
    assert found.count == 2
    assert found.members(1).tolist() == [1, 3]
    np.testing.assert_allclose(found.probability.sum(1), 1)
    assert found.probability[[1, 3], 1].min() > 0.9
    # The camp's σ is that of its people alone, where nobody is in doubt.
    alone = fit_raters(TWO.subset(np.isin(TWO.who, [1, 3])), PRIOR)
    ratio = found.Q[1, 0, 0] / found.Q[1, 1, 1]
    assert ratio == pytest.approx(alone.Q[0, 0] / alone.Q[1, 1], rel=0.1)
    assert found.models.batch_shape == (2,)
    with warnings.catch_warnings(action="ignore"):
        again = find_camps(TWO, PRIOR)
    np.testing.assert_array_equal(again.probability, found.probability)


def test_people_who_want_the_same_are_one_camp_however_sharp():
    data = asked(WANTED[0] * np.array([[0.5], [1.0], [2.0], [4.0]]), 25, 12)
    found = find_camps(data, PRIOR)  # a warning would be an error
    assert found.success
    assert found.count == 1
    one = fit_raters(data, PRIOR)
    assert found.log_evidence[0] == pytest.approx(one.log_evidence, abs=1e-6)
    np.testing.assert_allclose(found.Q[0], one.Q, rtol=1e-6)


def test_one_person_is_one_camp():
    found = find_camps(TWO.subset(TWO.who == 0), PRIOR)
    assert found.count == 1
    assert found.camp.tolist() == [0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: find_camps(DATA, PRIOR, most=0), "most must be a whole number"),
        (lambda: find_camps(DATA, PRIOR, starts=0), "starts must be a whole number"),
        (lambda: find_camps(DATA, PRIOR, odds=0.5), "odds must be at least 1 and finite"),
        (lambda: find_camps(DATA, PRIOR, apart=-1), "apart must be finite and at least 0"),
        (lambda: find_camps(DATA, PRIOR, key="x"), "key must be"),
        (
            lambda: find_camps(
                Comparisons(DATA.trajectories, DATA.first, DATA.second, DATA.labels), PRIOR
            ),
            "comparisons must say who",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
