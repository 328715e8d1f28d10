"""Choosing a prior: the scores against their definitions, the choice against what is known."""

from __future__ import annotations

import numpy as np
import pytest
from sampled_answers import sampled_answers

from prefmpc import (
    Comparisons,
    FitError,
    bryson,
    choose_prior,
    fit_map,
)
from prefmpc.learning import selection
from studies import RADIUS

TRUE = bryson(RADIUS, [1, 1], scale=3e-3)
POOL, ANSWERS = sampled_answers(TRUE, 60, seed=2200)
PRIORS = [
    bryson(RADIUS, [1, 1], scale=s, strength=a) for s in (3e-5, 3e-3, 0.3) for a in (1.0, 10.0)
]


def test_cross_validation_scores_are_those_of_fits_on_the_other_folds():
    chosen = choose_prior(ANSWERS, PRIORS, by="cross_validation")
    for score, prior in list(zip(chosen.scores, PRIORS, strict=True))[1:4]:
        total = 0.0
        for k in range(5):
            out = np.arange(60) % 5 == k
            model = fit_map(ANSWERS.subset(~out), prior).model
            held = ANSWERS.subset(out)
            first, second = held.pairs
            z = np.asarray(model(second) - model(first))
            total += np.sum(held.labels * z - np.logaddexp(0, z))
        assert score == pytest.approx(total / 60, rel=1e-5)
    assert chosen.chosen == np.argmax(chosen.scores)
    assert chosen.prior is PRIORS[chosen.chosen]
    np.testing.assert_allclose(chosen.result.Q, fit_map(ANSWERS, chosen.prior).Q, rtol=1e-8)


@pytest.mark.parametrize("by", ["evidence", "cross_validation"])
def test_the_scale_of_the_truth_is_found(by):
    chosen = choose_prior(ANSWERS, PRIORS, by=by)
    assert PRIORS.index(chosen.prior) in (2, 3)
    again = choose_prior(ANSWERS, PRIORS, by=by)
    np.testing.assert_array_equal(chosen.scores, again.scores)


def test_one_evidence_is_that_among_many():
    alone = choose_prior(ANSWERS, [PRIORS[3]])
    many = choose_prior(ANSWERS, PRIORS)
    assert alone.scores[0] == pytest.approx(many.scores[3], abs=1e-5)


def test_answers_that_say_nothing_have_the_evidence_of_a_coin():
    nothing = Comparisons(POOL, [0, 3], [0, 3], [0.5, 1.0])
    scores = choose_prior(nothing, PRIORS).scores
    # Laplace's method is not exact for the prior itself: the gammas of weak ones are skewed.
    assert (np.abs(scores + 2 * np.log(2)) < [0.6, 0.1] * 3).all()


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
@pytest.mark.parametrize("place", ["decrement", "log_evidence"])
def test_only_evidence_at_a_mode_counts(monkeypatch, place, bad):
    true = selection.laplaces

    def broken(*arguments):
        return [found._replace(**{place: bad}) for found in true(*arguments)]

    monkeypatch.setattr(selection, "laplaces", broken)
    if (place, bad) == ("log_evidence", 1.0):
        assert choose_prior(ANSWERS, [TRUE]).scores[0] == 1.0
        return
    with pytest.raises(FitError, match="1 of 1 evidences were not found"):
        choose_prior(ANSWERS, [TRUE])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: choose_prior(POOL, PRIORS), "comparisons must be a Comparisons, got Trajectory"),
        (lambda: choose_prior(ANSWERS, []), "priors must be a sequence of at least one"),
        (lambda: choose_prior(ANSWERS, TRUE), "priors must be a sequence of at least one"),
        (lambda: choose_prior(ANSWERS, [1]), "priors must be a WishartPrior, got int"),
        (lambda: choose_prior(ANSWERS, PRIORS, by="luck"), 'must be "evidence" or "cross_vali'),
        (
            lambda: choose_prior(ANSWERS, PRIORS, by="cross_validation", folds=61),
            "folds must lie between 2 and the 60 comparisons, got 61",
        ),
        (lambda: choose_prior(ANSWERS, PRIORS, structure="banded"), 'structure must be "full"'),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
