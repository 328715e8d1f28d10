"""The parts of an exported controller that differ from one to the next, as text."""

from __future__ import annotations

import dataclasses
from importlib import resources
from typing import Any

import numpy as np

from prefmpc.mpc._affine import AffineProgram
from prefmpc.mpc._limits import ON_LIMIT, input_size, row_sizes
from prefmpc.mpc._stages import pushed_states
from prefmpc.mpc._target import input_sizes
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.steady import SteadyState
from prefmpc.mpc.terminal import stage_constraints

RUN = 50
"""Steps of a recorded loop; then the next one begins."""

INFINITE = 1e30


def filled(name: str, values: dict[str, str]) -> str:
    """Return one of the files that are the same for all, with its @NAMES@ replaced."""
    out = (resources.files("prefmpc.mpc") / "static" / name).read_text("utf-8")
    for key, value in values.items():
        out = out.replace(f"@{key}@", value)
    return out


def sizes(
    controller: LinearMPC, precision: str, tol: float, max_iterations: int, disturbance: bool
) -> dict[str, str]:
    """Return what mpc.h and README.md say of a controller."""
    system = controller.system
    return {
        "NX": str(system.nx),
        "NU": str(system.nu),
        "HORIZON": str(controller.horizon),
        "PERIOD": f"{system.dt:g}",
        "ITERATIONS": str(max_iterations),
        "TOLERANCE": repr(tol),
        "HAS_REFERENCE": f"#define MPC_HAS_REFERENCE {int(not controller._ingredients)}"
        " /* whether there is mpc_reference */",
        "HAS_DISTURBANCE": f"#define MPC_HAS_DISTURBANCE {int(disturbance)}"
        " /* whether there is mpc_disturbance */",
        "HAS_BEFORE": f"#define MPC_HAS_BEFORE {int(stepped(controller))}"
        " /* whether there is mpc_before */",
        "FLOAT": precision,
    }


def stepped(controller: LinearMPC) -> bool:
    """Say whether increments are limited, so that the input before matters."""
    options = controller._options
    return options is not None and options.increment is not None


class _Writer:
    """C arrays of one precision."""

    def __init__(self, precision: str) -> None:
        self.precision = precision
        self.lines: list[str] = []

    def number(self, value: float) -> str:
        value = float(np.clip(value, -INFINITE, INFINITE))
        single = self.precision == "float"
        text = f"{np.float32(value):.9g}" if single else f"{value:.17g}"
        text = text if any(mark in text for mark in ".en") else f"{text}.0"
        return f"{text}f" if single else text

    def define(self, name: str, value: str) -> None:
        self.lines.append(f"#define DATA_{name} {value}")

    def array(self, kind: str, name: str, values: list[str]) -> None:
        body = ", ".join(values or ["0"])  # C has no empty arrays
        self.lines.append(f"static const {kind} data_{name}[] = {{{body}}};")

    def vector(self, name: str, values: Any) -> None:
        self.array("mpc_float", name, [self.number(v) for v in np.asarray(values)])

    def matrix(self, name: str, values: np.ndarray) -> None:
        """Write the rows of a matrix, without its zeros."""
        places = [np.flatnonzero(row) for row in values]
        starts = np.concatenate([[0], np.cumsum([len(place) for place in places])])
        columns = np.concatenate([np.zeros(0, int), *places])
        self.array("data_index", f"{name}_start", [str(int(i)) for i in starts])
        self.array("data_index", f"{name}_column", [str(int(i)) for i in columns])
        entries = np.concatenate(
            [np.zeros(0), *(row[at] for row, at in zip(values, places, strict=True))]
        )
        self.vector(f"{name}_value", entries)
        parts = ", ".join(f"data_{name}_{part}" for part in ("start", "column", "value"))
        self.lines.append(f"static const data_matrix data_{name} = {{{parts}}};")


def constants(
    controller: LinearMPC, program: AffineProgram, precision: str, disturbance: bool
) -> str:
    """Return mpc_data.h."""
    system, fixed = controller.system, controller._program.fixed
    w = _Writer(precision)
    n, size = program.F.shape
    entries = max(n * size, program.E.size, (system.nx + system.nu) ** 2, program.S.size)
    index = "unsigned short" if entries < 2**16 else "unsigned int"
    w.lines += [
        "/* The numbers of this controller, for mpc.c alone. */",
        "#ifndef MPC_DATA_H",
        "#define MPC_DATA_H",
        "",
        f"typedef {index} data_index;",
        "typedef struct {",
        "    const data_index *start, *column;",
        "    const mpc_float *value;",
        "} data_matrix;",
        "",
    ]
    w.define("N", str(n))
    w.define("M", str(program.rows.shape[0]))
    w.define("P", str(size))
    w.define("INFINITE", w.number(INFINITE))
    w.define("PROVEN", w.number(1e-4 if precision == "double" else 1e-3))
    w.define("FIXED", str(len(fixed._limits)))
    w.vector("q0", program.q)
    w.matrix("q", program.F)
    w.vector("lower", program.lower)
    w.vector("upper", program.upper)
    w.matrix("limits", program.E)
    w.matrix("from_plan", program.S)
    w.matrix("from_state", program.T)
    w.vector("u_min", system.u_min)
    w.vector("u_max", system.u_max)
    at = size - system.nu * stepped(controller)
    w.define("BEFORE", str(at))
    w.define("DISTURBANCE", str(at - system.nx))
    _checks_of(w, controller, size, at - system.nx if disturbance else None)
    return "\n".join([*w.lines, "", "#endif", ""])


