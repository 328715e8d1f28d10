"""Many quadratic programs side by side, against Clarabel and by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_programs import answers, by_clarabel, random_programs

from prefmpc import BatchedMPC, LinearSystem, Polyhedron, QuadraticCost
from prefmpc.mpc import _batched_qp, _dual_method
from prefmpc.mpc._batched_qp import FAILED, INFEASIBLE, SOLVED, STATUSES, UNFINISHED, solve
from prefmpc.mpc._condensed import inverse_root, scaled


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


def test_nan_in_the_data_is_never_called_solved():
    H, q, lower, upper, G, h = random_programs(64, 5, 20, np.random.default_rng(3))
    q[:8] = np.nan
    found = answers(H, q, lower, upper, G, h)
    status = np.asarray(found.status)[:, 0]
    assert (status[:8] == FAILED).all()
    assert np.isin(status[8:], [SOLVED, INFEASIBLE]).all()
    assert np.isfinite(np.asarray(found.U)[status == SOLVED]).all()


BOX = (2 * np.eye(3)[None], -np.array([[8.0, 8, 1]]), -np.ones((1, 3)), np.ones((1, 3)))
"""min (v − 4)² + (v − 4)² + (v − ½)² in the unit box, and a row that bounds nothing."""


def wrong_ones(found):
    """What the dual method found, and what it must not get away with."""
    return {
        "right": found,
        "too large": found._replace(error=found.error + 1e-5),
        "NaN": found._replace(error=found.error * jnp.nan),
        "infinite": found._replace(error=found.error + jnp.inf),
        "multiplier NaN": found._replace(multipliers=found.multipliers * jnp.nan),
        "plan NaN": found._replace(w=found.w * jnp.nan),
        "given up": found._replace(error=found.error + 1e-5, limited=found.limited | True),
    }


KINDS = ["right", "too large", "NaN", "infinite", "multiplier NaN", "plan NaN", "given up"]


@jax.jit
def tampered(mode):
    """Solve BOX with what the dual method finds replaced by one of the wrong ones."""
    right = _dual_method.dual_method

    def dual(*arguments):
        variants = wrong_ones(right(*arguments))
        return jax.tree.map(lambda *a: jnp.stack(a)[mode], *(variants[kind] for kind in KINDS))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_batched_qp, "dual_method", dual)
        return answers.__wrapped__(*BOX, np.ones((1, 1, 3)), np.full((1, 1), 9.0))


@pytest.mark.parametrize("kind", KINDS)
def test_a_residual_that_is_too_large_or_no_number_is_a_failure(kind):
    found = tampered(KINDS.index(kind))
    residual, status = float(found.residual[0, 0]), int(found.status[0, 0])
    if kind == "right":
        assert status == SOLVED
        assert residual <= 1e-12
        np.testing.assert_allclose(found.U[0, 0], [1, 1, 0.5], atol=1e-14)
    else:
        assert status == (UNFINISHED if kind == "given up" else FAILED)
        assert not residual <= 1e-8


def test_equal_limits_hold_a_variable_whichever_way_it_is_pulled():
    H, q, _, _ = BOX
    for held in ([0.25, -1, 9], [9, 0.0, 0.0]):
        limits = np.array([held])
        found = answers(H, q, limits, limits, np.ones((1, 1, 3)), np.full((1, 1), 99.0))
        assert int(found.status[0, 0]) == SOLVED
        np.testing.assert_allclose(found.U[0, 0], held, atol=1e-14)


def test_active_sets_that_go_round_in_circles_are_solved_by_the_dual_method(monkeypatch):
    # Twelve inputs do the work of eight: exchanging whole active sets cycles on some of these.
    rng = np.random.default_rng(1)
    A = rng.normal(size=(300, 12, 8))
    H = A @ A.swapaxes(1, 2) + 1e-2 * np.eye(12)
    q, one = 3 * rng.normal(size=(300, 12)), np.ones((300, 12))
    seen = []
    right = _batched_qp._left_over

    def left_over(problem, data, start, found, dead, tol):
        jax.debug.callback(lambda done: seen.append(int((~done).sum())), found.done)
        return right(problem, data, start, found, dead, tol)

    monkeypatch.setattr(_batched_qp, "_left_over", left_over)

    @jax.jit
    def solved(H, q, lower, upper):
        problems = jax.vmap(lambda H, q, a, b: scaled(H, q[:, None], a, b))(H, q, lower, upper)
        return solve(problems, np.ones((300, 1, 1)), 1e-8)

    found = jax.block_until_ready(solved(H, q, -one, one))
    jax.effects_barrier()
    assert seen[0] > 0
    assert (np.asarray(found.status) == SOLVED).all()
    for i in range(0, 300, 10):
        status, v = by_clarabel(H[i], q[i], -one[i], one[i], np.zeros((0, 12)), np.zeros(0))
        assert status == "solved"
        np.testing.assert_allclose(found.U[i, 0], v, rtol=0, atol=2e-5)


def test_the_derivative_of_an_inverse_root():
    A = np.random.default_rng(0).normal(size=(4, 4))
    H, dH = A @ A.T + np.eye(4), A + A.T
    root = np.asarray(inverse_root(H))
    np.testing.assert_allclose(root @ H @ root.T, np.eye(4), atol=1e-12)
    step = (inverse_root(H + 1e-6 * dH) - inverse_root(H - 1e-6 * dH)) / 2e-6
    np.testing.assert_allclose(jax.jvp(inverse_root, (H,), (dH,))[1], step, atol=1e-7)


def test_a_state_held_at_its_limit_takes_no_input_at_all():
    # A cart at its largest speed far away: the plan is u = 0, which no error is small beside.
    system = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_min=-1, u_max=1)
    sets = Polyhedron.box([-2, -0.4, -1], [2, 0.4, 1])
    cost = QuadraticCost(np.diag([4.0, 0.2]), [[0.5]])
    for unit in (1e-6, 1.0, 1e6):  # a micrometre, a metre, a thousand kilometres
        T = unit * np.eye(2)
        plant = LinearSystem(system.A, T @ system.B, dt=0.1, u_min=-1, u_max=1)
        scaled = QuadraticCost(cost.Q / unit**2, cost.R)
        box = Polyhedron(sets.H @ np.diag([1 / unit, 1 / unit, 1]), sets.h)
        x0 = unit * np.array([[1.08, -0.4], [1.9, -0.4], [-1.5, 0.4]])
        plan = BatchedMPC(plant, scaled, horizon=10, constraints=box).solve(x0)
        assert (plan.status == "solved").all()
        assert np.abs(plan.u).max() < 1e-9
