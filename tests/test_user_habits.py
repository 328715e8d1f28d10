"""What users bring: lists, data frames, float32, whole numbers, booleans; functions in NumPy."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import prefmpc as p
from prefmpc._pytree import register_pytree

KEY = jax.random.key(0)


class Frame:
    """Like a DataFrame or one of its columns: a table that NumPy can read, and is no array."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)

    def __len__(self):
        return len(self.values)

    def __iter__(self):
        return iter(self.values)


def frames(value):
    value = np.asarray(value)
    return Frame(value) if value.ndim < 3 else [Frame(part) for part in value]


# Whole numbers throughout, so that all of these hold the same.
FORMS = {
    "lists": lambda value: np.asarray(value).tolist(),
    "tuples of arrays": lambda value: tuple(np.asarray(value)),
    "float32": lambda value: np.asarray(value, np.float32),
    "int16": lambda value: np.asarray(value, np.int16),
    "objects": lambda value: np.asarray(value, object),
    "JAX float32": lambda value: jnp.asarray(value, jnp.float32),
    "JAX int": lambda value: jnp.asarray(value, int),
    "frames": frames,
    "strided": lambda value: np.repeat(np.asarray(value, float), 2, axis=-1)[..., ::2],
}

A, B, C = [[1, 1], [0, 1]], [[0], [1]], [[1, 0]]
Q, R = [[2, 1], [1, 3]], [[1]]
PLANT = p.LinearSystem(A, B, dt=1, u_min=-1, u_max=1)
COST = p.QuadraticCost(Q, R)
CART = p.NonlinearSystem(
    lambda x, u: x + jnp.stack([x[1], u[0] - jnp.sin(x[0])]), lambda x: x[:1], nx=2, nu=1, dt=1
)
rng = np.random.default_rng(0)
X, U = rng.integers(-9, 9, (2, 4, 6, 2)), rng.integers(-9, 9, (2, 4, 5, 1))
LABELS = [1, 0, 1, 1]
START, STARTS = [3, -1], [[3, -1], [1, 0], [0, 2]]
POOL = p.Trajectory(np.concatenate(X), np.concatenate(U))
LINEAR, CONVEX = p.LinearMPC(PLANT, COST, 4), p.ConvexMPC(PLANT, COST, 4)
BATCHED, NONLINEAR = p.BatchedMPC(PLANT, COST, 4), p.NonlinearMPC(CART, COST, 3)
DOORS = {
    "LinearSystem": lambda c: p.LinearSystem(c(A), c(B), c(C), dt=1, u_min=c([-1]), u_max=c([2])),
    "from_continuous": lambda c: p.LinearSystem.from_continuous(c(A), c(B), c(C), dt=0.1),
    "lqr": lambda c: PLANT.lqr(c(Q), c(R)),
    "step": lambda c: (PLANT.step(c(START), c([1])), CART.step(c(START), c([1]))),
    "output": lambda c: (PLANT.output(c(START)), CART.output(c(START))),
    "linearise": lambda c: CART.linearise(c(START), c([1])),
    "Polyhedron": lambda c: vars(p.Polyhedron(c(A), c([1, 2]))),
    "box": lambda c: vars(p.Polyhedron.box(c([-1, -2]), c([1, 2]))),
    "Ellipsoid": lambda c: p.Ellipsoid(c(Q)).contains(c(STARTS)),
    "SecondOrderCone": lambda c: p.SecondOrderCone(c(A), 4, c=c([1, 0])).contains(c(STARTS)),
    "oscillating_masses": lambda c: p.oscillating_masses(c([1, 2]), c([1, 2, 3])),
    "Trajectory": lambda c: p.Trajectory(
        c(X[0]), c(U[0]), c(X[0, :, 1:]), x_r=c(START), u_r=c([1]), u_before=c([2])
    ),
    "phi": lambda c: p.phi(POOL, c(Q), c(R)),
    "settling_time": lambda c: p.settling_time(c(X[0]), 5),
    "Comparisons": lambda c: vars(p.Comparisons(POOL, [0, 1, 2, 3], [4, 5, 6, 7], c(LABELS))),
    "from_arrays": lambda c: vars(
        p.Comparisons.from_arrays(c(X[0]), c(U[0]), c(X[1]), c(U[1]), c(LABELS))
    ),
    "QuadraticCost": lambda c: p.QuadraticCost(c(Q), c(R)),
    "QuadraticPreference": lambda c: vars(p.QuadraticPreference(c(Q), c(R))),
    "bryson": lambda c: vars(p.bryson(c([1, 2]), c([3]))),
    "by_criterion": lambda c: p.by_criterion(lambda T: c(np.round(p.phi(T, Q, R))))(*POOL_PAIR),
    "one_by_one": lambda c: p.one_by_one(lambda *_: c([1]))(*POOL_PAIR),
    "rollout": lambda c: p.rollout(PLANT, c(STARTS), c([[1, 2]]), 5),
    "random_states": lambda c: p.random_states(c([1, 2]), key=KEY),
    "lqr_pool": lambda c: p.lqr_pool(
        PLANT, 3, 4, key=KEY, x0=c(STARTS), weights=(c([Q] * 3), c([R] * 3))
    ),
    "LinearMPC": lambda c: LINEAR(c(START)),
    "ConvexMPC": lambda c: CONVEX(c(START)),
    "NonlinearMPC": lambda c: _afresh(NONLINEAR)(c(START)),
    "BatchedMPC": lambda c: BATCHED.solve(c(STARTS)).u,
    "closed_loops": lambda c: (
        p.closed_loops(PLANT, COST, c(STARTS), horizon=4, steps=3).trajectories
    ),
    "simulate": lambda c: p.simulate(PLANT, lambda x: c([1]), c(START), 3),
    "steady_state": lambda c: vars(p.steady_state(PLANT, c([1, 0]))),
    "accuracy": lambda c: p.accuracy(
        lambda T: c(np.round(p.phi(T, Q, R))), p.Comparisons(POOL, [0, 1], [2, 3], [1, 0])
    ),
}
POOL_PAIR = POOL[:4], POOL[4:]
PAIRS = p.Comparisons(POOL, np.arange(4), np.arange(4, 8), LABELS)


