"""Controllers in C against those in Python, compiled with everything that finds mistakes."""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
import pytest

from prefmpc import (
    LinearMPC,
    LinearSystem,
    Polyhedron,
    QuadraticCost,
    SteadyState,
    cart_pendulum,
    export_c,
    oscillating_masses,
    steady_state,
    terminal_ingredients,
)
from studies import QUADRATIC_Q, QUADRATIC_R

CC = shutil.which("gcc")
COMPILED = pytest.mark.skipif(
    CC is None or shutil.which("make") is None, reason="gcc and make are needed to compile C"
)
STRICT = "-O1 -g -Werror -fsanitize=address,undefined -fno-sanitize-recover=all"
MASSES = oscillating_masses()
PAPER = QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
ROOM = Polyhedron.box([-0.6] * 3 + [-4] * 3 + [-1] * 2, [0.6] * 3 + [4] * 3 + [1] * 2)


def quadrotor():
    """Return the 12-state example of OSQP's documentation."""
    A = np.eye(12)
    A[[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]] = 0.1
    A[[3, 4], [0, 1]] = 0.0488, -0.0488
    A[[9, 10], [0, 1]] = 0.9734, -0.9734
    A[[3, 4], [6, 7]] = 0.0016, -0.0016
    A[[9, 10], [6, 7]] = 0.0488, -0.0488
    B = np.array(
        [
            [0.0, -0.0726, 0.0, 0.0726],
            [-0.0726, 0.0, 0.0726, 0.0],
            [-0.0152, 0.0152, -0.0152, 0.0152],
            [0.0, -0.0006, -0.0000, 0.0006],
            [0.0006, 0.0, -0.0006, 0.0],
            [0.0106, 0.0106, 0.0106, 0.0106],
            [0, -1.4512, 0.0, 1.4512],
            [-1.4512, 0.0, 1.4512, 0.0],
            [-0.3049, 0.3049, -0.3049, 0.3049],
            [0.0, -0.0236, 0.0, 0.0236],
            [0.0236, 0.0, -0.0236, 0.0],
            [0.2107, 0.2107, 0.2107, 0.2107],
        ]
    )
    hover = 10.5916
    C = np.eye(6, 12)
    system = LinearSystem(A, B, C, dt=0.1, u_min=9.6 - hover, u_max=13.0 - hover)
    Q = np.diag([0, 0, 10.0, 10, 10, 10, 0, 0, 0, 5, 5, 5])
    tilt = np.full(12, np.inf)
    tilt[:2] = np.pi / 6
    low = np.where(np.isfinite(tilt), -tilt, -np.inf)
    low[5] = -1.0
    Z = Polyhedron.box(np.append(low, [-np.inf] * 4), np.append(tilt, [np.inf] * 4))
    return system, QuadraticCost(Q + 1e-6 * np.eye(12), 0.1 * np.eye(4)), Z


def pendulum():
    """Return the pendulum on a cart, upright."""
    system = cart_pendulum().linearise(np.zeros(4), np.zeros(1))
    return system, QuadraticCost(np.diag([1.0, 10, 0.1, 0.1]), [[0.01]])


def cases():
    """Return controllers, set points, and how far away their loops begin."""
    quad, quad_cost, tilt = quadrotor()
    cart, upright = pendulum()
    rail = Polyhedron.box([-0.6] + [-np.inf] * 4, [0.6] + [np.inf] * 4)
    spread = steady_state(MASSES, [0.2, 0.2, 0.2], nearest=True)
    away = steady_state(cart, [0.5, 0.0], nearest=True)
    up = steady_state(quad, [0, 0, 0, 0, 0, 1.0])
    rolling = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_min=-1, u_max=1)
    wide, near = 0.5 * np.ones(6), np.array([0.4, 0.08, 0.1, 0.1])
    end = terminal_ingredients(MASSES, PAPER)
    return {
        "masses": (LinearMPC(MASSES, PAPER, 10), None, 3 * wide),
        "masses elsewhere": (LinearMPC(MASSES, PAPER, 10, constraints=ROOM), spread, wide),
        "pendulum on a rail": (LinearMPC(cart, upright, 20, constraints=rail), away, near),
        "quadrotor": (LinearMPC(quad, quad_cost, 10, constraints=tilt), up, 0.1 * np.ones(12)),
        "options": (
            LinearMPC(
                *(rolling, QuadraticCost(np.eye(2), [[0.1]]), 8),
                **{"constraints": Polyhedron.box([-1, -0.4, -1], [1, 0.4, 1]), "soft": 30.0},
                **{"soft_quadratic": 30.0, "max_increment": 0.5, "blocks": [1, 1, 2, 4]},
            ),
            None,
            np.array([1.1, 0.5]),
        ),
        "terminal": (LinearMPC(MASSES, PAPER, 10, terminal=end), None, 0.3 * wide),
    }


