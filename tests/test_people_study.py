"""Several people: parts of the stored draws, computed again."""

from __future__ import annotations

import jax
import numpy as np
from stored_studies import head_of

from prefmpc._random import generator
from studies import people, read_spread
from studies.__main__ import BOOK, STUDIES

WHERE = BOOK / STUDIES["people"][1]


def test_the_stored_file_is_about_what_the_code_says():
    stored, _ = head_of(WHERE, least=30)
    head = STUDIES["people"][2]
    assert {key: stored[key] for key in head} == {key: tuple(value) for key, value in head.items()}


def test_parts_of_a_draw_are_what_the_code_gives():
    stored = read_spread(WHERE)
    streams = generator(jax.random.key(0)).spawn(6)
    pool = people.people_pool(streams[0])
    _, _, apart = people.newcomers(pool, streams[2])
    np.testing.assert_allclose(apart, stored["apart"][0], rtol=0.02)
    _, _, p_value = people.change(pool, streams[5])
    np.testing.assert_allclose(p_value, stored["p_value"][0], atol=0.06)


def test_a_person_errs_as_often_as_said():
    rng = np.random.default_rng(0)
    pool = people.people_pool(rng)
    one = people.Someone(rng.standard_normal(8), pool)
    first, second = people.questions(4000, rng)
    assert (first != second).all()
    np.testing.assert_array_equal(pool.x[first, 0], pool.x[second, 0])
    P = one.P(first, second)
    assert np.minimum(P, 1 - P).mean() < 0.15
    np.testing.assert_array_equal(P > 0.5, one.cost[first] < one.cost[second])
