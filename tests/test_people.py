"""Several people: each fit against an independent formulation, and what it is good for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit, logit

from prefmpc import (
    Comparisons,
    FitError,
    Trajectory,
    WishartPrior,
    fit_hierarchy,
    fit_map,
    fit_raters,
    people_posterior,
)
from prefmpc._pytree import bypass_init
from prefmpc.learning._people import LAPSE_CENTRE, LAPSE_SPREAD, lapsing
from prefmpc.learning.people import PeopleResult

RNG = np.random.default_rng(0)
POOL = Trajectory(RNG.normal(size=(40, 5, 2)), RNG.normal(size=(40, 4, 1)))
PRIOR = WishartPrior(np.diag([2.0, 0.5]), np.array([[1.5]]))
MODE = np.array([2.0, 0.5, 1.5])
SEEN = np.concatenate(
    [(np.asarray(part) ** 2).sum(1) for part in (POOL.x[:, :-1], POOL.u)], axis=1
)  # (40, 3)


def asked(weights, each, seed, lapse=0.0, who=None):
    """``each`` answers of every row of weights (m, 3), in a mixed order."""
    rng = np.random.default_rng(seed)
    weights = np.atleast_2d(weights)
    person = rng.permutation(np.repeat(np.arange(len(weights)), each))
    first = rng.integers(0, 40, person.size)
    second = (first + rng.integers(1, 40, person.size)) % 40
    z = ((SEEN[second] - SEEN[first]) * MODE * weights[person]).sum(1)
    rate = np.broadcast_to(lapse, len(weights))[person]
    P = rate / 2 + (1 - rate) * expit(z)
    labels = (rng.uniform(size=person.size) < P).astype(float)
    return Comparisons(POOL, first, second, labels, person if who is None else who[person])


DATA = asked([[1, 2, 0.5], [0.3, 0.6, 0.15], [2, 4, 1]], 20, 1)


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.6])
@pytest.mark.parametrize("label", [0.0, 0.3, 1.0])
def test_the_likelihood_and_its_derivatives(rate, label):
    z, ell, h = np.array([-3.0, -0.2, 0.0, 1.5]), float(logit(rate)) if rate else -np.inf, 1e-4

    def loss(z, ell):
        e = expit(ell)
        p = e / 2 + (1 - e) * expit(z)
        return -label * np.log(p) - (1 - label) * np.log(1 - p)

    value, by_z, by_l, by_zz, by_ll, by_zl = lapsing(z, label, rate)
    np.testing.assert_allclose(value, loss(z, ell), rtol=1e-12)
    near = {"rtol": 1e-5, "atol": 1e-6}
    first = (loss(z + h, ell) - loss(z - h, ell)) / (2 * h)
    np.testing.assert_allclose(by_z, first, **near)
    second = (loss(z + h, ell) - 2 * loss(z, ell) + loss(z - h, ell)) / h**2
    np.testing.assert_allclose(by_zz, second, **near)
    if not rate:
        assert not np.any([by_l, by_ll, by_zl])
        return
    np.testing.assert_allclose(by_l, (loss(z, ell + h) - loss(z, ell - h)) / (2 * h), **near)
    twice = (loss(z, ell + h) - 2 * loss(z, ell) + loss(z, ell - h)) / h**2
    np.testing.assert_allclose(by_ll, twice, **near)
    corners = [loss(z + a * h, ell + b * h) * a * b for a in (1, -1) for b in (1, -1)]
    np.testing.assert_allclose(by_zl, sum(corners) / (4 * h**2), **near)


def test_the_largest_log_odds_are_no_limit():
    for rate in (0.0, 1e-12, 0.5):
        assert np.isfinite(lapsing(np.array([-1e4, 1e4]), np.array([1.0, 0.0]), rate)).all()


def minus_log_posterior(v, apart, lapse):
    """Of DATA by the definition, in log weights: a common θ, and each person's own."""
    theta, rest = v[:3], v[3:].reshape(3, -1)
    own, ell = rest[:, :3] if apart else rest[:, :1], rest[:, -1]
    rate = expit(ell) if lapse is None else np.full(3, lapse)
    total = ((theta - theta.mean()) ** 2).sum() / 2 / 1.3**2 + theta.mean() ** 2 / 2 / 0.9**2
    for i in range(len(DATA)):
        k = DATA.who[i]
        w = np.exp(theta + own[k]) * MODE
        z = w @ (SEEN[DATA.second[i]] - SEEN[DATA.first[i]])
        p = rate[k] / 2 + (1 - rate[k]) * expit(z)
        total -= np.log(p if DATA.labels[i] else 1 - p)
    for k in range(3):
        m = own[k].mean()
        total += m**2 / 2 / 0.7**2 + (((own[k] - m) ** 2).sum() / 2 / apart**2 if apart else 0)
        total += (ell[k] - LAPSE_CENTRE) ** 2 / 2 / LAPSE_SPREAD**2 if lapse is None else 0
    return total


SIZES = {"spread": 1.3, "sharpness": 0.9, "sharper": 0.7}


