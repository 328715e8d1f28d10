"""A linear controller as JSON: plain numbers, checked when they are read."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from prefmpc._checks import finite_array, shaped
from prefmpc._matrices import psd_matrix
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc.terminal import TerminalIngredients
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Ellipsoid, Polyhedron

FORMAT, VERSION = "prefmpc LinearMPC", 1


def _numbers(values: Any) -> Any:
    """Return nested lists, with None for what is infinite: JSON has no infinity."""
    return np.asarray(np.where(np.isfinite(values), values, None)).tolist()


def _polyhedron(part: Polyhedron) -> dict[str, Any]:
    return {"H": _numbers(part.H), "h": _numbers(part.h)}


def stored(system: LinearSystem, cost: QuadraticCost, rest: dict[str, Any]) -> str:
    """Return the arguments of a controller as JSON."""
    out: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    out["system"] = {name: _numbers(getattr(system, name)) for name in "ABC"}
    out["system"] |= {"u_min": _numbers(system.u_min), "u_max": _numbers(system.u_max)}
    out["system"]["dt"] = system.dt
    out["cost"] = {"Q": _numbers(cost.Q), "R": _numbers(cost.R)}
    for name, value in rest.items():
        if isinstance(value, Polyhedron):
            value = _polyhedron(value)
        elif isinstance(value, TerminalIngredients):
            ball = {"P": _numbers(value.ellipsoid.P), "level": _numbers(value.ellipsoid.level)}
            parts = {"polyhedron": _polyhedron(value.polyhedron), "ellipsoid": ball}
            value = {"P": _numbers(value.P), "K": _numbers(value.K), **parts}
        elif isinstance(value, np.ndarray):
            value = _numbers(value)
        out[name] = value
    return json.dumps(out, allow_nan=False)


def restored(text: str, known: tuple[str, ...]) -> dict[str, Any]:
    """Return the arguments of a controller; a ValueError names the field that is wrong."""
    if not isinstance(text, (str, bytes, bytearray)):
        raise ValueError(f"text must be JSON, got {type(text).__name__}")
    try:
        data = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"text must be JSON: {error}") from None
    fields = _fields("text", data, {"format", "version", "system", "cost", "horizon"}, {*known})
    for name, wanted in (("format", FORMAT), ("version", VERSION)):
        if fields.pop(name) != wanted:
            raise ValueError(f"{name} must be {wanted!r}, got {data[name]!r}")
    system = _fields("system", fields["system"], {"A", "B", "C", "dt", "u_min", "u_max"}, set())
    for name, none in (("u_min", -np.inf), ("u_max", np.inf)):
        system[name] = _filled(system[name], none)
    cost = _fields("cost", fields["cost"], {"Q", "R"}, set())
    fields["system"] = _made("system", lambda: LinearSystem(**system))
    fields["cost"] = _made("cost", lambda: QuadraticCost(**cost))
    if "soft" in fields:
        fields["soft"] = _filled(fields["soft"], np.inf)
    if fields.get("constraints") is not None:
        fields["constraints"] = _set("constraints", fields["constraints"])
    if (end := fields.get("terminal")) is not None:
        whole = isinstance(end, dict) and "H" not in end
        fields["terminal"] = _ingredients(end) if whole else _set("terminal", end)
    return fields


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no number in JSON")


def _fields(name: str, data: Any, needed: set[str], possible: set[str]) -> dict[str, Any]:
    """Return a copy of a JSON object that has what is needed and nothing unknown."""
    if not isinstance(data, dict):
        raise ValueError(f"{name} must be an object with fields, got {type(data).__name__}")
    within = "" if name == "text" else f"{name}."
    for field in sorted(needed - data.keys()):
        raise ValueError(f"{within}{field} must be there, got only {sorted(data)}")
    for field in sorted(data.keys() - needed - possible):
        raise ValueError(f"{within}{field} must not be there: it means nothing to this version")
    return dict(data)


def _filled(values: Any, none: float) -> Any:
    return (
        [none if value is None else value for value in values]
        if isinstance(values, list)
        else values
    )


def _made(name: str, make: Callable[[], Any]) -> Any:
    """Return what is made of a field, or an error that names it."""
    try:
        return make()
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}.{error}") from None


def _set(name: str, data: Any) -> Polyhedron:
    fields = _fields(name, data, {"H", "h"}, set())
    return _made(name, lambda: Polyhedron(**fields))


def _ingredients(data: Any) -> TerminalIngredients:
    parts = _fields("terminal", data, {"P", "K", "polyhedron", "ellipsoid"}, set())
    ball = _fields("terminal.ellipsoid", parts["ellipsoid"], {"P", "level"}, set())
    ball["level"] = np.inf if ball["level"] is None else ball["level"]
    P = _made("terminal", lambda: psd_matrix("P", parts["P"], stack=False))
    K = _made("terminal", lambda: finite_array("K", parts["K"], ndim=2))
    return TerminalIngredients(
        np.asarray(P),
        np.asarray(_made("terminal", lambda: shaped("K", K, (None, len(P))))),
        _set("terminal.polyhedron", parts["polyhedron"]),
        _made("terminal.ellipsoid", lambda: Ellipsoid(**ball)),
    )
