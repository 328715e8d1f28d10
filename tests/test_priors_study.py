"""The studies of priors: the stored files are what the code gives, and what they are made of."""

from __future__ import annotations

import jax
import numpy as np
from stored_studies import WHOLE

from prefmpc import Comparisons, QuadraticCost, accuracy, lqr_pool, oscillating_masses
from studies import RADIUS, SIZES, read_spread
from studies.__main__ import BOOK
from studies.priors import (
    ASKED,
    COUPLED_Q,
    LEARNERS,
    LEVELS,
    PEOPLE,
    SCALES,
    _answered,
    _draw,
    calibration_case,
    priors_case,
)

PRIORS = read_spread(BOOK / "insight" / "priors_spread.json")
CALIBRATION = read_spread(BOOK / "insight" / "calibration_spread.json")


def test_the_book_s_regrets_are_what_the_code_gives():
    people, sizes = (PEOPLE, SIZES) if WHOLE else (PEOPLE[:1], SIZES[:1])
    again = priors_case(key=jax.random.key(0), people=people, sizes=sizes)
    stored, chosen = (PRIORS[name][0, : len(people), : len(sizes)] for name in ("regret", "chosen"))
    # The first learner stops early: where, depends on the last digits of a machine.
    np.testing.assert_allclose(again["regret"][..., 1:], stored[..., 1:], rtol=1e-2)
    np.testing.assert_allclose(again["regret"][..., 0], stored[..., 0], rtol=0.1)
    np.testing.assert_array_equal(again["chosen"], chosen)


def test_the_stored_regrets_are_complete():
    assert len(PRIORS["regret"]) >= 30
    assert PRIORS["regret"].shape[1:] == (len(PEOPLE), len(SIZES), len(LEARNERS))
    assert (PRIORS["regret"] > 0.99).all()
    assert set(np.unique(PRIORS["chosen"][..., 0])) <= set(SCALES)
    # The rule that asks nobody does not depend on the number of answers.
    alone = PRIORS["regret"][..., LEARNERS.index("Bryson's rule alone")]
    np.testing.assert_array_equal(alone, alone[..., :1] * np.ones(len(SIZES)))


def test_the_book_s_calibration_is_what_the_code_gives():
    assert len(CALIBRATION["covered"]) >= 200
    assert CALIBRATION["covered"].shape[1:] == (2, 2, len(ASKED), len(LEVELS))
    again = calibration_case(key=jax.random.key(0))
    np.testing.assert_allclose(again["covered"], CALIBRATION["covered"][0], atol=0.1)
    np.testing.assert_allclose(again["width"], CALIBRATION["width"][0], atol=0.05)
    # Laplace's method has no samples, so nothing that a machine could round differently.
    np.testing.assert_allclose(again["width"][:, 1], CALIBRATION["width"][0, :, 1], rtol=1e-3)


def test_people_answer_as_they_say():
    pool = lqr_pool(
        oscillating_masses(), 30, 10, key=jax.random.key(2400), radius=RADIUS, saturate=False
    )
    pairs = Comparisons(pool, np.arange(29), np.arange(1, 30), np.ones(29))
    coupled = _answered(pairs, "coupled", 1.0, np.random.default_rng(0))
    person = QuadraticCost(COUPLED_Q, np.diag([0.2, 0.2]))
    assert accuracy(person, coupled) == 1
    assert np.abs(COUPLED_Q - np.diag(np.diag(COUPLED_Q))).max() == 100
    unsure = _answered(pairs, "unsure", 1e9, np.random.default_rng(0))
    assert 5 < unsure.labels.sum() < 24
    assert _answered(pairs, "sure", 1.0, None) is pairs


def test_people_are_drawn_from_the_prior():
    rng = np.random.default_rng(0)
    mode = np.array([[2.0, 0.5], [0.5, 1.0]])
    draws = np.stack([_draw(mode, 2.0, rng) for _ in range(4000)])
    np.testing.assert_allclose(draws.mean(0), (2 * 2 + 3) / 4 * mode, rtol=0.06)
    assert _draw(np.array([[3.0]]), 1.0, rng).shape == (1, 1)