@pytest.mark.parametrize(("apart", "lapse"), [(0.0, None), (0.4, None), (0.0, 0.1)])
def test_the_most_probable_people_are_those_of_an_independent_search(apart, lapse):
    rate = "estimate" if lapse is None else lapse
    if apart:
        found = fit_hierarchy(DATA, PRIOR, apart=apart, lapse=rate, **SIZES)
    else:
        found = fit_raters(DATA, PRIOR, lapse=rate, **SIZES)
    size = 3 + 3 * ((3 if apart else 1) + (lapse is None))
    start = np.zeros(size)
    if lapse is None:
        start[3:].reshape(3, -1)[:, -1] = LAPSE_CENTRE
    other = minimize(minus_log_posterior, start, args=(apart, lapse), options={"gtol": 1e-6})
    assert found.success
    assert found.objective == pytest.approx(other.fun, abs=1e-6)
    logs = np.log(np.append(np.diag(found.Q), found.R) / MODE)
    np.testing.assert_allclose(logs, other.x[:3], atol=1e-3)
    people = found.models
    assert people.batch_shape == (3,)
    own = other.x[3:].reshape(3, -1)
    mean = (other.x[:3] + (own[:, :3] if apart else own[:, :1])).mean(1)
    np.testing.assert_allclose(np.log(found.sharpness().mean), mean, atol=1e-3)
    wanted = expit(own[:, -1]) if lapse is None else lapse
    np.testing.assert_allclose(found.lapse, wanted, atol=1e-3)
    # The curvature, by differences.
    h, eye = 1e-3, np.eye(size)

    def at(v):
        return minus_log_posterior(other.x + h * v, apart, lapse)

    H = np.array(
        [
            [sum(at(a * e + b * f) * a * b for a in (1, -1) for b in (1, -1)) for f in eye]
            for e in eye
        ]
    ) / (4 * h**2)
    C = np.linalg.inv(H)
    of = np.zeros((3, size))
    for k in range(3):
        of[k, :3] = 1 / 3
        place = 3 + k * own.shape[1]
        of[k, place : place + (3 if apart else 1)] = 1 / 3 if apart else 1
    std = np.sqrt(np.diag(of @ C @ of.T))
    middle, lower, upper = np.log(found.sharpness(level=0.6826895))
    np.testing.assert_allclose((upper - lower) / 2, std, rtol=1e-3)
    np.testing.assert_allclose(upper - middle, middle - lower, rtol=1e-9)


def test_units_order_and_names_do_not_matter():
    found = fit_raters(DATA, PRIOR)
    unit = 1e-6
    scaled = Trajectory(np.asarray(POOL.x) * unit, POOL.u)
    order = RNG.permutation(len(DATA))
    pairs = (getattr(DATA, name)[order] for name in ("first", "second", "labels"))
    other = Comparisons(scaled, *pairs, np.array(["c", "a", "b"])[DATA.who[order]])
    again = fit_raters(other, WishartPrior(PRIOR.Q / unit**2, PRIOR.R))
    assert again.names.tolist() == ["a", "b", "c"]
    np.testing.assert_allclose(again.sharpness().mean, found.sharpness().mean[[1, 2, 0]], rtol=1e-6)
    np.testing.assert_allclose(again.Q * unit**2, found.Q, rtol=1e-6)


def test_an_answer_of_weight_two_counts_as_two():
    weights = np.ones(len(DATA))
    weights[:7], weights[-5:] = 2, 0
    index = np.r_[np.arange(7), np.arange(len(DATA) - 5)]
    repeated = DATA.subset(index)
    one, two = fit_raters(DATA, PRIOR, weights=weights), fit_raters(repeated, PRIOR)
    np.testing.assert_allclose(one.Q, two.Q, rtol=1e-5)
    one, two = fit_map(DATA, PRIOR, weights=weights), fit_map(repeated, PRIOR)
    np.testing.assert_allclose(one.Q, two.Q, rtol=1e-6)
    np.testing.assert_allclose(one.log_likelihood, two.log_likelihood, rtol=1e-8)
    nearest = (result.nearest_diagonal().Q for result in (one, two))
    np.testing.assert_allclose(*nearest, rtol=1e-6)


def test_somebody_who_flips_coins_counts_little():
    wanted = np.array([0.3, 1.5, 1.0])
    people = np.array([1.0, 1.0, 0.0])[:, None] * wanted
    data = asked(people, 60, 5, lapse=[0.0, 0.0, 1.0], who=np.array(["Ada", "Bob", "Coin"]))
    rated = fit_raters(data, PRIOR)
    low = rated.sharpness()
    assert low.upper[2] < low.lower[:2].min()
    one = Comparisons(POOL, data.first, data.second, data.labels, np.zeros(180, int))
    truth = np.log(wanted) - np.log(wanted).mean()
    errors = [
        np.abs(np.log(r.relative().mean) - truth).max() for r in (rated, fit_raters(one, PRIOR))
    ]
    assert errors[0] < errors[1]


