"""Interviews: what is asked next, what is learned, and when to stop."""

from __future__ import annotations

import dataclasses

import control
import jax
import numpy as np
import pytest
import scipy.integrate

import prefmpc
from prefmpc import Interview, LinearSystem, Polyhedron, Question, SeparableCost, Trajectory
from prefmpc.asking.belief import LEVELS, Belief, Prior
from prefmpc.asking.features import QuadraticFeatures, SeparableFeatures
from prefmpc.asking.loops import gains, lqr_loops
from prefmpc.asking.questions import information, informative_batch

CART = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_min=-1, u_max=1)
PRIOR = prefmpc.bryson([1.0, 1.0], [1.0])
PERSON = prefmpc.QuadraticPreference(np.diag([4.0, 0.2]), [[0.5]])


def cart(**options):
    return Interview(CART, PRIOR, **{"x0": [1.0, 0.5], "key": 0, **options})


def same(a: Question, b: Question) -> bool:
    sides = jax.tree.map(np.array_equal, (a.first, a.second), (b.first, b.second))
    plain = ("gain", "sure", "probability", "number", "repeats")
    return all(jax.tree.leaves(sides)) and all(getattr(a, n) == getattr(b, n) for n in plain)


# What is believed


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("lapse", [0.0, 0.1, None])
def test_slopes_are_the_derivatives_of_the_energy(full, lapse):
    rng = np.random.default_rng(0)
    belief = Belief(QuadraticFeatures(np.eye(3), np.eye(2), full), Prior(2.0, 2.0, 0.5), lapse)
    gap, labels = rng.standard_normal((10, belief.p)), rng.choice([0, 0.5, 1.0], 10)
    at = 0.5 * rng.standard_normal(belief.p - 1 + (lapse is None))

    def slopes(at):
        return belief._slopes(at, 0.3, gap, labels, lapse)

    steps = 1e-5 * np.eye(len(at))
    energies = [belief._energy(at + s * steps, 0.3, gap, labels, lapse) for s in (1, -1)]
    gradient, hessian = slopes(at)
    np.testing.assert_allclose(gradient, (energies[0] - energies[1]) / 2e-5, atol=1e-6)
    bends = [slopes(at + h)[0] - slopes(at - h)[0] for h in steps]
    np.testing.assert_allclose(hessian, np.array(bends) / 2e-5, atol=1e-5)


def test_samples_follow_the_posterior_of_one_ratio_and_the_sharpness():
    # Two weights: the exact posterior by quadrature.
    rng = np.random.default_rng(1)
    features = SeparableFeatures(SeparableCost(np.ones((3, 1)), scale=[1.0]))
    features.chart = type(features.chart)(np.arange(2), np.arange(2))
    belief = Belief(features, Prior(1.0, 1.5, 1.0), 0.0)
    gap = rng.standard_normal((12, 2))
    labels = (rng.uniform(size=12) < 0.5 + 0.4 * np.sign(gap @ [1.0, 2.0])).astype(float)

    def density(ratio, common):
        eta = np.array([common + ratio, common - ratio])
        z = gap @ np.exp(eta)
        prior = common**2 / (2 * (1.5**2 + 0.5)) + (2 * ratio**2) / 2
        return np.exp(-prior - (np.logaddexp(0, z) - labels * z).sum())

    def moment(f):
        return scipy.integrate.dblquad(lambda r, c: f(r, c) * density(r, c), -8, 8, -5, 5)[0]

    mass = moment(lambda r, c: 1.0)
    mean = np.array([moment(lambda r, c: r), moment(lambda r, c: c)]) / mass
    eta, _ = belief.draws(belief.fit(gap, labels), gap, labels, 20_000, np.random.default_rng(0))
    found = np.array([(eta[:, 0] - eta[:, 1]) / 2, eta.mean(axis=1)])
    std = np.sqrt(
        np.array([moment(lambda r, c: r * r), moment(lambda r, c: c * c)]) / mass - mean**2
    )
    np.testing.assert_allclose(found.mean(axis=1), mean, atol=0.06)
    np.testing.assert_allclose(found.std(axis=1), std, atol=0.08)