def _checks_of(w: _Writer, controller: LinearMPC, size: int, disturbed: int | None) -> None:
    """Write what says whether a state or a set point is possible at all.

    ``disturbed`` is where the disturbance begins among ``size`` parameters, if there is one.
    """
    system, fixed = controller.system, controller._program.fixed
    double, plant = w.precision == "double", (system.A, system.B)
    if len(fixed._limits):
        w.define("ON_LIMIT", w.number(ON_LIMIT if double else 1e-5))
        whole = np.zeros((len(fixed._map), size))
        whole[:, : system.nx] = fixed._map
        if disturbed is not None:
            for i, d in enumerate(np.eye(system.nx)):
                pushed = pushed_states(system.A, np.tile(d, (controller.horizon, 1)))
                moved = (fixed._rows * pushed[fixed._stages]).sum(axis=1)
                whole[:, disturbed + i] = moved
        w.matrix("fixed", whole)
        w.vector("fixed_limit", fixed._limits)
        at_rest, u_size = np.zeros(system.nx), input_size(system.u_min, system.u_max)
        w.vector("fixed_size", row_sizes(*plant, u_size, at_rest, fixed._rows, fixed._limits))
    if not controller._ingredients:
        Z = stage_constraints(system, controller._hard)
        w.define("REACHED", w.number(1e-6 if double else 1e-4))
        w.matrix("drift", np.concatenate([system.A - np.eye(system.nx), system.B], axis=1))
        w.vector("units", input_sizes(*plant, system.C, system.u_min, system.u_max))
        w.define("SETS", str(len(Z.h)))
        w.matrix("sets", Z.H)
        w.vector("sets_limit", Z.h)


@dataclasses.dataclass(frozen=True)
class Recording:
    """Closed loops (runs, steps) of the controller in Python: x before each input u."""

    x: np.ndarray
    u: np.ndarray

    def text(self, controller: LinearMPC, reference: SteadyState | None, allowed: float) -> str:
        """Return loop.h."""
        system = controller.system
        most = np.abs(self.u).max()
        lines = [
            "/* Closed loops, recorded in Python. */",
            "#ifndef LOOP_H",
            "#define LOOP_H",
            "",
            f"#define LOOP_RUNS {self.x.shape[0]}",
            f"#define LOOP_STEPS {self.x.shape[1]}",
            f"#define LOOP_REFERENCE {int(reference is not None)}",
            f"#define LOOP_ALLOWED {allowed * max(most, 1e-12):.3g}"
            " /* a larger difference of an input is an error */",
        ]
        arrays = {"A": system.A, "B": system.B}
        arrays["x"] = self.x.reshape(-1, system.nx)
        arrays["u"] = self.u.reshape(-1, system.nu)
        for name, values in arrays.items():
            rows = ",\n".join(f"    {{{', '.join(f'{v:.17g}' for v in row)}}}" for row in values)
            lines.append(f"static const double loop_{name}[][{values.shape[1]}] = {{\n{rows}\n}};")
        if reference is not None:
            for name, vector in {"x_r": reference.x, "u_r": reference.u}.items():
                body = ", ".join(f"{v:.17g}" for v in vector)
                lines.append(f"static const double loop_{name}[] = {{{body}}};")
        return "\n".join([*lines, "", "#endif", ""])


def recording(
    controller: LinearMPC, states: np.ndarray, reference: SteadyState | None, steps: int
) -> Recording:
    """Return closed loops from the states, one after the other, of ``steps`` steps in all."""
    system, length = controller.system, min(RUN, steps)
    X: list[list[np.ndarray]] = []
    U: list[list[np.ndarray]] = []
    for x in states:
        xs: list[np.ndarray] = []
        us: list[np.ndarray] = []
        before = U[-1][-1] if U else np.zeros(system.nu)
        for _ in range(length):
            solution = controller.solve(x, reference=reference, u_before=before)
            if solution.status != "solved":
                break
            xs.append(x)
            before = solution.u
            us.append(before)
            x = system.step(x, solution.u)
        else:
            X.append(xs)
            U.append(us)
        if len(X) == max(1, steps // length):
            break
    if not X:
        raise ValueError(f"states must begin closed loops of {length} steps that are all solved")
    return Recording(np.array(X), np.array(U))


def told(done: Any, values: dict[str, str], count: int) -> str:
    """Return README.md; ``done`` is the `CExport`."""
    held = values["HAS_REFERENCE"].split()[2] == "1"
    return filled(
        "README.md",
        {
            **values,
            "SET_POINT": "`mpc_reference(x_r, u_r)` sets another set point, a steady state."
            if held
            else "There is no `mpc_reference`: the terminal set is made for the origin.",
            "FORM": done.form,
            "VARIABLES": str(done.variables),
            "ROWS": str(done.rows),
            "CONDITION": f"{done.condition:.2g}",
            "COUNT": str(count),
            "WORST": str(done.worst_iterations),
            "MISSED": f"; {done.unsolved} did not end within these" if done.unsolved else "",
        },
    )
