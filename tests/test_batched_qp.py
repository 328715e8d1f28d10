"""Many quadratic programs side by side, against Clarabel and by hand."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_programs import answers, by_clarabel, random_programs

from prefmpc.mpc import _batched_qp
from prefmpc.mpc._batched_qp import INFEASIBLE, SOLVED, STATUSES, solve
from prefmpc.mpc._condensed import inverse_of, scaled


def test_random_programs_have_the_statuses_and_solutions_of_clarabel():
    # `make bench` does the same with 10,000.
    programs = random_programs(400, 24, 60, np.random.default_rng(0))
    found = answers(*programs)
    statuses = STATUSES[np.asarray(found.status)[:, 0]]
    assert min((statuses == "solved").sum(), (statuses == "infeasible").sum()) > 100
    for i, program in enumerate(zip(*programs, strict=True)):
        status, v = by_clarabel(*program)
        assert statuses[i] == status
        if status == "solved":
            np.testing.assert_allclose(found.U[i, 0], v, rtol=0, atol=1e-6)


def by_hand(G, h, q=-4.0, lower=-np.inf, upper=np.inf):
    """min v² + q v, that is at v = −q/2 without limits."""
    G, h = np.reshape(G, (1, -1, 1)).astype(float), np.reshape(h, (1, -1)).astype(float)
    one = np.ones((1, 1))
    found = answers(2 * one[None], q * one, lower * one, upper * one, G, h)
    return STATUSES[int(found.status[0, 0])], float(found.U[0, 0, 0])


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (by_hand([1], [9]), ("solved", 2)),
        (by_hand([1], [1]), ("solved", 1)),
        (by_hand([1, 1, 2], [1, 1, 2]), ("solved", 1)),  # the same row three times
        (by_hand([1, -1], [1, -1]), ("solved", 1)),  # room for one point only
        (by_hand([-1], [-3]), ("solved", 3)),
        (by_hand([0, 1], [0, 5]), ("solved", 2)),  # a row that no v changes
        (by_hand([1], [9], upper=0.5), ("solved", 0.5)),
        (by_hand([1], [9], q=1e8, lower=-3), ("solved", -3)),
    ],
)
def test_one_variable_by_hand(limits, expected):
    assert limits[0] == expected[0]
    assert limits[1] == pytest.approx(expected[1], abs=1e-8)


@pytest.mark.parametrize(
    "limits",
    [
        by_hand([1, -1], [1, -1.001]),
        by_hand([0], [-1e-3]),
        by_hand([-1], [-3], upper=2.9),
        by_hand([1, -1], [-1e6, -1e6]),
    ],
)
def test_what_cannot_be_is_infeasible(limits):
    assert limits[0] == "infeasible"


@settings(max_examples=5)
@given(st.integers(0, 10_000))
def test_no_feasible_direction_goes_downhill(seed):
    H, q, lower, upper, G, h = random_programs(64, 5, 20, np.random.default_rng(seed))
    found = answers(H, q, lower, upper, G, h)
    for i in np.flatnonzero(np.asarray(found.status)[:, 0] == SOLVED)[:10]:
        v = np.asarray(found.U[i, 0])
        assert (lower[i] - 1e-7 <= v).all()
        assert (v <= upper[i] + 1e-7).all()
        assert (G[i] @ v <= h[i] + 1e-6).all()
        status, other = by_clarabel(H[i], q[i] * 0.5, lower[i], upper[i], G[i], h[i])
        assert status == "solved"
        assert (H[i] @ v + q[i]) @ (other - v) >= -1e-5 * (1 + np.abs(q[i]).max())


def test_nothing_else_is_ever_called_solved():
    # NaN in the data, and infeasible problems without the method that can tell.
    H, q, lower, upper, G, h = random_programs(64, 5, 20, np.random.default_rng(3))
    q[:8] = np.nan
    for thorough in (False, True):
        found = answers(H, q, lower, upper, G, h)
        status = np.asarray(found.status)[:, 0]
        assert (status[:8] != SOLVED).all()
        for i in range(8, 64):
            if by_clarabel(H[i], q[i], lower[i], upper[i], G[i], h[i])[0] == "infeasible":
                assert status[i] != SOLVED
                assert not thorough or status[i] == INFEASIBLE
        assert np.isfinite(np.asarray(found.U)[status == SOLVED]).all()


def test_active_sets_that_go_round_in_circles_are_left(monkeypatch):
    # Twelve inputs do the work of eight: exchanging whole active sets cycles on some of these.
    rng = np.random.default_rng(1)
    A = rng.normal(size=(300, 12, 8))
    H = A @ A.swapaxes(1, 2) + 1e-2 * np.eye(12)
    q, one = 3 * rng.normal(size=(300, 12)), np.ones((300, 12))

    def solved(H, q, lower, upper):
        problems = jax.vmap(lambda H, q, a, b: scaled(H, q[:, None], a, b))(H, q, lower, upper)
        return solve(problems, np.ones((300, 1, 1)), 1e-6, thorough=False)

    found = jax.jit(solved)(H, q, -one, one)
    left = (found.status != SOLVED).sum()
    assert left <= 3
    for i in range(0, 300, 10):
        status, v = by_clarabel(H[i], q[i], -one[i], one[i], np.zeros((0, 12)), np.zeros(0))
        assert status == "solved"
        np.testing.assert_allclose(found.U[i, 0], v, rtol=0, atol=2e-5)
    monkeypatch.setattr(_batched_qp, "TRIES", 1000)
    cyclic = jax.jit(lambda *data: solved(*data))(H, q, -one, one)
    assert (cyclic.status != SOLVED).sum() > left + 5


def test_the_derivative_of_an_inverse():
    A = np.random.default_rng(0).normal(size=(4, 4))
    H = A @ A.T + np.eye(4)
    np.testing.assert_allclose(inverse_of(H), np.linalg.inv(H), atol=1e-12)
    dH = A + A.T
    step = (inverse_of(H + 1e-6 * dH) - inverse_of(H - 1e-6 * dH)) / 2e-6
    np.testing.assert_allclose(jax.jvp(inverse_of, (H,), (dH,))[1], step, atol=1e-7)