@pytest.mark.parametrize("structure", ["diagonal", "full"])
def test_somebody_who_never_errs_is_understood_and_breaks_nothing(structure):
    interview = cart(structure=structure)
    interview.answer_with(PERSON, 60)
    assert interview.certificate.success
    x0 = prefmpc.random_states([1.0, 0.5], key=jax.random.key(1), shape=(20,))
    truth, model = prefmpc.QuadraticCost(PERSON.Q, PERSON.R), interview.model
    both = jax.tree.map(lambda *leaves: np.stack(leaves), truth, model)
    best, own = truth(lqr_loops(CART, both, x0, 30)).mean(axis=1)
    assert own / best - 1 < 0.005
    assert interview.finished() is not None


def test_answers_out_of_a_hat_are_taken_for_dull_ones_not_for_sharp_ones():
    interview, rng = cart(repeat_every=0), np.random.default_rng(0)
    for _ in range(40):
        interview.answer(float(rng.integers(2)))
    # Questions that halve what is possible always fit some sharp weights.
    assert np.mean([q.sure for q in interview.questions[-5:]]) < 0.8
    assert interview.finished() is None


def test_a_lapse_rate_is_estimated():
    rng = np.random.default_rng(3)

    def lapsing(first, second):
        coin = rng.uniform(size=2)
        return PERSON(first, second) if coin[0] > 0.3 else np.array([float(coin[1] < 0.5)])

    rates = []
    for key in range(3):
        interviews = [cart(lapse="estimate", key=key) for _ in range(2)]
        for interview, person in zip(interviews, (lapsing, PERSON), strict=True):
            interview.answer_with(person, 40)
            assert interview.certificate.success
        rates.append([interview.certificate.lapse for interview in interviews])
    careless, careful = np.array(rates).T
    assert (careful < 0.03).all()
    assert (careless > careful).all()
    assert careless.mean() > 1.5 * careful.mean()
    assert cart(lapse=0.1).certificate.lapse == 0.1


def test_gains_are_those_of_riccati_s_equation_also_for_unstable_plants():
    rng = np.random.default_rng(0)
    system = LinearSystem([[1.4, 0.3], [0, 0.7]], [[1.0], [0.2]], dt=1)
    Q = np.stack([np.diag(np.exp(4 * rng.standard_normal(2))) for _ in range(20)])
    R = np.exp(4 * rng.standard_normal((20, 1, 1)))
    wanted = [system.lqr(q, r)[0] for q, r in zip(Q, R, strict=True)]
    np.testing.assert_allclose(gains(system, Q, R), wanted, rtol=1e-7)


def test_weights_that_cannot_control_the_system_are_named():
    Q, R = np.zeros((1, 2, 2)), np.ones((1, 1, 1))
    with pytest.raises(ValueError, match="system cannot be controlled with weights that"):
        gains(CART, Q, R)


# What is asked


def test_information_is_the_mutual_information_of_answer_and_sample():
    P = np.array([[0.0, 0.5, 0.9], [1.0, 0.5, 0.9]])
    np.testing.assert_allclose(information(P), [np.log(2), 0, 0], atol=1e-12)


def test_a_batch_does_not_ask_the_same_twice_in_other_words():
    rng = np.random.default_rng(0)
    P = (rng.uniform(size=(8, 1, 3)) < 0.5).astype(float)
    bits = np.array([[s >> k & 1 for k in range(3)] for s in range(8)], float)
    P = np.concatenate([bits, bits, 0.6 * bits + 0.2], axis=1)
    chosen = informative_batch(P, np.ones(9, bool), 3)
    assert sorted(i % 3 for i in chosen) == [0, 1, 2]


def test_the_question_shown_tells_most_and_starts_alike():
    interview = cart()
    question = interview.next()
    assert isinstance(question, Question)
    assert not question.repeated
    np.testing.assert_array_equal(question.first.x[0], question.second.x[0])
    assert 0.5 < question.gain <= np.log(2)
    assert question.sure > 0.9
    chosen = cart(choose="random").next()
    assert chosen.gain < question.gain


