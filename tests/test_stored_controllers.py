"""Controllers as JSON, and their matrices."""

from __future__ import annotations

import copy
import json

import control
import numpy as np
import pytest

from prefmpc import (
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    matrices,
    terminal_ingredients,
)

CART = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], [[1, 0]], dt=0.1, u_min=-1, u_max=1)
OPEN = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_max=1)
COST = QuadraticCost([[4.0, 1], [1, 2]], [[0.5]])
ROOM = Polyhedron.box([-1, -0.5, -1], [1, 0.5, 1])
CONTROLLERS = {
    "plain": LinearMPC(OPEN, COST, 8),
    "sets": LinearMPC(CART, COST, 8, constraints=ROOM, terminal=Polyhedron.box([-1, -1], [1, 1])),
    "ingredients": LinearMPC(
        CART, COST, 8, constraints=ROOM, terminal=terminal_ingredients(CART, COST)
    ),
    "options": LinearMPC(
        CART, COST, 8, constraints=ROOM, soft=[10, 10, np.inf, 10, 10, np.inf], soft_quadratic=1.0,
        max_increment=0.5, blocks=[1, 3, 4],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTROLLERS)
def test_what_comes_back_is_the_same(name):
    controller = CONTROLLERS[name]
    text = controller.to_json()
    back = LinearMPC.from_json(text)
    assert LinearMPC.from_json(back.to_json()).to_json() == back.to_json()
    assert json.loads(text).keys() == json.loads(back.to_json()).keys()
    for x in ([0.4, 0.2], [0.1, -0.3], [3.0, 3.0]):
        one, two = controller.solve(x), back.solve(x)
        assert one.status == two.status
        np.testing.assert_allclose(one.trajectory.u, two.trajectory.u, rtol=0, atol=1e-9)


WRONG = {
    "format": ("other", "format"),
    "version": (2, "version"),
    "horizon": (0, "horizon"),
    "more": (1, "more"),
    "system": (None, "system"),
    "system.A": ([[1, 2]], "system.A"),
    "system.B": ("B", "system.B"),
    "system.dt": (-1, "system.dt"),
    "system.u_min": ([5], "system.u_min"),
    "cost.Q": ([[1, 0], [0, -1]], "cost.Q"),
    "cost.R": ([[]], "cost.R"),
    "constraints.H": ([[1.0, 2]], "constraints"),
    "constraints.h": (None, "constraints.h"),
    "terminal.P": ([[1, 0], [0, -1]], "terminal.P"),
    "terminal.K": ([1], "terminal.K"),
    "terminal.ellipsoid": ({}, "terminal.ellipsoid"),
    "soft": ([-1], "soft"),
    "blocks": ([1], "blocks"),
}


@pytest.mark.parametrize("field", WRONG)
def test_a_field_that_is_wrong_is_named(field):
    value, message = WRONG[field]
    good = json.loads(CONTROLLERS["ingredients"].to_json())
    data, *names = copy.deepcopy(good), *field.split(".")
    inner = data
    for name in names[:-1]:
        inner = inner[name]
    inner[names[-1]] = value
    with pytest.raises(ValueError, match=message):
        LinearMPC.from_json(json.dumps(data))
    if names[-1] in inner and field not in ("more", "soft", "blocks"):
        del inner[names[-1]]
        with pytest.raises(ValueError, match=names[-1]):
            LinearMPC.from_json(json.dumps(data))


@pytest.mark.parametrize("text", ["", "[]", "{}", "NaN", None, 3, "[" * 100_000])
def test_text_that_is_no_controller(text):
    with pytest.raises(ValueError, match=r"text|cost"):
        LinearMPC.from_json(text)
    nan = CONTROLLERS["plain"].to_json().replace("0.1", "NaN", 1)
    with pytest.raises(ValueError, match="NaN"):
        LinearMPC.from_json(nan)


def test_python_control_solves_the_same_problem_from_these_matrices():
    controller = CONTROLLERS["sets"]
    m, dt, N = matrices(controller), 0.1, 8
    plant = control.ss(m["A"], m["B"], m["C"], 0, dt)
    K, P, _ = control.dlqr(plant, m["Q"], m["R"])
    own, cost_to_go = CART.lqr(m["Q"], m["R"])
    np.testing.assert_allclose(K, own, atol=1e-9)
    np.testing.assert_allclose(P, cost_to_go, atol=1e-9)
    x0 = np.array([0.5, 0.2])
    plan = controller.solve(x0).trajectory
    stages = np.concatenate([plan.x[:-1], plan.u], axis=1)
    assert (stages @ m["H"].T <= m["h"] + 1e-9).all()
    assert (m["H_N"] @ plan.x[-1] <= m["h_N"] + 1e-9).all()
    weighed = np.einsum("ki,ij,kj->", plan.x[:-1], m["Q"], plan.x[:-1])
    weighed += np.einsum("ki,ij,kj->", plan.u, m["R"], plan.u) + plan.x[-1] @ m["P"] @ plan.x[-1]
    assert weighed == pytest.approx(controller.solve(x0).cost)
    assert N == len(plan.u)
    inside = matrices(CONTROLLERS["ingredients"])
    np.testing.assert_allclose(inside["P"], cost_to_go, atol=1e-9)


@pytest.mark.parametrize("matrices", [matrices])
def test_bad_input_of_matrices(matrices):
    with pytest.raises(ValueError, match="controller"):
        matrices(None)
