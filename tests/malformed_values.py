"""What is put in the place of a valid argument, and where it is right after all."""

from __future__ import annotations

import jax
import malformed_samples as sound
import numpy as np
import scipy.sparse as sp

import prefmpc as p


class Own(Exception):
    """What a function of the user raises; it passes through as it is."""


def raises(*_):
    raise Own


ANYTHING = {
    "None": None,
    "text": "far",
    "digits": "1",
    "bytes": b"12",
    "True": True,
    "NaN": np.nan,
    "inf": np.inf,
    "-inf": -np.inf,
    "-1": -1,
    "0": 0,
    "1.5": 1.5,
    "10^30": 10**30,
    "10^400": 10**400,
    "1j": 1j,
    "[]": [],
    "[None]": [None],
    "ragged": [[1.0, 2.0], [3.0]],
    "dict": {"a": 1.0},
    "set": {1.0},
    "objects": np.array([object()], dtype=object),
    "texts": np.array(["1", "2"]),
    "dates": np.array(["2020-01-01"], dtype="datetime64[D]"),
    "date": np.datetime64("2020-01-01"),
    "span": np.timedelta64(1, "s"),
    "sparse": sp.csr_matrix(np.eye(2)),
    "masked": np.ma.masked,
    "ellipsis": ...,
    "raises": raises,
    "says nothing": lambda *_: None,
    "says text": lambda *_: "far",
    "says a matrix": lambda *_: np.ones((3, 3)),
    "says NaN": lambda *_: np.nan,
    "class": p.QuadraticCost,
    "plant": sound.SYSTEM,
    "plants": p.LinearSystem.stack([sound.SYSTEM, sound.SYSTEM]),
    "larger plant": p.LinearSystem(np.eye(3), np.eye(3), dt=0.1),
    "nonlinear plant": sound.CAR,
    "cost": sound.COST,
    "costs": p.QuadraticCost(np.stack([np.eye(2)] * 2), np.ones((2, 1, 1))),
    "larger cost": p.QuadraticCost(np.eye(3), np.eye(3)),
    "network": sound.ICNN,
    "trajectory": sound.POOL[0],
    "pool": sound.POOL,
    "shorter pool": p.Trajectory(np.ones((5, 2, 3)), np.ones((5, 1, 2))),
    "failed pool": jax.tree.map(lambda leaf: leaf * np.nan, sound.POOL[:2]),
    "polyhedron": sound.LIMITS,
    "ellipsoid": p.Ellipsoid(np.eye(3)),
    "comparisons": sound.DATA,
    "prior": sound.PRIOR,
    "key": sound.KEY,
    "keys": jax.random.split(sound.KEY, 2),
}


def spoiled(value):
    """Return what can go wrong with a good array, or with the arrays in a good sequence."""
    if isinstance(value, (list, tuple)) and value and isinstance(value[0], np.ndarray):
        parts = spoiled(value[0])
        return {f"first {name}": [bad, *value[1:]] for name, bad in parts.items()}
    if isinstance(value, (list, tuple)) and value:
        return {"one more": [*value, value[0]], "one None": [None, *value[1:]], "one 9": [9]}
    if not isinstance(value, np.ndarray):
        return {}

    def with_one(entry):
        out = np.array(value, float)
        out.flat[-1] = entry
        return out

    mask = np.zeros(value.shape, bool)
    mask.flat[-1] = True
    out = {
        "masked": np.ma.array(value, mask=mask),
        "deeper": np.stack([value, value]),
        "flatter": value[0],
        "longer": np.concatenate([value, value]),
        "empty": value[:0],
        "with NaN": with_one(np.nan),
        "with inf": with_one(np.inf),
        "with -inf": with_one(-np.inf),
        "with 1e308": with_one(1e308),
        "negative": -1.0 - np.abs(value),
        "as texts": value.astype(str),
        "as bytes": value.astype("S"),
        "as objects": np.array([str(v) for v in value.ravel()], object).reshape(value.shape),
        "as complex": value.astype(complex),
        "as booleans": value.astype(bool),
        "list of masked": [np.ma.array(value[0], mask=mask[-1]), *value[1:]],
        "wider": np.concatenate([value, value], axis=-1),
        "with None": [None, *value[1:]],
    }
    return {**out, "as sparse": sp.csr_matrix(value)} if value.ndim == 2 else out