def test_one_in_eight_is_asked_again_with_sides_swapped():
    interview = cart()
    interview.answer_with(PERSON, 33)
    again = [q for q in interview.questions if q.repeated]
    assert [q.number for q in again] == [7, 15, 23, 31]
    assert len({q.repeats for q in again}) == 4
    for q in again:
        old = interview.questions[q.repeats]
        np.testing.assert_array_equal(q.first.x, old.second.x)
        np.testing.assert_array_equal(q.second.u, old.first.u)
    seen = interview.consistency
    assert (seen.repeats, seen.equal) == (4, 1.0)
    assert 0.2 < seen.first < 0.8


def test_regret_is_that_of_the_loops_of_who_knows_the_weights():
    interview = cart(repeat_every=0)
    interview.answer_with(PERSON, 5)
    options, found = interview._options, interview.regret
    x0 = options.states.draw(12, options.rng(0, 2))
    samples = [interview.posterior[np.array(i)] for i in range(150)]
    loops = []
    for model in (interview.model, *samples):
        K = control.dlqr(CART.A, CART.B, model.Q, model.R)[0]
        loops.append(prefmpc.rollout(CART, x0, K, options.steps, saturate=True))
    ours, best = (
        np.array([prefmpc.phi(T, m.Q, m.R).mean() for T, m in zip(runs, samples, strict=True)])
        for runs in ([loops[0]] * 150, loops[1:])
    )
    np.testing.assert_allclose(found.values, np.maximum(ours / best - 1, 0), rtol=1e-6, atol=1e-9)


def test_a_bound_leaves_room_for_the_error_of_the_samples():
    regret = prefmpc.asking.regret.Regret(np.arange(101) / 1000)
    assert regret.quantile(0.9) == pytest.approx(0.09)
    assert regret.bound(0.9) == pytest.approx(0.09 + 1.645 * np.sqrt(0.09 / 101) / 10)
    assert regret.bound(0.999) == pytest.approx(0.1)
    assert regret.stop(0.095)
    assert not regret.stop(0.0945)
    assert str(regret) == "5 % (median), at most 9.5 % with probability 0.9"


def test_a_habit_of_answering_first_shows():
    interview = cart()
    for _ in range(16):
        interview.answer("first")
    assert interview.consistency == prefmpc.asking.regret.Consistency(2, 0.0, 1.0)


@pytest.mark.parametrize(
    "choose", ["regret", "volume", "eubo", lambda c: -np.abs(c.P.mean(axis=0) - 0.5)]
)
def test_other_criteria_learn_too(choose):
    interview = cart(choose=choose)
    before = interview.regret.quantile()
    interview.answer_with(PERSON, 15)
    assert interview.regret.quantile() < before / 3


def test_a_pool_is_asked_once_and_then_empty():
    pool = prefmpc.lqr_pool(CART, 4, 10, key=jax.random.key(0), radius=[1.0, 0.5])
    interview = Interview(CART, pool=pool, key=0, repeat_every=0)
    interview.answer_with(PERSON, 6)
    shown = {frozenset((q.first.x[0, 0], q.second.x[0, 0])) for q in interview.questions}
    assert len(shown) == 6
    with pytest.raises(ValueError, match="pool must hold a pair that was not asked"):
        interview.next()


def test_a_separable_cost_is_learned_from_a_pool():
    pool = prefmpc.lqr_pool(CART, 30, 20, key=jax.random.key(0), x0=np.tile([[1.0, 0.5]], (30, 1)))
    truth = SeparableCost(
        np.array([[5.0, 0.1, 1.0], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1]]), scale=[1, 1, 1]
    )
    person = prefmpc.by_criterion(truth)
    first = SeparableCost(np.ones((3, 3)), scale=np.ones(3))

    def never(models, x0):
        raise AssertionError("recordings need no loops")

    interview = Interview(CART, first, pool=pool, controller=never, key=0)
    interview.answer_with(person, 30)
    data = prefmpc.Comparisons.random(pool, person, 300, key=jax.random.key(2))
    assert prefmpc.accuracy(interview.model, data) > 0.93 > prefmpc.accuracy(first, data)
    with pytest.raises(ValueError, match="result needs a quadratic"):
        _ = interview.result