CASES = cases()


def starts(radius):
    return np.random.default_rng(1).uniform(-1, 1, (30, len(radius))) * radius


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """Return a folder for what is the same in all libraries: OSQP, compiled once."""
    return tmp_path_factory.mktemp("objects")


def float_of(folder):
    return "float" if "OSQP_USE_FLOAT" in (folder / "osqp" / "osqp_configure.h").read_text() else ""


def build(folder, flags, objects, *targets):
    """Run make, with OSQP's objects from elsewhere if they are there."""
    kept = objects / f"{float_of(folder)}{flags}".replace("/", "")
    if kept.exists():
        shutil.copytree(
            kept, folder / "osqp" / "src", dirs_exist_ok=True, copy_function=shutil.copy
        )
    done = subprocess.run(
        ["make", *targets, f"CC={CC}", f"CFLAGS={flags}"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    if not kept.exists():
        kept.mkdir()
        for file in (folder / "osqp" / "src").glob("*.o"):
            shutil.copy(file, kept)
    return done.stdout


def number(said, text):
    return float(re.search(rf"^{said} (\S+)", text, re.M)[1])


@COMPILED
@pytest.mark.parametrize("name", CASES)
def test_a_thousand_steps_in_c_are_those_in_python(name, tmp_path, objects):
    controller, reference, radius = CASES[name]
    # Fewer steps for what takes many iterations, or is much like another.
    steps = {"options": 200, "masses elsewhere": 300, "terminal": 100}.get(name, 1000)
    options = {"reference": reference, "states": starts(radius), "steps": steps}
    made = export_c(controller, tmp_path / "mpc", tol=2e-8, max_iterations=5000, **options)
    said = build(made.folder, STRICT, objects, "check")
    assert number("steps", said) == steps
    assert number("not solved", said) == 0
    assert number("largest difference of an input", said) < 1e-6
    assert number("largest difference of a state", said) < 1e-6


def symbols(folder, *options):
    done = subprocess.run(["nm", *options, "libmpc.a"], cwd=folder, capture_output=True, text=True)
    return set(re.findall(r"\b[TUDBRWtdbr] (\w+)", done.stdout))


@COMPILED
def test_in_float_it_is_small_and_allocates_nothing(tmp_path, objects):
    controller, _, radius = CASES["masses"]
    options = {"states": starts(radius), "precision": "float", "max_iterations": 500}
    made = export_c(controller, tmp_path / "mpc", **options)
    assert (made.form, made.variables, made.rows) == ("condensed", 20, 20)
    said = build(made.folder, "-Os", objects, "check", "size")
    assert number("not solved", said) == 0
    assert number("largest difference of an input", said) < 3e-3
    total = re.search(r"(\d+)\s+\w+\s+\(TOTALS\)", said)
    assert int(total[1]) < 32_000
    used = symbols(made.folder, "-u")
    assert not {"malloc", "calloc", "realloc", "free"} & used
    # Of the C library it needs nothing but copying, at most.
    outside = used - symbols(made.folder, "--defined-only")
    assert outside - {"_GLOBAL_OFFSET_TABLE_"} <= {"memcpy", "memset", "strcpy", "memmove"}


PUSHED = """
#include <stdio.h>
#include "mpc.h"
int main(void)
{
    mpc_float x[MPC_NX] = {0.2, -0.1}, d[MPC_NX] = {0.01, 0.03}, u[MPC_NU] = {0};
    mpc_float x_r[MPC_NX] = {0.3, -0.1}, u_r[MPC_NU] = {-0.3};
    mpc_init();
    printf("%d ", (int)mpc_reference(x_r, u_r));
    printf("%d ", (int)mpc_disturbance(d));
    printf("%d ", (int)mpc_reference(x_r, u_r));
    printf("%d", (int)mpc_step(x, u));
    printf(" %.12g\\n", (double)u[0]);
    return 0;
}
"""


@COMPILED
def test_a_disturbance_in_c(tmp_path, objects):
    cart = LinearSystem([[1, 0.1], [0, 1]], [[0.0], [0.1]], dt=0.1, u_min=-1, u_max=1)
    wall = Polyhedron.box([-1, -5, -1], [0.5, 5, 1])
    controller = LinearMPC(cart, QuadraticCost(np.eye(2), [[0.1]]), 15, constraints=wall)
    options = {"disturbance": True, "tol": 1e-9, "steps": 50, "states": [[0.2, 0.1], [0.4, -0.2]]}
    made = export_c(controller, tmp_path / "mpc", **options)
    (made.folder / "main.c").write_text(PUSHED)
    build(made.folder, STRICT, objects, "replay")
    said = subprocess.run(["./replay"], cwd=made.folder, capture_output=True, text=True).stdout
    d = [0.01, 0.03]
    held = SteadyState(np.array([0.3, -0.1]), np.array([-0.3]), np.array([0.3, -0.1]))
    wanted = controller.solve([0.2, -0.1], reference=held, disturbance=d).u[0]
    *codes, u = said.split()
    assert codes == ["4", "0", "0", "0"]  # a steady state under the disturbance only
    assert float(u) == pytest.approx(wanted, abs=1e-7)


ASKED = """
#include <math.h>
#include <stdio.h>
#include "mpc.h"
static void say(mpc_status status, const mpc_float *u)
{
    printf("%d %d %g %g %d\\n", (int)status, (int)mpc_last_status(), (double)u[0],
           (double)mpc_last_residual(), mpc_last_iterations());
}
int main(void)
{
    static const mpc_float states[][MPC_NX] = {STATES};
    mpc_float u[MPC_NU];
    size_t i;
    mpc_init();
    for (i = 0; i < sizeof states / sizeof states[0]; i++) {
        u[0] = 77;
        say(mpc_step(states[i], u), u);
    }
    {
        mpc_float off[MPC_NX] = {0.3f, 0.1f}, none[MPC_NU] = {0};
        mpc_float nan_there[MPC_NX] = {NAN};
        printf("%d %d\\n", (int)mpc_reference(off, none), (int)mpc_reference(nan_there, none));
    }
    return 0;
}
"""


@COMPILED
@pytest.mark.parametrize("precision", ["double", "float"])
def test_without_an_answer_the_input_stays_and_the_status_says_so(precision, tmp_path, objects):
    cart = LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1, u_min=-1, u_max=1)
    wall = Polyhedron.box([-1, -5, -1], [0.5, 5, 1])
    controller = LinearMPC(cart, QuadraticCost(np.eye(2), [[0.1]]), 15, constraints=wall)
    options = {"precision": precision, "max_iterations": 3000, "steps": 50}
    options["states"] = starts(np.array([0.4, 0.3]))
    made = export_c(controller, tmp_path / "mpc", **options)
    asked = ["0.3, 0.1", "NAN, 0", "0.3, 3", "0.6, 0", "0.3, 0.1", "1e36, 1e36", "0.45, 0.2"]
    text = ASKED.replace("STATES", "{" + "}, {".join(asked) + "}")
    (made.folder / "main.c").write_text(text)
    build(made.folder, STRICT if precision == "double" else "-Os", objects, "replay")
    done = subprocess.run(["./replay"], cwd=made.folder, capture_output=True, text=True)
    assert not done.stderr
    *lines, references = [line.split() for line in done.stdout.splitlines()]
    said = [int(line[0]) for line in lines]
    assert said == [int(line[1]) for line in lines]
    # That there is no plan may take more iterations to prove than there are; no input either way.
    assert said[:2] + said[3:] == [0, 4, 1, 0, 1, 0]
    assert said[2] == 1 or (precision == "float" and said[2] == 2)
    assert references == ["4", "4"]
    for state, line in zip(asked, lines, strict=True):
        if line[0] == "0":
            wanted = controller([float(v) for v in state.split(",")])
            assert abs(float(line[2]) - wanted[0]) < (1e-4 if precision == "double" else 1e-2)
            assert float(line[3]) <= (1e-6 if precision == "double" else 1e-4)
        else:
            assert float(line[2]) == 77


@pytest.mark.parametrize("export_c", [export_c])
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"controller": None}, "controller"),
        ({"precision": "half"}, "precision"),
        ({"tol": 0}, "tol"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"states": np.ones(5)}, "states"),
        ({"states": [[np.nan] * 6]}, "states"),
        ({"states": [[1e3] * 6]}, "states"),
        ({"reference": 1}, "reference"),
        ({"steps": 0}, "steps"),
        ({"overwrite": 1.5}, "overwrite"),
    ],
)
def test_bad_input_of_an_export(export_c, changed, message, tmp_path):
    given = {"controller": CASES["masses elsewhere"][0], "folder": tmp_path / "mpc", **changed}
    with pytest.raises(ValueError, match=message):
        export_c(**given)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_there_stays_unless_told_otherwise(tmp_path):
    (tmp_path / "mpc").mkdir()
    (tmp_path / "mpc" / "mine.c").write_text("int mine;")
    with pytest.raises(FileExistsError, match="overwrite"):
        export_c(CASES["masses"][0], tmp_path / "mpc")
    export_c(CASES["masses"][0], tmp_path / "mpc", states=[np.ones(6)], steps=5, overwrite=True)
    there = {path.name for path in (tmp_path / "mpc").iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == {"mpc"}
    assert there == {
        *("mpc.h", "mpc.c", "mpc_data.h", "main.c", "loop.h", "Makefile", "README.md", "osqp"),
    }
    licence = (tmp_path / "mpc" / "osqp" / "LICENSE").read_text()
    assert "Apache License" in licence
    assert "measurement" in (tmp_path / "mpc" / "README.md").read_text()