def _afresh(controller):
    controller.reset()  # or the second solve starts where the first one ended
    return controller


@pytest.mark.parametrize("door", DOORS)
def test_arrays_are_taken_in_whatever_form_they_come(door):
    expected = jax.tree.leaves(DOORS[door](lambda value: np.asarray(value, float)))
    for form, convert in FORMS.items():
        got = jax.tree.leaves(DOORS[door](convert))
        assert len(got) == len(expected), form
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=form)
            assert np.asarray(a).dtype == np.asarray(b).dtype, form


@pytest.mark.parametrize("form", ["bool", "objects", "frames", "JAX", "lists", "float32"])
def test_labels_may_be_true_and_false(form):
    answers = np.array(LABELS, bool)
    given = {
        "bool": answers,
        "objects": answers.astype(object),
        "frames": Frame(answers),
        "JAX": jnp.asarray(answers),
        "lists": answers.tolist(),
        "float32": answers.astype(np.float32),
    }[form]
    data = p.Comparisons.from_arrays(X[0], U[0], X[1], U[1], given)
    np.testing.assert_array_equal(data.labels, [1.0, 0.0, 1.0, 1.0])
    asked = p.Comparisons.random(POOL, lambda a, b: np.asarray(a.x[:, 0, 0] > 0), 20, key=KEY)
    assert asked.labels.dtype == np.float64


@pytest.mark.parametrize(
    "index", [[0, 2], (0, 2), np.array([0, 2], np.uint8), jnp.array([0, 2]), Frame([0, 2])]
)
def test_indices_come_in_many_forms_too(index):
    data = p.Comparisons(POOL, index, Frame(np.array([5, 6], object)), [1, 0])
    np.testing.assert_array_equal(data.first, [0, 2])
    np.testing.assert_array_equal(data.second, [5, 6])
    chosen = data.subset(Frame(np.array([False, True], object)))
    np.testing.assert_array_equal(chosen.first, [2])


def test_what_frames_lack_is_named():
    lacking = Frame(np.array([1.0, None, 2.0, 3.0], object))
    with pytest.raises(ValueError, match="labels must be"):
        p.Comparisons.from_arrays(X[0], U[0], X[1], U[1], lacking)


@dataclasses.dataclass(frozen=True)
class InNumPy:
    """A σ of the user's that JAX cannot trace."""

    w: float
    linear_in_features = False

    def __call__(self, trajectory):
        return self.score(self.features(trajectory))

    def features(self, trajectory):
        return (trajectory.x**2).sum((-1, -2))

    def score(self, features):
        return np.abs(np.asarray(self.w * features))

    def bounds(self):
        return InNumPy(0.0), InNumPy(np.inf)


register_pytree(InNumPy)


def plant(f, **more):
    return p.NonlinearSystem(f, nx=2, nu=1, dt=1, **more)


def in_place(x, u):
    out = np.zeros(2)
    out[0] = x[1]
    return out


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: plant(lambda x, u: np.sin(x)), r"f\(x, u\)"),
        (lambda: plant(lambda x, u: np.array([x[1], u[0]])), r"f\(x, u\)"),
        (lambda: plant(lambda x, u: math.sin(x[0]) * x), r"f\(x, u\)"),
        (lambda: plant(lambda x, u: x if x[0] > 0 else -x), r"f\(x, u\)"),
        (lambda: plant(in_place), r"f\(x, u\)"),
        (lambda: plant(lambda x, u: x, g=np.sin), r"g\(x\)"),
        (
            lambda: p.NonlinearSystem.from_continuous(
                lambda x, u: np.clip(x, 0, 1), nx=2, nu=1, dt=1
            ),
            r"f\(x, u\)",
        ),
        (lambda: p.rollout(PLANT, START, lambda x: np.clip(x[:1], -1, 1), 3), r"law\(x\)"),
        (lambda: p.rollout(PLANT, START, LINEAR, 3), r"law\(x\)"),
        (lambda: p.NonlinearMPC(CART, COST, 3, path=lambda x, u: np.sin(x)), r"path\(x, u\)"),
        (lambda: p.NonlinearMPC(CART, InNumPy(1.0), 3), "cost"),
        (
            lambda: p.fit(PAIRS, InNumPy(np.ones(2)), key=KEY),
            "initial",
        ),
    ],
)
def test_a_function_in_numpy_is_told_to_use_jax_numpy(call, name):
    with pytest.raises(ValueError, match=rf"^{name} must work on JAX arrays.*jax\.numpy: jnp\.sin"):
        call()
