"""The race of strategies: one fresh draw, small."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from studies import asking

KEY = jax.random.key(1000)


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
