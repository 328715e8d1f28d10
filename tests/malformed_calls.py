"""Valid calls of everything public, whose arguments `test_malformed_inputs` replaces."""

from __future__ import annotations

import inspect
import tempfile
from functools import cache
from pathlib import Path

import control
import matplotlib.pyplot as plt
import numpy as np
from malformed_samples import (
    BOUNDS,
    CAR,
    COST,
    DATA,
    DRAWN,
    ICNN,
    KEY,
    LAYERS,
    LIMITS,
    LOOP,
    LOOPS,
    MPC,
    NEWTON,
    PERSON,
    PLANT,
    POOL,
    PRIOR,
    SHARED,
    SIDES,
    SYSTEM,
    half,
    linear,
    still,
)

import prefmpc as p
from prefmpc import plots

NAMED = p.Comparisons(
    *(vars(DATA)[name] for name in vars(DATA) if name != "who"), np.arange(len(DATA)) % 2
)
COUNTS = {"weights": np.ones(len(DATA))}
PEOPLE = {"spread": 2.0, "sharpness": 2.0, "sharper": 1.0, "lapse": 0.1}


def unlogged(**options):
    return p.Interview(**options)


def shown(**options):
    with tempfile.TemporaryDirectory() as folder:
        AN_INTERVIEW().to_html(Path(folder, "ask.html"), **options)


def asked(**options):
    return p.ask(**options)


def exported(**options):
    with tempfile.TemporaryDirectory() as folder:
        p.export_c(folder=Path(folder, "mpc"), **options)


@cache
def AN_INTERVIEW():
    return p.Interview(SYSTEM, PRIOR, x0=np.ones(2), key=0, samples=20, steps=3)


def without(function, *names):
    """Return the signature of a function without some arguments: nothing is written here."""
    kept = inspect.signature(function).parameters.items()
    return inspect.Signature([value for name, value in kept if name not in names])


unlogged.__signature__ = without(p.Interview, "log")
asked.__signature__ = without(p.ask, "log", "who")
exported.__signature__ = without(p.export_c, "folder")
shown.__signature__ = without(p.Interview.to_html, "self", "path")


