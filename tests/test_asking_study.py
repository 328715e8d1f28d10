"""The race of strategies and its limits: small fresh draws, and parts of the stored ones."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from stored_studies import head_of

from prefmpc import phi
from studies import asking, asking_limits, read_spread
from studies.__main__ import BOOK, STUDIES

KEY = jax.random.key(1000)
LEAST = {"asking": 60, "fewer": 100, "stopping": 25, "limits": 20, "settled": 15}


def test_a_regret_does_not_depend_on_what_else_is_raced():
    alone = asking.asking_case(
        key=KEY, people=("random, sure",), strategies=("made on purpose",), counts=(3, 6), loops=10
    )["regret"]
    both = asking.asking_case(
        key=KEY,
        people=("paper, sure", "random, sure"),
        strategies=("random pairs, same x(0)", "made on purpose"),
        counts=(3, 6),
        loops=10,
    )["regret"]
    assert both.shape == (2, 2, 2)
    np.testing.assert_allclose(both[1, 1], alone[0, 0], rtol=1e-6)


@pytest.mark.parametrize("kind", ["paper", "random", "coupled"])
def test_the_unsure_ones_want_what_the_sure_ones_want(kind):
    sure, unsure = (
        asking.draw_person(f"{kind}, {mood}", np.random.default_rng(0))
        for mood in ("sure", "unsure")
    )
    np.testing.assert_array_equal(sure.Q, unsure.Q)
    assert np.linalg.eigvalsh(sure.Q).min() > 0
    assert (np.count_nonzero(sure.Q) == 36) == (kind == "coupled")
    pool = asking.paper_pool(np.random.default_rng(1))
    P = unsure.answers(pool[:25], pool[25:])
    np.testing.assert_array_equal(P > 0.5, sure.answers(pool[:25], pool[25:]) > 0.5)
    assert 0.02 < np.minimum(P, 1 - P).mean() < 0.25


@pytest.mark.parametrize("name", ["asking", "fewer", "stopping", "limits", "settled"])
def test_the_stored_files_are_about_what_the_code_says(name):
    _, where, head = STUDIES[name]
    stored, draws = head_of(BOOK / where, least=LEAST[name])
    assert draws >= LEAST[name]
    assert {key: stored[key] for key in head} == head


def test_a_part_of_the_race_is_what_the_code_gives():
    people, strategies = ("random, sure",), ("made on purpose", "made on purpose, regret")
    fresh = asking.asking_case(
        key=jax.random.key(0), people=people, strategies=strategies, counts=(5, 10)
    )["regret"]
    stored = read_spread(BOOK / "extensions" / "asking_spread.json")["regret"][0]
    rows = [list(asking.STRATEGIES).index(name) for name in strategies]
    np.testing.assert_allclose(fresh[0], stored[2][rows, :2], atol=1e-3)
    assert asking.PEOPLE[2] == people[0]
    few = read_spread(BOOK / "extensions" / "fewer_spread.json")["regret"]
    race = read_spread(BOOK / "extensions" / "asking_spread.json")["regret"]
    same = race[:, 0, list(asking.STRATEGIES).index("made on purpose"), 1]
    np.testing.assert_allclose(few[: len(race), 0, 0, 0], same, atol=1e-3)


def test_somebody_who_stops_is_as_stored():
    stored = read_spread(BOOK / "extensions" / "stopping_spread.json")
    number = asking_limits.STOPPING_PEOPLE.index("random, sure")
    fresh = asking_limits.stopping_case(key=jax.random.key(0), people=(number,))
    for name, values in fresh.items():
        np.testing.assert_allclose(values[0], stored[name][0, number], atol=2e-3)
    kept = stored["asked"][np.isfinite(stored["asked"])]
    assert ((kept >= 1) & (kept <= asking_limits.CAP)).all()
    at_stop = stored["stated"][..., -1]
    np.testing.assert_array_equal(np.isfinite(stored["asked"]), ~np.isnan(at_stop))
    assert np.nanmax(at_stop) <= 0.02


def test_people_from_the_prior_are_as_wide_as_it_says():
    people = [asking_limits.prior_person(np.random.default_rng(i)) for i in range(400)]
    weights = np.array([np.r_[np.diag(p.Q), np.diag(p.R)] for p in people])
    centre = np.r_[np.diag(asking.rule().Q), np.diag(asking.rule().R)]
    log = np.log(weights / centre)
    np.testing.assert_allclose(log.std(), np.hypot(2, 2), rtol=0.1)
    np.testing.assert_allclose((log - log.mean(1, keepdims=True)).std(), 2, rtol=0.1)
    pool = asking.paper_pool(np.random.default_rng(0))
    cost = np.asarray(phi(pool, people[0].Q, people[0].R))
    P = people[0].answers(pool[:25], pool[25:])
    np.testing.assert_allclose(P, 1 / (1 + np.exp(cost[:25] - cost[25:])), rtol=1e-6, atol=1e-12)


def test_a_part_of_the_limits_is_what_the_code_gives():
    fresh = asking_limits.limits_case(key=jax.random.key(0), counts=(5,))
    stored = read_spread(BOOK / "extensions" / "limits_spread.json")
    for name, values in fresh.items():
        np.testing.assert_allclose(values, stored[name][0][..., :1], atol=2e-3)


def test_a_part_of_the_settling_table_is_what_the_code_gives():
    fresh = asking_limits.settled_case(key=jax.random.key(0), ways=("information",), counts=(20,))[
        "table"
    ]
    stored = read_spread(BOOK / "extensions" / "settled_spread.json")["table"][0]
    np.testing.assert_allclose(fresh[:, 0, 0], stored[:, 0, 0], rtol=0.02)
