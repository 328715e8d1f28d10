"""What σ may see of a trajectory: signals by hand, set points, and their way into a file."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from prefmpc import (
    Comparisons,
    MLPCost,
    QuadraticCost,
    SignalCost,
    Trajectory,
    bryson,
    fit_map,
    kinematic_bicycle,
    phi,
    rollout,
    second_moments,
    select,
)

KEY = jax.random.key(2900)
RNG = np.random.default_rng(0)
X, U, Y = (RNG.normal(size=(6, *shape)) for shape in ((4, 2), (3, 1), (3, 3)))
X_R, U_R, Y_R, BEFORE = np.array([0.5, -1]), np.array([0.3]), np.array([1.0, 2, 3]), np.array([2.0])
PLAIN = Trajectory(X, U, Y)
MOVED = Trajectory(X, U, Y, x_r=X_R, u_r=U_R, y_r=Y_R, u_before=BEFORE)


def test_deviations_by_hand():
    D = MOVED.deviation()
    np.testing.assert_array_equal(D.x, X - X_R)
    np.testing.assert_array_equal(D.u, U - U_R)
    np.testing.assert_array_equal(D.y, Y - Y_R)
    np.testing.assert_array_equal(D.u_before, np.broadcast_to(BEFORE - U_R, (6, 1)))
    assert D.x_r is D.u_r is D.y_r is None
    assert D.deviation() is D
    assert PLAIN.deviation() is PLAIN
    # Without y_r the outputs stay; where the output is the state, y_r is x_r.
    np.testing.assert_array_equal(Trajectory(X, U, Y, x_r=X_R, u_r=U_R).deviation().y, Y)
    states = Trajectory(X, U, x_r=X_R, u_r=U_R)
    np.testing.assert_array_equal(states.y_r, states.x_r)
    np.testing.assert_array_equal(states.deviation().y, X[:, :-1] - X_R)
    # One set point for each trajectory.
    each = Trajectory(X, U, x_r=X[:, 0], u_r=U[:, 0])
    np.testing.assert_array_equal(each.deviation().x[:, 0], 0)
    np.testing.assert_array_equal(each[2].x_r, X[2, 0])
    assert each[2].batch_shape == ()
    assert each[1:3].x_r.shape == (2, 2)


def test_a_quadratic_sees_deviations():
    Q, R = np.array([[2.0, 0.3], [0.3, 1]]), np.array([[0.5]])
    dx, du = X[:, :-1] - X_R, U - U_R
    expected = np.einsum("nki,ij,nkj->n", dx, Q, dx) + np.einsum("nki,ij,nkj->n", du, R, du)
    np.testing.assert_allclose(phi(MOVED, Q, R), expected, rtol=1e-12)
    np.testing.assert_allclose(QuadraticCost(Q, R)(MOVED), expected, rtol=1e-12)
    moments = second_moments(MOVED)
    np.testing.assert_allclose(moments.Sx, np.einsum("nki,nkj->nij", dx, dx), rtol=1e-12)


INCREMENTS = np.diff(U, axis=1, prepend=U[:, :1])
EXPECTED = {
    "x": X[:, :-1],
    "y": Y,
    "du": INCREMENTS,
    "dy": np.diff(Y, axis=1, prepend=Y[:, :1]),
}
WITH_SET_POINT = {
    "x": X[:, :-1] - X_R,
    "y": Y - Y_R,
    "du": np.diff(U, axis=1, prepend=np.broadcast_to(BEFORE, (6, 1, 1))),
    "dy": EXPECTED["dy"],
    "x_r": np.broadcast_to(X_R, (6, 3, 2)),
    "u_r": np.broadcast_to(U_R, (6, 3, 1)),
}


@pytest.mark.parametrize(
    "signals", ["x", "y", "du", "dy", ("x", "y"), ("dy", "x", "du"), ("x", "x_r", "u_r")]
)
def test_signals_by_hand(signals):
    names = (signals,) if isinstance(signals, str) else signals
    for T, table in ((PLAIN, EXPECTED), (MOVED, WITH_SET_POINT)):
        if not set(names) <= table.keys():
            with pytest.raises(ValueError, match='signals must not hold "x_r" where'):
                select(T, signals)
            continue
        seen = select(T, signals)
        expected = np.concatenate([table[name] for name in names], axis=-1)
        np.testing.assert_allclose(seen.x[:, :-1], expected, atol=1e-15)
        np.testing.assert_allclose(seen.u, T.deviation().u)
        np.testing.assert_allclose(select(T[1], signals).x, seen.x[1])
        compiled = jax.jit(lambda t: select(t, signals))(T)
        np.testing.assert_allclose(compiled.x, seen.x, atol=1e-14)


def test_the_start_alone():
    seen = select(PLAIN, "x0")
    assert seen.horizon == 1
    np.testing.assert_array_equal(seen.x[:, 0], np.concatenate([X[:, 0], U[..., 0]], axis=1))
    np.testing.assert_array_equal(seen.u, U[:, :1])
    moved = select(MOVED, "x0")
    np.testing.assert_allclose(moved.x[:, 0, :2], X[:, 0] - X_R)
    np.testing.assert_allclose(moved.x[:, 0, 2:], U[..., 0] - U_R)
    # σ of x(0) and the inputs does not look at what came of them.
    other = Trajectory(np.concatenate([X[:, :1], RNG.normal(size=(6, 3, 2))], axis=1), U, Y)
    model = SignalCost(MLPCost.random(np.ones(6), key=KEY, widths=(4,)), "x0")
    np.testing.assert_array_equal(model(other), model(PLAIN))


def test_a_cost_of_outputs_and_increments_by_hand():
    Q = np.diag([1.0, 2, 3, 10])
    model = SignalCost(QuadraticCost(Q, [[0.5]]), ["y", "du"])
    du = WITH_SET_POINT["du"]
    expected = ((Y - Y_R) ** 2 @ [1.0, 2, 3]).sum(1) + 10 * (du**2).sum((1, 2))
    expected = expected + 0.5 * ((U - U_R) ** 2).sum((1, 2))
    np.testing.assert_allclose(model(MOVED), expected, rtol=1e-12)
    np.testing.assert_allclose(model.score(model.features(MOVED)), expected, rtol=1e-12)
    assert model.linear_in_features
    low, high = model.bounds()
    assert low.signals == high.signals == ("y", "du")
    assert np.isposinf(high.model.theta_Q).all()
    slope = jax.grad(lambda m: m(MOVED).sum())(model)
    assert slope.signals == ("y", "du")
    stack = SignalCost(QuadraticCost.random(4, 1, key=KEY, shape=(3,)), ["y", "du"])
    assert stack.batch_shape == (3,)
    np.testing.assert_allclose(stack[1](PLAIN), stack.model[1](select(PLAIN, ["y", "du"])))


def test_a_quadratic_in_the_outputs_is_learned():
    car = kinematic_bicycle()
    starts = np.array([0, 0, 0, 15.0]) + RNG.normal(size=(60, 4)) * [1, 0.1, 0.02, 1]
    gains = RNG.normal(size=(60, 2, 4)) * [[[0.01, 0.1, 0.5, 0], [0.01, 0, 0, 0.02]]]
    pool = rollout(car, starts, gains, 10)
    truth = SignalCost(QuadraticCost(np.diag([1.0, 4, 1, 0.1]), np.eye(2)), "y")

    def person(first, second):
        return (truth(first) < truth(second)).astype(float)

    data = Comparisons.random(pool, person, 300, key=KEY)
    seen = Comparisons(select(data.trajectories, "y"), data.first, data.second, data.labels)
    prior = bryson(np.abs(seen.trajectories.x).max((0, 1)), np.abs(pool.u).max((0, 1)))
    learned = SignalCost(fit_map(seen, prior).model, "y")
    fresh = rollout(car, starts[::-1], gains, 10)
    test = Comparisons.random(fresh, person, 300, key=KEY)
    gap = learned(fresh)[test.second] - learned(fresh)[test.first]
    assert ((gap > 0) == test.labels).mean() > 0.93


def parts(data):
    T = data.trajectories
    return (T.x, T.u, T.y, T.x_r, T.u_r, T.y_r, T.u_before, data.first, data.second, data.labels)


def test_set_points_are_saved(tmp_path):
    pairs = [0, 1, 2], [3, 4, 5], [1.0, 0, 0.5]
    for i, T in enumerate((PLAIN, MOVED, Trajectory(X, U, u_before=BEFORE))):
        data = Comparisons(T, *pairs)
        path = data.save(tmp_path / f"{i}.npz")
        again = Comparisons.load(path)
        for before, after in zip(parts(data), parts(again), strict=True):
            assert (before is None) == (after is None)
            if before is not None:
                np.testing.assert_array_equal(after, before)
        with np.load(path) as file:  # a reader that knows no set points must not lose them
            assert file["format_version"] == (1 if T is PLAIN else 2)
            assert ("x_r" in file.files) == (T is MOVED)


def test_set_points_stay_with_their_trajectories():
    each = Trajectory(X, U, x_r=X[:, 0], u_r=U[:, 0])
    data = Comparisons(each, [0, 1, 2], [3, 4, 5], [1.0, 0, 0.5])
    first, second = data.subset([2, 0]).pairs
    np.testing.assert_array_equal(first.x_r, X[[2, 0], 0])
    np.testing.assert_array_equal(second.u_r, U[[5, 3], 0])


QUADRATIC = QuadraticCost(np.eye(3), np.eye(1))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: select(1, "x"), "trajectory must be a Trajectory, got int"),
        (lambda: select(PLAIN, "z"), "signals must name different ones of .*got 'z'"),
        (lambda: select(PLAIN, []), "signals must name different ones"),
        (lambda: select(PLAIN, ["x", "x"]), "signals must name different ones"),
        (lambda: select(PLAIN, ["x", "x0"]), 'signals must hold "x0" alone or not at all'),
        (lambda: select(PLAIN, "u_r"), 'signals must not hold "u_r" where trajectories have no'),
        (
            lambda: select(Trajectory(X, U, Y, x_r=X_R, u_r=U_R), "y"),
            'signals must not hold "y" where a set point comes without its y_r',
        ),
        (lambda: SignalCost(1, "x"), "model must be a σ model, got int"),
        (lambda: SignalCost(QUADRATIC, "speed"), "signals must name different ones"),
        (lambda: SignalCost(QUADRATIC, "x")(PLAIN), "trajectory.x must have shape"),
        (lambda: SignalCost(QUADRATIC, "y")("T"), "trajectory must be a Trajectory"),
        (lambda: Trajectory(X, U, x_r=X_R), "x_r and u_r must be given together"),
        (lambda: Trajectory(X, U, u_r=U_R), "x_r and u_r must be given together"),
        (lambda: Trajectory(X, U, Y, y_r=Y_R), "y_r must be given together with x_r and u_r"),
        (lambda: Trajectory(X, U, x_r=U_R, u_r=U_R), r"x_r must have shape \(2,\) or \(6, 2\)"),
        (lambda: Trajectory(X, U, x_r=X_R, u_r=[np.nan]), "u_r must be finite"),
        (lambda: Trajectory(X, U, u_before=[1.0, 2]), r"u_before must have shape \(1,\)"),
        (lambda: Trajectory(X, U, Y, x_r=X_R, u_r=U_R, y_r=X_R), "y_r must have shape"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