TABLE = """
negative, with 1e308 | A, B, x, u, F, MLPCost: c, x_r, u_r, x0, law, x_first, u_first, x_second
negative, with 1e308 | u_second
1.5, 10^30 | dt, cart, bob, length, force, wheelbase, steering_rate, brake, throttle, high
1.5, 10^30 | logistic: scale, bryson: scale, strength, fit_global: l2
None | LinearSystem.from_control: dt, g, ICNNCost.random: steps, MLPCost.random: steps
None | lqr_pool: x0, weights, tie_break, NonlinearMPC: path, test, mesh, terminal, reference
None | best
nothing | LinearSystem.from_control: system, LinearSystem.lqr: Q, LinearSystem.lqr: R
nothing | MapResult.probability: level, Comparisons: first, MapResult.probability: first
nothing | Comparisons: second, MapResult.probability: second, regret: trajectories
nothing | plots.boxes: values
None, negative, with 1e308 | SecondOrderCone: g, c, y, Trajectory: y_r, u_before, y_first
None, negative, with 1e308 | y_second, start
0, 1.5, 10^30 | tol, epsilon, coupling, tolerance, floor, l2, l1, learning_rate
with 1e308 | Q, R, masses, P, ICNNCost: c, lqr_pool: radius, scale
nonlinear plant, plant | rollout: system, NonlinearMPC: system, steady_state: system
nonlinear plant, plant | simulate: system
failed pool, pool, shorter pool, trajectory | second_moments: trajectory, max_input: trajectory
failed pool, pool, shorter pool, trajectory | settling_time: trajectory, select: trajectory
longer, wider, with 1e308 | radius, SeparableCost.start: scale, ICNNCost.random: scale
longer, wider, with 1e308 | MLPCost.random: scale
True | bias, even, progress, nearest, saturate
cost, costs | fit_network: initial, BatchedMPC: cost, closed_loops: costs, mpc_rollout: cost
longer, wider | bryson: u_max, index, x_max
plant, plants | BatchedMPC: system, closed_loops: system, mpc_rollout: system
deeper, negative, with 1e308 | z, BatchedMPC.solve: x0, simulate: x0
first negative, first with 1e308 | V, b, W
1.5 | LinearSystem.from_continuous: dt, low
0, 1.5, 10^30, inf | oscillating_masses: u_max, kappa
one more | systems, choose_prior: priors
empty, flatter, longer, negative, with 1e308 | closed_loops: x0, mpc_rollout: x0
failed pool | first, second
cost, costs, network | criterion, regret: cost
0 | rate, signal
cost, network | accuracy: model, cost
[] | U, check_stability: output_cones
cost | LinearMPC: cost, terminal_ingredients: cost
negative | LinearSystem.from_continuous: A
None, longer, negative, with 1e308 | C
-1, -inf, 0, None, flatter, negative, with -inf | u_min
-1, 0, 1.5, 10^30, None, flatter, inf, with 1e308, with inf | u_max
plant | system
0, 1.5, 10^30, flatter | stiffness
negative, wider, with 1e308 | H
negative, with 1e308, with inf | h
-1, -inf, 0, flatter, negative, with -inf | lower
-1, 0, 1.5, 10^30, flatter, inf, with 1e308, with inf | upper
1.5, 10^30, inf | level
-1, 0, 1.5, 10^30 | d
deeper, with 1e308 | SeparableCost: c
failed pool, pool, trajectory | trajectory
deeper, empty, flatter, longer, negative, with 1e308 | rollout: x0
0, 10^30, 10^400, key | key
says NaN | ask
pool, shorter pool | trajectories
pool | Comparisons.random: trajectories
as booleans | labels
cost, costs, larger cost, network | model
-1, 0, 1.5, 10^30, [], deeper, empty, flatter, longer, negative, wider, with 1e308 | values
one 9, one more | widths
None, polyhedron | constraints
polyhedron | soft_constraints: constraints
0, 1.5, 10^30, flatter, with 1e308 | weight
comparisons | comparisons
None, cost, costs | initial
prior | prior
None, negative | outputs
one more, prior | priors
None, comparisons | validation
[], one more | output_cones
None, first negative, first with 1e308, ragged | steady_state: start
None, plant, plants | plants
None, deeper, raises, says NaN, says a matrix, says nothing, says text | Interview: x0
raises, says NaN, says a matrix, says nothing, says text | Interview: controller
None, cost, costs, larger cost, network, pool, raises, says NaN | Interview: pool
cost, costs, larger cost, network, raises, says NaN, says a matrix | Interview: choose
None, prior | Interview: prior
0, 10^30, 10^400, key | Interview: key
1.5, 10^30 | spread
0, 1.5, 10^30 | sharpness
0, None | Interview.answer: value
0, 1.5, 10^30, inf | least_gain
0 | lapse, repeat_every
0, 1.5, 10^30 | Interview.finished: level, ask: level
digits, text | title
None, digits, text | draw
None | Interview.to_html: names, Interview.to_html: units, ask: names, ask: units
True | overwrite, export_c: disturbance
1.5, 10^30, inf, None, flatter, with 1e308, with inf | max_increment
1.5, 10^30, inf, flatter, with 1e308, with inf | soft
0, 1.5, 10^30 | soft_quadratic
None | blocks, export_c: tol
None, negative, with 1e308 | KalmanEstimator.reset: x0
None, negative | B_d, C_d
None, negative, with 1e308 | OutputFeedback: y_r, y_r
None, longer, negative | states
None, trajectory | LinearMPC.solve: reference
None, negative | disturbance
True | Interview.to_html: overwrite, per_step
one more | Recordings: trajectories
one 9, None | grades
set | Answers.from_labels: labels
longer, wider, None | Answers.from_ratings: index
None | Answers.from_rankings: shown
None, texts | who
None, with 1e308 | fit_map: weights
1.5, 10^30 | sharper, fit_hierarchy: apart, find_camps: odds, half_life
0, 1.5, 10^30 | find_camps: apart
"""
"""What is right after all | for which argument of all calls, or of one call, which goes before."""

ACCEPTED = {
    argument: labels.split(", ")
    for labels, arguments in (line.split(" | ") for line in TABLE.strip().splitlines())
    for argument in arguments.split(", ")
}
ACCEPTED["Interview: pool"] += ["says a matrix", "says nothing", "says text", "shorter pool"]
ACCEPTED["Interview: choose"] += ["says nothing", "says text"]


def accepted(name, argument):
    """Return the labels of the values that are right for an argument of a call."""
    return ACCEPTED.get(f"{name}: {argument}", ACCEPTED.get(argument, ()))
