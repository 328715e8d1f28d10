"""What is put in the place of a valid argument, and where it is right after all."""

from __future__ import annotations

import jax
import malformed_calls as calls
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
    "plant": calls.SYSTEM,
    "plants": p.LinearSystem.stack([calls.SYSTEM, calls.SYSTEM]),
    "larger plant": p.LinearSystem(np.eye(3), np.eye(3), dt=0.1),
    "nonlinear plant": calls.CAR,
    "cost": calls.COST,
    "costs": p.QuadraticCost(np.stack([np.eye(2)] * 2), np.ones((2, 1, 1))),
    "larger cost": p.QuadraticCost(np.eye(3), np.eye(3)),
    "network": calls.ICNN,
    "trajectory": calls.POOL[0],
    "pool": calls.POOL,
    "shorter pool": p.Trajectory(np.ones((5, 2, 3)), np.ones((5, 1, 2))),
    "failed pool": jax.tree.map(lambda leaf: leaf * np.nan, calls.POOL[:2]),
    "polyhedron": calls.LIMITS,
    "ellipsoid": p.Ellipsoid(np.eye(3)),
    "comparisons": calls.DATA,
    "prior": calls.PRIOR,
    "key": calls.KEY,
    "keys": jax.random.split(calls.KEY, 2),
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


ACCEPTED = {}


def accepted(name, argument):
    """Return the labels of the values that are right for an argument."""
    return ACCEPTED.get(f"{name}: {argument}", ACCEPTED.get(argument, ()))