def test_mpc_keeps_the_constraints_of_what_is_shown():
    limits = Polyhedron.box([-2, -0.4, -1], [2, 0.4, 1])
    interview = cart(controller="mpc", constraints=limits, x0=[[1.0, 0.0], [0.5, 0.2]], steps=12)
    interview.answer_with(PERSON, 3)
    for question in interview.questions:
        for side in (question.first, question.second):
            assert np.abs(side.x[..., 1]).max() <= 0.4 + 1e-6
    assert interview.regret.quantile() > 0


@pytest.mark.parametrize("controller", ["lqr", "mpc"])
def test_loops_reach_set_points_within_the_limits(controller):
    goals = [prefmpc.steady_state(CART, [0.6, 0.0]), prefmpc.steady_state(CART, [-1.0, 0.0])]
    limits = Polyhedron.box([-2, -0.4, -1], [2, 0.4, 1]) if controller == "mpc" else None
    options = {"reference": goals, "controller": controller, "constraints": limits}
    interview = cart(x0=[[0.2, 0.0]], steps=25, **options)
    interview.answer_with(PERSON, 4)
    for question in interview.questions:
        for side in (question.first, question.second):
            np.testing.assert_allclose(side.x[0], [0.2, 0.0])
            np.testing.assert_allclose(side.x[1:], CART.step(side.x[:-1], side.u), atol=1e-12)
            assert np.abs(side.u).max() <= 1 + 1e-9
            if limits:
                assert np.abs(side.x[:, 1]).max() <= 0.4 + 1e-6
        assert np.array_equal(question.first.x_r, question.second.x_r)
        assert question.first.x_r[0] in (0.6, -1.0)
    cost = prefmpc.QuadraticCost(np.diag([4.0, 0.2]), [[0.5]])
    starts = np.tile([0.2, 0.0], (3, 1))
    runs = interview._options.loops(jax.tree.map(lambda leaf: leaf[None], cost), starts)
    np.testing.assert_array_equal(runs.x_r[0], [goals[i].x for i in (0, 1, 0)])
    assert np.abs(runs.x[0, :, -1] - runs.x_r[0]).max() < 0.5
    if controller == "lqr":
        K = control.dlqr(CART.A, CART.B, cost.Q, cost.R)[0]
        wanted = np.clip((runs.x_r[0, :, None] - runs.x[0, :, :-1]) @ K.T, -1, 1)
        np.testing.assert_allclose(runs.u[0], wanted, atol=1e-9)
    assert interview.regret.quantile() >= 0


def test_a_set_point_goes_with_what_makes_loops_to_it():
    goal = prefmpc.steady_state(CART, [0.6, 0.0])
    with pytest.raises(ValueError, match="reference must be a steady state"):
        cart(reference=prefmpc.SteadyState(goal.x, goal.u + 0.1, goal.y))
    with pytest.raises(ValueError, match="reference must be a sequence of at least one"):
        cart(reference=[])
    with pytest.raises(ValueError, match="reference must be None with a pool"):
        cart(reference=goal, controller=lambda models, x0: None)
    with pytest.raises(ValueError, match="prior must be given"):
        Interview(CART, x0=[1.0, 0.5], key=0, reference=goal)


def test_the_result_is_fit_map_of_the_same_answers():
    interview = cart()
    interview.answer_with(PERSON, 6)
    interview.answer(None)
    interview.answer(0.5)
    assert len(interview) == 8
    assert len(interview.comparisons) == 7
    own = prefmpc.fit_map(interview.comparisons, PRIOR, structure="diagonal")
    np.testing.assert_allclose(interview.result.Q, own.Q)
    assert interview.posterior.batch_shape == (150,)
    assert dataclasses.is_dataclass(interview.regret)


def test_the_default_prior_is_what_responses_reach():
    interview = Interview(CART, x0=[1.0, 0.0], key=0)
    model = interview._options.prior
    assert 0.8 < 1 / np.sqrt(model.Q[0, 0]) <= 1.2
    assert 0.1 < 1 / np.sqrt(model.Q[1, 1]) < 3