@cache
def valid_calls():
    """Return name → (function, valid arguments)."""
    ingredients = p.terminal_ingredients(SYSTEM, COST)
    found = p.fit_map(DATA, PRIOR)
    rated = p.fit_raters(NAMED, PRIOR)
    check = p.check_stability(SYSTEM, COST)
    target = p.steady_state(SYSTEM, [0.0, 0.0])
    nets = p.MLPCost.random([1.0, 1, 1], key=KEY, widths=(2,), shape=(2,))
    tracker = p.ReferenceTracker(p.LinearMPC(SYSTEM, COST, 3), [0.0, 0.0])
    nonlinear, controller = p.NonlinearMPC(SYSTEM, COST, 3), p.LinearMPC(SYSTEM, COST, 3)
    noise = {"state_noise": np.ones(2), "output_noise": np.ones(2), "disturbance_noise": np.ones(1)}
    noise |= {"B_d": np.ones((2, 1)), "C_d": np.zeros((2, 1))}
    estimator = p.KalmanEstimator(SYSTEM, **noise)
    interview = AN_INTERVIEW()
    names = ["x1", "x2", "u1"]
    deviations = {"x_r": np.ones(2), "u_r": np.ones(1), "y_r": np.ones(2), "u_before": np.ones(1)}
    out = {
        # plants
        "LinearSystem": (p.LinearSystem, PLANT),
        "LinearSystem.from_continuous": (p.LinearSystem.from_continuous, PLANT),
        "LinearSystem.from_control": (
            p.LinearSystem.from_control,
            {"system": control.ss(SYSTEM.A, SYSTEM.B, np.eye(2), 0, 0.1), "dt": 0.1, **BOUNDS},
        ),
        "LinearSystem.stack": (p.LinearSystem.stack, {"systems": [SYSTEM, SYSTEM]}),
        "LinearSystem.lqr": (SYSTEM.lqr, {"Q": np.eye(2), "R": np.eye(1)}),
        "NonlinearSystem": (
            p.NonlinearSystem,
            {"f": linear, "g": still, "nx": 2, "nu": 1, "dt": 0.1, **BOUNDS},
        ),
        "NonlinearSystem.from_continuous": (
            p.NonlinearSystem.from_continuous,
            {"f": linear, "g": still, "nx": 2, "nu": 1, "dt": 0.1, "substeps": 2, **BOUNDS},
        ),
        "NonlinearSystem.linearise": (CAR.linearise, {"x": np.zeros(2), "u": np.zeros(1)}),
        "oscillating_masses": (
            p.oscillating_masses,
            {"masses": np.ones(2), "stiffness": np.ones(3), "dt": 0.2, "u_max": 1.0},
        ),
        "cart_pendulum": (
            p.cart_pendulum,
            {"cart": 1.0, "bob": 0.2, "length": 0.5, "dt": 0.05, "force": 10.0},
        ),
        "kinematic_bicycle": (
            p.kinematic_bicycle,
            {"wheelbase": 2.7, "dt": 0.2, "steering_rate": 0.4, "brake": 4.0, "throttle": 2.0},
        ),
        # sets
        "Polyhedron": (p.Polyhedron, {"H": np.eye(2), "h": np.ones(2)}),
        "Polyhedron.box": (p.Polyhedron.box, {"lower": -np.ones(2), "upper": np.ones(2)}),
        "Polyhedron.contains": (LIMITS.contains, {"z": np.ones(3), "tol": 1e-9}),
        "Ellipsoid": (p.Ellipsoid, {"P": np.eye(2), "level": 2.0}),
        "Ellipsoid.contains": (p.Ellipsoid(np.eye(3)).contains, {"z": np.ones(3), "tol": 1e-9}),
        "SecondOrderCone": (
            p.SecondOrderCone,
            {"F": np.eye(2), "d": 1.0, "g": np.ones(2), "c": np.ones(2)},
        ),
        "SecondOrderCone.contains": (
            p.SecondOrderCone(np.eye(3), 1.0).contains,
            {"z": np.ones(3), "tol": 1e-9},
        ),
        # trajectories
        "Trajectory": (
            p.Trajectory,
            {"x": np.ones((4, 2)), "u": np.ones((3, 1)), "y": np.ones((3, 2)), **deviations},
        ),
        "Recordings": (p.Recordings, {"trajectories": [POOL, POOL], "per_step": False}),
        "Answers": (
            p.Answers,
            {"trajectories": POOL, "shown": [[0, 1]], "grades": [3], "answers": [0.5]},
        ),
        "Answers.from_labels": (
            p.Answers.from_labels,
            {"trajectories": POOL, "first": [0], "second": [1], "labels": [1]}
            | {"coding": "signs", "grades": 3},
        ),
        "Answers.from_ratings": (
            p.Answers.from_ratings,
            {"trajectories": POOL, "ratings": [2, 3], "stars": 5, "index": [0, 1]},
        ),
        "Answers.from_rankings": (
            p.Answers.from_rankings,
            {"trajectories": POOL, "rankings": [[0, 1]], "shown": [[0, 1, 2]]},
        ),
        "Answers.from_choices": (
            p.Answers.from_choices,
            {"trajectories": POOL, "shown": [[0, 1, 2]], "chosen": [0]},
        ),
        "second_moments": (p.second_moments, {"trajectory": POOL}),
        "phi": (p.phi, {"trajectory": POOL, "Q": np.eye(2), "R": np.eye(1)}),
        "max_input": (p.max_input, {"trajectory": POOL}),
        "settling_time": (p.settling_time, {"trajectory": POOL, "epsilon": 0.1}),
        "settling_text": (p.settling_text, {"kappa": 2.0, "steps": 3}),
        "rollout": (
            p.rollout,
            {
                **{"system": SYSTEM, "x0": np.ones((3, 2)), "law": np.ones((1, 2))},
                **{"steps": 2, "saturate": True},
            },
        ),
        "random_weights": (
            p.random_weights,
            {
                **{"nx": 2, "nu": 1, "key": KEY, "shape": (2,)},
                **{"low": 0.1, "high": 10.0, "coupling": 0.1},
            },
        ),
        "random_states": (p.random_states, {"radius": np.ones(2), "key": KEY, "shape": (2,)}),
        "lqr_pool": (
            p.lqr_pool,
            {
                **{"system": SYSTEM, "size": 2, "steps": 2, "key": KEY, "radius": np.ones(2)},
                **{"x0": None, "weights": (np.stack([np.eye(2)] * 2), np.ones((2, 1, 1)))},
                "saturate": False,
            },
        ),
        "select": (p.select, {"trajectory": POOL, "signals": ["x", "du"]}),
        # preferences and comparisons
        "QuadraticPreference": (p.QuadraticPreference, {"Q": np.eye(2), "R": np.eye(1)}),
        "QuadraticPreference()": (PERSON, SIDES),
        "SettlingTimePreference": (
            p.SettlingTimePreference,
            {"epsilon": 0.1, "tie_break": "max_input", "ties": "half"},
        ),
        "SettlingTimePreference()": (p.SettlingTimePreference(), SIDES),
        "by_criterion": (
            lambda criterion, tolerance: p.by_criterion(criterion, tolerance)(*SIDES.values()),
            {"criterion": p.max_input, "tolerance": 0.1},
        ),
        "by_criterion()": (p.by_criterion(p.max_input), SIDES),
        "lexicographic": (
            lambda preferences: p.lexicographic(half, preferences)(*SIDES.values()),
            {"preferences": PERSON},
        ),
        "lexicographic()": (p.lexicographic(half, PERSON), SIDES),
        "erring": (
            lambda preference, rate: p.erring(preference, rate)(*SIDES.values()),
            {"preference": PERSON, "rate": 0.1},
        ),
        "erring()": (p.erring(PERSON, 0.1), SIDES),
        "logistic": (
            lambda criterion, scale: p.logistic(criterion, scale)(*SIDES.values()),
            {"criterion": p.max_input, "scale": 0.1},
        ),
        "logistic()": (p.logistic(p.max_input, 1.0), SIDES),
        "one_by_one": (lambda ask: p.one_by_one(ask)(*SIDES.values()), {"ask": PERSON}),
        "one_by_one()": (p.one_by_one(PERSON), SIDES),
        "Comparisons": (
            p.Comparisons,
            {
                **{"trajectories": POOL, "first": [0, 1], "second": [1, 2], "labels": np.ones(2)},
                "who": ["Ada", "Bob"],
            },
        ),
        "Comparisons.random": (
            p.Comparisons.random,
            {
                **{"trajectories": POOL, "preference": PERSON, "size": 2, "key": KEY},
                "same_start": False,
            },
        ),
        "Comparisons.from_arrays": (
            p.Comparisons.from_arrays,
            {
                **{"x_first": np.ones((2, 4, 2)), "u_first": np.ones((2, 3, 1))},
                **{"x_second": np.ones((2, 4, 2)), "u_second": np.ones((2, 3, 1))},
                **{"y_first": np.ones((2, 3, 2)), "y_second": np.ones((2, 3, 2))},
                **{"labels": np.ones(2), "who": [1, 2]},
            },
        ),
        "Comparisons.sampled": (DATA.sampled, {"key": KEY}),
        "Comparisons.subset": (DATA.subset, {"index": np.array([0, 1])}),
        "Comparisons.load": (p.Comparisons.load, {"path": "nowhere.npz"}),
        # models
        "QuadraticCost": (p.QuadraticCost, {"Q": np.eye(2), "R": np.eye(1)}),
        "QuadraticCost()": (COST, {"trajectory": POOL}),
        "QuadraticCost.random": (
            lambda nx, nu, key, shape: p.QuadraticCost.random(nx, nu, key=key, shape=shape),
            {"nx": 2, "nu": 1, "key": KEY, "shape": (2,)},
        ),
        "SumCost": (p.SumCost, {"models": [COST, ICNN], "weights": [1.0, 2.0]}),
        "SumCost()": (p.SumCost([COST, ICNN]), {"trajectory": POOL}),
        "SignalCost": (p.SignalCost, {"model": COST, "signals": ["x"]}),
        "SignalCost()": (p.SignalCost(COST, "x"), {"trajectory": POOL}),
        "SeparableCost": (p.SeparableCost, {"c": np.ones((3, 3)), "scale": np.ones(3)}),
        "SeparableCost()": (p.SeparableCost.start(np.ones(3)), {"trajectory": POOL}),
        "SeparableCost.start": (p.SeparableCost.start, {"scale": np.ones(3), "shape": (2,)}),
        "SeparableCost.curve": (
            p.SeparableCost.start(np.ones(3)).curve,
            {"signal": 1, "values": np.ones(4)},
        ),
        "ICNNCost": (
            p.ICNNCost,
            {
                **{"V": [np.ones((2, 3))], "U": [], **LAYERS, "activation": "relu", "floor": 0.1},
                **{"bias": True, "even": False},
            },
        ),
        "ICNNCost()": (ICNN, {"trajectory": POOL}),
        "ICNNCost.random": (
            p.ICNNCost.random,
            {**DRAWN, "activation": "relu", "bias": True, "even": False},
        ),
        "MLPCost": (
            p.MLPCost,
            {"W": [np.ones((2, 3))], **LAYERS, "activation": "relu", "floor": 0.1},
        ),
        "MLPCost.random": (p.MLPCost.random, {**DRAWN, "activation": "relu"}),
        "soft_constraints": (p.soft_constraints, {"constraints": LIMITS, "weight": np.ones(6)}),
        # learning
        "WishartPrior": (p.WishartPrior, {"Q": np.eye(2), "R": np.eye(1), "strength": 1.0}),
        "bryson": (
            p.bryson,
            {"x_max": np.ones(2), "u_max": np.ones(1), "scale": 1.0, "strength": 1.0},
        ),
        "blocks": (p.blocks, {"states": [[0, 1], [2]], "inputs": [[0]]}),
        "fit": (
            p.fit,
            {
                **{"comparisons": DATA, "initial": None, "key": KEY, "restarts": 2, "test": None},
                **{"selection": "training_loss", "validation_fraction": 0.25, "l2": 1e-3},
                **{"l1": 0.0, "adam_steps": 2, "learning_rate": 0.01, "max_iterations": 2},
                "tol": 1e9,
            },
        ),
        "fit (initial)": (
            lambda initial: p.fit(DATA, initial, key=KEY, adam_steps=2, max_iterations=2, tol=1e9),
            {"initial": p.QuadraticCost.random(2, 1, key=KEY, shape=(2,))},
        ),
        "fit_map": (
            p.fit_map,
            {"comparisons": DATA, "prior": PRIOR, **NEWTON, "mesh": None, **COUNTS},
        ),
        "fit_maps": (p.fit_maps, {"comparisons": DATA, "priors": [PRIOR, PRIOR], **NEWTON}),
        "fit_network": (
            p.fit_network,
            {
                **{"comparisons": DATA, "initial": nets, "key": KEY, "validation": None},
                **{"validation_fraction": 0.25, "l2": 1e-3, "learning_rate": 0.01},
                **{"max_epochs": 10, "patience": 1, "batch_size": 64, "progress": False},
            },
        ),
        "fit_global": (p.fit_global, {"comparisons": DATA, "l2": 1e-3, "solver": "barrier"}),
        "MapResult.probability": (found.probability, {**SIDES, "level": 0.9}),
        "posterior": (p.posterior, {"result": found, "draws": 256, "key": 0}),
        "choose_prior": (
            p.choose_prior,
            {"comparisons": DATA, "priors": [PRIOR], "by": "evidence", "folds": 2, **SHARED},
        ),
        # several people
        "fit_raters": (p.fit_raters, {"comparisons": NAMED, "prior": PRIOR, **PEOPLE, **COUNTS}),
        "fit_hierarchy": (
            p.fit_hierarchy,
            {"comparisons": NAMED, "prior": PRIOR, "apart": 0.5, **PEOPLE, **COUNTS},
        ),
        "PeopleResult.newcomer": (rated.newcomer, {"comparisons": DATA}),
        "PeopleResult.sharpness": (rated.sharpness, {"level": 0.9}),
        "PeopleResult.lapses": (rated.lapses, {"level": 0.9}),
        "PeopleResult.relative": (rated.relative, {"level": 0.9}),
        "people_posterior": (p.people_posterior, {"result": rated, "draws": 256, "key": 0}),
        "find_camps": (
            p.find_camps,
            {
                **{"comparisons": NAMED, "prior": PRIOR, "most": 1, "odds": 20.0, "starts": 1},
                **{"key": KEY, "apart": 0.0, **PEOPLE, **COUNTS},
            },
        ),
        "agreement": (p.agreement, {"comparisons": NAMED, "level": 0.9}),
        "forgetting": (p.forgetting, {"n": 3, "half_life": 2.0}),
        "has_changed": (
            p.has_changed,
            {
                **{"comparisons": NAMED, "prior": PRIOR, "split": 0.5, "simulations": 1},
                **{"key": KEY, **PEOPLE},
            },
        ),
        # asking
        "Interview": (
            unlogged,
            {
                **{"system": SYSTEM, "prior": PRIOR, "x0": np.ones(2), "key": KEY, "spread": 2.0},
                **{"structure": "diagonal", "sharpness": 2.0, "coupling": 0.5, "steps": 3},
                **{"controller": "mpc", "horizon": 3, "constraints": LIMITS, "pool": POOL},
                **{"reference": None},
                **{"choose": "information", "lapse": 0.0, "repeat_every": 8, "samples": 50},
            },
        ),
        "Interview.next_batch": (interview.next_batch, {"size": 2}),
        "Interview.answer": (interview.answer, {"value": "first"}),
        "Interview.answer_with": (interview.answer_with, {"preference": PERSON, "count": 1}),
        "Interview.finished": (interview.finished, {"level": 0.02, "q": 0.9, "least_gain": 0.0}),
        "Interview.to_html": (
            shown,
            {
                **{"title": "Mine", "names": names, "units": names, "draw": None},
                **{"most": 30, "overwrite": False},
            },
        ),
        "ask": (
            asked,
            {
                **{"interview": interview, "names": names, "units": names, "draw": "() => null"},
                **{"level": 0.02, "certain": 0.9, "most": 30},
            },
        ),
        # controllers
        "LinearMPC": (
            p.LinearMPC,
            {
                **{**MPC, "terminal": ingredients, "soft": np.ones(6), "soft_quadratic": 1.0},
                **{"max_increment": np.ones(1), "blocks": [1, 2]},
            },
        ),
        "LinearMPC.solve": (
            p.LinearMPC(SYSTEM, COST, 3).solve,
            {
                **{"x0": np.ones(2), "reference": target, "disturbance": np.zeros(2)},
                "u_before": np.zeros(1),
            },
        ),
        "LinearMPC.from_json": (p.LinearMPC.from_json, {"text": controller.to_json()}),
        "matrices": (p.matrices, {"controller": controller}),
        "KalmanEstimator": (p.KalmanEstimator, {"system": SYSTEM, **noise}),
        "KalmanEstimator.reset": (estimator.reset, {"x0": np.ones(2)}),
        "KalmanEstimator.corrected": (estimator.corrected, {"y": np.ones(2)}),
        "KalmanEstimator.predict": (
            lambda u: estimator.predict(estimator.corrected(np.ones(2)), u),
            {"u": np.ones(1)},
        ),
        "OutputFeedback": (
            p.OutputFeedback,
            {"controller": controller, "estimator": estimator, "y_r": np.zeros(2)},
        ),
        "OutputFeedback.track": (
            p.OutputFeedback(controller, estimator).track,
            {"y_r": np.zeros(2)},
        ),
        "ConvexMPC": (
            p.ConvexMPC,
            {**MPC, "output_cones": [p.SecondOrderCone(np.eye(2), 9.0)], "terminal": check},
        ),
        "ConvexMPC.solve": (p.ConvexMPC(SYSTEM, COST, 3).solve, {"x0": np.ones(2)}),
        "BatchedMPC": (p.BatchedMPC, {**MPC, "terminal": ingredients, "tol": 1e-8}),
        "BatchedMPC.solve": (p.BatchedMPC(SYSTEM, COST, 3).solve, {"x0": np.ones(2)}),
        "NonlinearMPC": (
            p.NonlinearMPC,
            {
                **{**MPC, "path": lambda x, u: x[:1] - 9, "terminal": None, "solver": "newton"},
                **{"tol": 1e-4, "max_iterations": 20},
            },
        ),
        "NonlinearMPC.solve": (
            nonlinear.solve,
            {
                **{"x0": np.ones(2), "reference": target, "u_before": np.ones(1)},
                "start": np.zeros((3, 1)),
            },
        ),
        "export_c": (
            exported,
            {
                **{"controller": p.LinearMPC(SYSTEM, COST, 3), "precision": "double"},
                **{"tol": 1e-6, "max_iterations": 100, "states": np.ones((1, 2))},
                **{"reference": target, "steps": 2, "overwrite": False, "disturbance": False},
            },
        ),
        "ReferenceTracker": (
            p.ReferenceTracker,
            {
                **{"controller": p.LinearMPC(SYSTEM, COST, 3), "y_r": np.zeros(2)},
                **{"constraints": LIMITS, "nearest": False},
            },
        ),
        "ReferenceTracker.track": (tracker.track, {"y_r": np.zeros(2)}),
        "steady_state": (
            p.steady_state,
            {
                **{"system": SYSTEM, "y_r": np.zeros(2), "constraints": LIMITS},
                **{"start": (np.zeros(2), np.zeros(1)), "nearest": False},
                "disturbance": np.zeros(2),
            },
        ),
        "closed_loops": (
            p.closed_loops,
            {"costs": COST, **LOOP, "plants": None, "mesh": None},
        ),
        "mpc_rollout": (p.mpc_rollout, {"cost": COST, **LOOP}),
        "terminal_ingredients": (
            p.terminal_ingredients,
            {"system": SYSTEM, "cost": COST, "constraints": LIMITS, "max_steps": 50, "tol": 1e-9},
        ),
        "check_stability": (
            p.check_stability,
            {
                **{"system": SYSTEM, "cost": COST, "constraints": LIMITS, "output_cones": ()},
                "tol": 1e-6,
            },
        ),
        "StabilityCheck.rotated": (check.rotated, {"x": np.ones((2, 2)), "u": np.ones((2, 1))}),
        # evaluation
        "accuracy": (p.accuracy, {"model": COST, "comparisons": DATA}),
        "regret": (p.regret, {"cost": COST, "trajectories": LOOPS, "best": LOOPS[0]}),
        "win_rate": (
            p.win_rate,
            {"preference": PERSON, "first": LOOPS[0], "second": LOOPS[1], "confidence": 0.9},
        ),
        "simulate": (
            p.simulate,
            {"system": SYSTEM, "controller": still, "x0": np.ones(2), "steps": 2},
        ),
    }
    return {**out, **drawings()}


def drawings():
    return {
        "plots.responses": (
            lambda responses, dt: plots.responses(responses, dt, ylabel="y", ax=plt.gca()),
            {"responses": {"a": np.ones(3)}, "dt": 0.1},
        ),
        "plots.boxes": (
            lambda values: plots.boxes(values, ylabel="y", ax=plt.gca()),
            {"values": {"a": np.ones(3)}},
        ),
        "plots.heatmaps": (
            lambda matrices: plots.heatmaps(matrices),
            {"matrices": {"a": np.eye(2)}},
        ),
    }
