"""Agreement counted by hand, weights that forget, and a test of change."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import beta
from test_people import DATA, POOL, PRIOR, SEEN, asked

from prefmpc import Comparisons, agreement, forgetting, has_changed

WHO = np.array(["Ada", "Ada", "Bob", "Bob", "Ada", "Eve", "Eve"])
# Ada answers 0–1 twice, once with the sides exchanged, and 2–3 once; Bob and Eve likewise.
FEW = Comparisons(POOL, [0, 1, 0, 1, 2, 3, 4], [1, 0, 1, 0, 3, 2, 5], [1, 0, 1, 1, 0, 0.5, 1], WHO)


def test_agreement_of_a_few_answers_by_hand():
    both = agreement(FEW)
    # Ada agrees with herself, Bob does not; Ada's two answers meet Bob's two: half agree. Ada and
    # Eve on 2–3: Eve cannot say.
    assert both.within.questions == 2
    assert both.within.share == pytest.approx(0.5)
    assert both.between.questions == 2
    assert both.between.share == pytest.approx((2 + 0.5) / 5)
    low, high = beta.ppf([0.05, 0.95], 2 * 0.5 + 0.5, 2 * 0.5 + 0.5)
    assert [both.within.lower, both.within.upper] == pytest.approx([low, high])
    assert both.within.ceiling == pytest.approx(0.5)


def test_agreement_counts_all_pairs_of_answers():
    rng = np.random.default_rng(0)
    n = 150
    first, second = rng.integers(0, 3, n), 3 + rng.integers(0, 3, n)
    labels, who = rng.choice([0, 0.2, 0.5, 1], n), rng.integers(0, 4, n)
    turn = rng.uniform(size=n) < 0.5
    sides = np.where(turn, second, first), np.where(turn, first, second)
    both = agreement(Comparisons(POOL, *sides, np.where(turn, 1 - labels, labels), who))
    equal = {True: [], False: []}
    for i, j in itertools.combinations(range(n), 2):
        if first[i] == first[j] and second[i] == second[j]:
            a, b = labels[i], labels[j]
            equal[bool(who[i] == who[j])].append(a * b + (1 - a) * (1 - b))
    assert both.within.share == pytest.approx(np.mean(equal[True]))
    assert both.between.share == pytest.approx(np.mean(equal[False]))


def test_no_model_agrees_more_than_the_ceiling_says():
    q = np.random.default_rng(1).uniform(size=1000)
    share = np.mean(q**2 + (1 - q) ** 2)
    best = np.mean(np.maximum(q, 1 - q))
    assert best < 0.5 + 0.5 * np.sqrt(2 * share - 1) < best + 0.05
    data = Comparisons(POOL, np.zeros(2, int), np.ones(2, int), [1, 1])
    within = agreement(data).within
    assert within.share == within.upper == within.ceiling == 1.0
    assert 0.2 < within.lower < 0.3


def test_without_repeated_questions_nothing_is_said():
    both = agreement(Comparisons(POOL, [0, 1], [1, 2], [1, 0], [1, 2]))
    assert both.between.questions == both.within.questions == 0
    assert np.isnan(both.between.share)
    assert np.isnan(both.within.ceiling_upper)


def test_weights_halve_after_each_half_life():
    np.testing.assert_allclose(forgetting(7, 2.0)[::-2], [1, 0.5, 0.25, 0.125])


def answered_in_turn(early, late, each, seed):
    parts = [asked(w, each, seed + k) for k, w in enumerate((early, late))]
    columns = (np.concatenate([getattr(p, name) for p in parts]) for name in ("first", "second"))
    return Comparisons(POOL, *columns, np.concatenate([p.labels for p in parts]))


def test_a_change_of_wishes_is_seen_and_tiredness_is_none():
    early, late = np.array([3.0, 0.2, 0.5]), np.array([0.1, 3.0, 2.0])
    changed = has_changed(answered_in_turn(early, late, 30, 1), PRIOR, simulations=19)
    assert changed.success
    assert changed.p_value == pytest.approx(1 / 20)
    assert changed.statistic > changed.simulated.max()
    tired = has_changed(answered_in_turn(early, early / 6, 30, 3), PRIOR, simulations=19)
    assert tired.p_value > 0.1
    again = has_changed(answered_in_turn(early, early / 6, 30, 3), PRIOR, simulations=19)
    np.testing.assert_array_equal(again.simulated, tired.simulated)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: agreement(SEEN), "comparisons must be a Comparisons"),
        (lambda: agreement(FEW, level=0), r"level must lie in \(0, 1\)"),
        (lambda: forgetting(0, 1.0), "n must be a whole number"),
        (lambda: forgetting(3, 0.0), "half_life must be positive"),
        (lambda: has_changed(DATA, PRIOR, split=1.0), r"split must lie in \(0, 1\)"),
        (lambda: has_changed(DATA, PRIOR, simulations=0), "simulations must be a whole number"),
        (lambda: has_changed(DATA.subset([0]), PRIOR), "before and after the split, got 1"),
        (lambda: has_changed(None, PRIOR), "comparisons must be a Comparisons"),
        (lambda: has_changed(DATA, None), "prior must be a WishartPrior"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
