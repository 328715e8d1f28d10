"""What answers are worth: small fresh draws, and a part of the stored ones."""

from __future__ import annotations

import jax
import numpy as np
from stored_studies import head_of

from studies import answers, read_spread
from studies.__main__ import BOOK, STUDIES

_, WHERE, HEAD = STUDIES["answers"]


def test_a_part_of_the_study_is_what_the_code_gives():
    stored, draws = head_of(BOOK / WHERE, least=100)
    assert draws == 100
    assert {key: stored[key] for key in HEAD} == HEAD
    fresh = answers.answers_case(
        key=jax.random.key(0), people=("random, unsure",), counts=answers.COUNTS[:1]
    )
    kept = read_spread(BOOK / WHERE)
    np.testing.assert_allclose(fresh["regret"][0], kept["regret"][0, 1, :, :1], atol=1e-3)
    np.testing.assert_allclose(fresh["ties"][0], kept["ties"][0, 1, :1], atol=1e-3)


def test_what_the_study_finds():
    regret = read_spread(BOOK / WHERE)["regret"].mean(axis=0)
    row = {name: regret[:, i] for i, name in enumerate(answers.LEARNERS)}
    for worse in ("forced choice", "ties dropped", "ties as halves"):
        assert (row["ties"] < row[worse]).all()
    assert (row["strengths"] < row["ties"]).all()
    # Rankings of five, a quarter as many, are worth the pairs once there are ten.
    assert (row["ranking of five"][:, 1:] < row["forced choice"][:, 1:]).all()
