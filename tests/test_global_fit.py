"""The global minimum of the paper's objective: two solvers, and SciPy in θ from many starts."""

from __future__ import annotations

import sys

import jax
import numpy as np
import pytest
from scipy.optimize import minimize

from prefmpc import Comparisons, FitError, QuadraticCost, fit_global
from prefmpc.learning.losses import objective, pair_data
from studies import quadratic_data, settling_data

STARTS = QuadraticCost.random(6, 2, key=jax.random.key(2300), shape=(2,))
TREE = jax.tree.structure(STARTS[0])
LOW = STARTS[0].bounds()[0].theta


def in_theta(theta, data):
    return objective(TREE.unflatten([theta[:21], theta[21:]]), data)


VALUE_AND_SLOPE = jax.jit(jax.value_and_grad(in_theta))


def scipy_from(start, data):
    found = minimize(
        lambda theta: [np.asarray(part, float) for part in VALUE_AND_SLOPE(theta, data)],
        np.maximum(start.theta, LOW),
        jac=True,
        method="L-BFGS-B",
        bounds=np.column_stack([LOW, np.full(LOW.size, np.inf)]),
        options={"maxiter": 20000, "maxfun": 99999, "ftol": 0, "gtol": 1e-10, "maxcor": 30},
    )
    return found.fun


def answers(case: int, seed: int) -> Comparisons:
    key = jax.random.key(seed)
    if case == 1:
        return quadratic_data(key=key, sizes=(100,))[2][100]
    return settling_data(key=key, sizes=(100,))[2]["with Πᵤ"][100]


@pytest.mark.parametrize("case", [1, 2])
def test_every_start_in_theta_finds_the_same_minimum(case):
    for seed in (2301, 2302):
        data = answers(case, seed)
        result = fit_global(data)
        assert result.success, result.message
        assert result.gap <= 1e-8 * result.objective
        padded = pair_data(STARTS[0], data)
        found = np.array([scipy_from(STARTS[m], padded) for m in range(2)])
        np.testing.assert_allclose(found, result.objective, rtol=1e-6)
        # What is returned has this value, and lies within the bounds.
        model = QuadraticCost(result.Q, result.R)
        assert float(objective(model, padded)) == pytest.approx(result.objective, rel=1e-9)
        assert (np.asarray(model.theta) > LOW).all()


def test_clarabel_agrees():
    for seed in (2301, 2303):
        rng = np.random.default_rng(seed)
        data = answers(1, seed)
        labels = np.where(rng.uniform(size=100) < 0.1, 1 - data.labels, data.labels)
        data = Comparisons(data.trajectories, data.first, data.second, labels)
        barrier, clarabel = (fit_global(data, solver=s) for s in ("barrier", "clarabel"))
        assert clarabel.success, clarabel.message
        assert barrier.objective == pytest.approx(clarabel.objective, rel=1e-6)
        np.testing.assert_allclose(barrier.Q, clarabel.Q, atol=1e-3 * np.abs(barrier.Q).max())
        np.testing.assert_array_equal(barrier.Q, fit_global(data).Q)


def test_a_model_that_was_not_found_is_not_handed_out(monkeypatch):
    import prefmpc.learning.global_fit as module

    monkeypatch.setattr(module, "GAP", 0.0)
    with pytest.warns(RuntimeWarning, match="max_iterations"):
        result = module.fit_global(answers(1, 2301))
    with pytest.raises(FitError, match="max_iterations"):
        _ = result.model


@pytest.mark.parametrize("bad", [1.0, np.nan, np.inf])
@pytest.mark.parametrize("solver", ["barrier", "clarabel"])
def test_only_a_small_finite_gap_is_a_minimum(monkeypatch, solver, bad):
    module = sys.modules["prefmpc.learning.global_fit"]
    name = "_follow" if solver == "barrier" else "_certificate"
    true = getattr(module, name)

    def broken(*arguments):
        out = list(true(*arguments))
        out[2 if solver == "barrier" else 1] = bad
        return tuple(out)

    monkeypatch.setattr(module, name, broken)
    with pytest.warns(RuntimeWarning, match="max_iterations|inaccurate"):
        assert not fit_global(answers(1, 2301), solver=solver).success


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_global(STARTS), "comparisons must be a Comparisons, got QuadraticCost"),
        (lambda: fit_global(answers(1, 2301), l2=0), "l2 must be positive, got 0"),
        (lambda: fit_global(answers(1, 2301), solver="scs"), 'must be "barrier" or "clarabel"'),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