def test_a_newcomer_borrows_from_the_others():
    rng = np.random.default_rng(3)
    centre = np.log([0.2, 4.0, 1.0])
    people = np.exp(centre + 0.3 * rng.standard_normal((14, 3)))
    crowd = fit_hierarchy(asked(people[:8], 40, 4), PRIOR)
    assert 0.02 < crowd.apart < 0.8
    errors = []
    for k, person in enumerate(people[8:]):
        said = asked(person, 4, 10 + k)
        truth = np.log(person) - np.log(person).mean()
        found = fit_raters(said, PRIOR), crowd.newcomer(said)
        errors.append([np.abs(np.log(f.relative().mean) - truth).max() for f in found])
        np.testing.assert_allclose(found[1].models.Q[0], found[1].Q)
    alone, with_others = np.mean(errors, axis=0)
    assert with_others < 0.5 * alone


def test_samples_are_those_of_the_posterior():
    """One person without lapses: two coordinates matter for the ratio, by a grid."""
    plain = Trajectory(POOL.x[:, :, :1], POOL.u)
    rng = np.random.default_rng(8)
    first = rng.integers(0, 40, 12)
    second = (first + rng.integers(1, 40, 12)) % 40
    gap = np.column_stack([SEEN[second, 0] - SEEN[first, 0], SEEN[second, 2] - SEEN[first, 2]])
    labels = (rng.uniform(size=12) < expit(gap @ [0.2, 0.4])).astype(float)
    data = Comparisons(plain, first, second, labels, np.zeros(12, int))
    result = fit_raters(data, WishartPrior([[1.0]], [[1.0]]), lapse=0.0, **SIZES)
    drawn = people_posterior(result, draws=2048, key=1)
    assert drawn.success
    level, half = np.meshgrid(np.linspace(-6, 4, 401), np.linspace(-6, 6, 401), indexing="ij")
    z = np.exp(level + half)[..., None] * gap[:, 0] + np.exp(level - half)[..., None] * gap[:, 1]
    log = (labels * z - np.logaddexp(0, z)).sum(-1)
    log -= level**2 / 2 / (0.9**2 + 0.7**2) + half**2 / 1.3**2
    P = np.exp(log - log.max())
    P /= P.sum()
    for values, draws in (
        (level, np.log(drawn.sharpness[:, 0])),
        (half, np.log(drawn.relative[:, 0])),
    ):
        mean = (P * values).sum()
        std = np.sqrt((P * (values - mean) ** 2).sum())
        assert draws.mean() == pytest.approx(mean, abs=0.12 * std)
        assert draws.std() == pytest.approx(std, rel=0.12)
    again = people_posterior(result, draws=2048, key=1)
    np.testing.assert_array_equal(again.relative, drawn.relative)


def test_an_unfinished_result_is_not_used():
    good = fit_raters(DATA, PRIOR)
    bad = bypass_init(PeopleResult, **{**vars(good), "status": "no_minimum"})
    for use in (lambda: bad.model, bad.sharpness, bad.relative, lambda: people_posterior(bad)):
        with pytest.raises(FitError, match="no_minimum"):
            use()


NAMELESS = Comparisons(POOL, DATA.first, DATA.second, DATA.labels)
GOOD = fit_raters(DATA, PRIOR)


@pytest.mark.parametrize("fit", [fit_raters, fit_hierarchy])
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"comparisons": NAMELESS}, "comparisons must say who answered"),
        ({"comparisons": 1}, "comparisons must be a Comparisons, got int"),
        ({"prior": None}, "prior must be a WishartPrior"),
        ({"prior": WishartPrior(np.eye(3), np.eye(1))}, "prior must weigh 2 states"),
        ({"spread": 0}, "spread must be positive"),
        ({"sharpness": -1}, "sharpness must be positive"),
        ({"sharper": np.inf}, "sharper must be positive and finite"),
        ({"lapse": 1.0}, r"lapse must lie in \[0, 1\)"),
        ({"lapse": "guess"}, 'lapse must be a number or "estimate"'),
        ({"weights": np.ones(3)}, r"weights must have shape \(60,\)"),
        ({"weights": -np.ones(60)}, "weights must be not negative and not all 0"),
        ({"weights": np.zeros(60)}, "weights must be not negative and not all 0"),
    ],
)
def test_bad_input_is_named(fit, changes, words):
    with pytest.raises(ValueError, match=words):
        fit(**{"comparisons": DATA, "prior": PRIOR, **changes})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_hierarchy(DATA, PRIOR, apart=0.0), "apart must be positive"),
        (lambda: fit_hierarchy(DATA, PRIOR, apart="some"), "apart must be a positive number"),
        (lambda: GOOD.sharpness(1.0), r"level must lie in \(0, 1\)"),
        (lambda: GOOD.newcomer(DATA), "comparisons must be of one person"),
        (lambda: GOOD.newcomer(None), "comparisons must be a Comparisons"),
        (lambda: fit_map(DATA, PRIOR, weights=[1]), "weights must have shape"),
        (lambda: people_posterior(DATA), "result must be a PeopleResult"),
        (lambda: people_posterior(GOOD, draws=0), "draws must be a whole number"),
    ],
)
def test_other_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