# Bad input


STUCK = LinearSystem([[1.2, 0], [0, 0.5]], [[0], [1]], dt=0.1, u_min=-1, u_max=1)
LIMITS = Polyhedron.box([-0.5, -1, -1], [0.5, 1, 1])
BAD = {
    "system": ({"system": "cart"}, "system must be a System"),
    "unstabilisable": ({"system": STUCK}, "system cannot be controlled: .*stabilisable"),
    "prior": ({"prior": 1.0}, "prior must be a WishartPrior"),
    "prior size": ({"prior": prefmpc.bryson([1.0], [1.0])}, "prior must weigh 2 states"),
    "x0": ({"x0": None}, "x0 must be given"),
    "x0 size": ({"x0": [1.0]}, "x0 must be a radius"),
    "x0 NaN": ({"x0": [np.nan, 1]}, "x0 must"),
    "outside": (
        {"x0": [[1.0, 0]], "constraints": LIMITS, "controller": "mpc"},
        "x0 must lie within",
    ),
    "constraints": ({"constraints": LIMITS}, 'constraints need controller="mpc"'),
    "key": ({"key": "0"}, "key must be"),
    "structure": ({"structure": "round"}, "structure must be"),
    "spread": ({"spread": 0}, "spread must be"),
    "steps": ({"steps": 0}, "steps must be"),
    "controller": ({"controller": "pid"}, "controller must be"),
    "empty pool": (
        {"pool": Trajectory(np.zeros((0, 3, 2)), np.zeros((0, 2, 1)))},
        "pool must hold at least two",
    ),
    "choose": ({"choose": "best"}, "choose must be"),
    "lapse": ({"lapse": 1.0}, "lapse must lie in"),
    "repeat_every": ({"repeat_every": -1}, "repeat_every must be"),
    "samples": ({"samples": 0}, "samples must be"),
}


@pytest.mark.parametrize("make", [Interview])
@pytest.mark.parametrize(("given", "said"), BAD.values(), ids=BAD)
def test_bad_input_to_an_interview_is_named(make, given, said):
    options = {"system": CART, "prior": PRIOR, "x0": [1.0, 0.5], "key": 0, **given}
    with pytest.raises(ValueError, match=said):
        make(**options)


@pytest.mark.parametrize("value", ["left", 1.5, -0.1, np.nan, [1, 0], object()])
def test_bad_answers_are_named_and_change_nothing(value):
    interview = cart()
    question = interview.next()
    with pytest.raises(ValueError, match="value must be"):
        interview.answer(value)
    assert len(interview) == 0
    assert interview.next() is question


def test_criteria_and_controllers_of_one_s_own_are_checked():
    with pytest.raises(ValueError, match="choose must return one number for each pair"):
        cart(choose=lambda candidates: np.zeros(3)).next()
    with pytest.raises(ValueError, match="controller must return a Trajectory"):
        cart(controller=lambda models, x0: None).next()
    with pytest.raises(ValueError, match="x0 must return shape"):
        cart(x0=lambda rng, count: np.zeros((3, 2))).next()
    with pytest.raises(ValueError, match="undo needs an answer"):
        cart().undo()


def test_a_sharpness_whose_search_found_no_minimum_has_no_say(monkeypatch):
    """A narrow valley can take more steps than there are: a guess must not win by its evidence."""
    belief = Belief(QuadraticFeatures(np.eye(3), np.eye(2), True), Prior(2.0, 2.0, 0.5), 0.0)
    rng, newton = np.random.default_rng(0), Belief._newton

    def stuck(self, at, level, *data):
        found = newton(self, at, level, *data)
        return found._replace(curvature=-14.0, evidence=99.0) if level == LEVELS[9] else found

    monkeypatch.setattr(Belief, "_newton", stuck)
    laplace = belief.fit(rng.standard_normal((6, belief.p)), np.array([1.0, 0, 1, 0, 1, 1]))
    assert laplace.success
    assert laplace.weights[9] == 0.0
    assert laplace.weights.sum() == pytest.approx(1.0)
