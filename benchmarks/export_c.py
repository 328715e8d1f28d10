"""Size and time of exported controllers, beside `LinearMPC` and, where it is installed, DAQP.

``python benchmarks/export_c.py``: masses with input bounds, the same with walls, each in double and
float, compiled by gcc with -Os for the size and with -O2 for the time. All of them solve along the
same closed loops, so that times of one run compare. DAQP gets the condensed problem, from Python.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "book"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np

from prefmpc import LinearMPC, Polyhedron, QuadraticCost, export_c, oscillating_masses
from prefmpc.mpc._affine import AffineProgram
from studies import QUADRATIC_Q, QUADRATIC_R

STATES, STEPS = 30, 50


def loops(controller: LinearMPC, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the states along closed loops, their inputs, and the microseconds of a solve."""
    X, U, seconds = [], [], 0.0
    for x in states:
        for _ in range(STEPS):
            began = time.perf_counter()
            u = controller.solve(x).u
            seconds += time.perf_counter() - began
            X.append(x)
            U.append(u)
            x = controller.system.step(x, u)
    return np.array(X), np.array(U), 1e6 * seconds / len(X)


def by_daqp(controller: LinearMPC, X: np.ndarray, U: np.ndarray) -> str:
    """Return microseconds of a solve and the largest difference."""
    try:
        import daqp
    except ImportError:
        return "DAQP is not installed"
    program = AffineProgram.of(controller).condensed().merged()
    H, G = program.P.toarray(), program.rows.toarray()
    none, worst, seconds = np.zeros(len(G), ctypes.c_int), 0.0, 0.0
    p = np.zeros(program.F.shape[1])
    for x, u in zip(X, U, strict=True):
        p[: len(x)] = x
        q, low, high = program.at(p)
        low, high = np.clip(low, -1e30, 1e30), np.clip(high, -1e30, 1e30)
        began = time.perf_counter()
        z, _, flag, _ = daqp.solve(H, q, G, high, low, none)
        seconds += time.perf_counter() - began
        assert flag == 1
        worst = max(worst, float(np.abs(program.S @ z + program.T @ p - u).max()))
    return f"{1e6 * seconds / len(X):.0f} µs, {worst:.1e} from Python"


def in_c(controller: LinearMPC, states: np.ndarray, precision: str) -> str:
    """Return what `make size` and `make check` say."""
    options = {"precision": precision, "states": states, "steps": STATES * STEPS}
    said = {}
    with tempfile.TemporaryDirectory() as folder:
        made = export_c(controller, Path(folder, "mpc"), **options)
        for flags, target in (("-Os", "size"), ("-O2", "check")):
            make = ["make", "-s", "clean", target, f"CFLAGS={flags}"]
            done = subprocess.run(make, cwd=made.folder, capture_output=True, text=True)
            said[target] = done.stdout
    size = re.search(r"(\d+)\s+\w+\s+\(TOTALS\)", said["size"])
    lines = said["check"].splitlines()
    total = int(size[1]) if size else 0
    return f"{made.form}, {total} bytes; " + "; ".join(lines[1:3] + lines[4:])


def main() -> None:
    """Print a table."""
    jax.config.update("jax_enable_x64", True)
    system, cost = oscillating_masses(), QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
    walls = Polyhedron.box([-0.6] * 3 + [-4] * 3 + [-1] * 2, [0.6] * 3 + [4] * 3 + [1] * 2)
    states = np.random.default_rng(0).uniform(-0.5, 0.5, (STATES, 6))
    for name, constraints in (("input bounds", None), ("input bounds and walls", walls)):
        controller = LinearMPC(system, cost, 10, constraints=constraints)
        possible = np.array([x for x in states if controller.solve(x).status == "solved"])
        X, U, python = loops(controller, possible)
        print(f"\n{name}\n  Python: {python:.0f} µs a solve\n  DAQP: {by_daqp(controller, X, U)}")
        for precision in ("double", "float"):
            print(f"  C, {precision}: {in_c(controller, possible, precision)}")


if __name__ == "__main__":
    main()
