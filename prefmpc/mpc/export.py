"""A controller for a machine: C without allocation, by OSQP's own generator."""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike

from prefmpc._checks import choice, finite_array, flag, instance, positive_int, shaped, share
from prefmpc.mpc._affine import AffineProgram
from prefmpc.mpc._c_files import constants, filled, recording, sizes, told
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.steady import SteadyState, check_reference

Precision = Literal["double", "float"]

WELL = 1e4
"""A condensed problem with a condition up to this keeps its digits, and the solver its pace."""

PENALTIES = 10.0 ** np.arange(-1, 2.25, 0.5)
"""What is tried for the solver's ρ: with a matrix that is factored in advance it is fixed."""

TRIED, ENOUGH = 10, 1000
"""So many states say which ρ is best, within so many iterations."""

COUNT = 100
"""Random states."""


@dataclasses.dataclass(frozen=True)
class CExport:
    """What `export_c` has written.

    Attributes
    ----------
    folder : Path
    form : str
        "condensed" or "sparse".
    variables, rows : int
    condition : float
        Of the condensed problem, whether that was taken or not.
    rho : float
        The solver's penalty parameter.
    worst_iterations : int
        The most that one of the states took from a cold start: measured, with float64, and no
        bound. ``max_iterations`` is one.
    unsolved : int
        How many of the states were not solved within these iterations.
    """

    folder: Path
    form: str
    variables: int
    rows: int
    condition: float
    rho: float
    worst_iterations: int
    unsolved: int


def export_c(
    controller: LinearMPC,
    folder: str | os.PathLike[str],
    *,
    precision: Precision = "double",
    tol: float | None = None,
    max_iterations: int = 1000,
    states: ArrayLike | None = None,
    reference: SteadyState | None = None,
    disturbance: bool = False,
    steps: int = 1000,
    overwrite: bool = False,
) -> CExport:
    """Write a controller as a C99 library: `mpc_init`, `mpc_step`, nothing allocated.

    The folder then holds ``mpc.h`` (what to call, and what a status means), ``mpc.c``, OSQP's
    generated sources with their licence, a ``main.c`` that replays closed loops recorded here and
    prints the differences, a ``Makefile`` and a ``README.md``. The problem is written without the
    states where that is smaller and well conditioned. Whatever the solver says, ``mpc_step``
    judges its answer by optimality conditions that it computes, and writes no input otherwise.

    Parameters
    ----------
    controller : LinearMPC
    folder : path
        New, or with ``overwrite`` one to be replaced.
    precision : "double" or "float"
    tol : float, optional
        What counts as solved: the largest violation of the optimality conditions relative to the
        size of their terms, at least 1; below 1. Default: 1e-6 in double, 1e-4 in float.
    max_iterations : int
        The largest number of iterations of a step.
    states : array (m, nx), optional
        Where the solver is measured and the loops begin. Default: random ones, for which the
        unconstrained controller asks for 0.1 to 3 times what the inputs can do.
    reference : SteadyState, optional
        The set point of the recorded loops; the library takes any.
    disturbance : bool
        Whether the library takes a disturbance d, held over the horizon, x⁺ = A x + B u + d.
    steps : int
        Of all recorded loops together.
    overwrite : bool
        Whether a folder that is there may be replaced.

    Raises
    ------
    ValueError
        If an argument is out of range, or no state has a solution.
    FileExistsError
        If the folder is there and ``overwrite`` is False.
    """
    instance("controller", controller, LinearMPC)
    choice("precision", precision, get_args(Precision))
    tol = (1e-6 if precision == "double" else 1e-4) if tol is None else share("tol", tol)
    max_iterations = positive_int("max_iterations", max_iterations)
    steps, overwrite = positive_int("steps", steps), flag("overwrite", overwrite)
    disturbance = flag("disturbance", disturbance)
    target = Path(folder)
    if target.exists() and not overwrite:
        raise FileExistsError(f"{target} exists; pass overwrite=True to replace it")
    if reference is not None:
        check_reference(reference, controller.system, controller._hard, controller._ingredients)
    sparse = AffineProgram.of(controller, disturbance=disturbance)
    condensed = sparse.condensed()
    given = _states(controller, condensed, states)
    loop = recording(controller, given, reference, steps)
    form, program = _smaller(sparse.merged(), condensed.merged())
    settings = _settings(tol, max_iterations)
    rho, iterations = _penalty(program, settings, given, reference)
    unsolved = int((iterations >= max_iterations).sum())
    done = CExport(
        target,
        form,
        program.rows.shape[1],
        program.rows.shape[0],
        condensed.condition,
        rho,
        int(iterations.max()),
        unsolved,
    )
    values = sizes(controller, precision, tol, max_iterations, disturbance)
    texts = {
        "mpc_data.h": constants(controller, program, precision, disturbance),
        "loop.h": loop.text(controller, reference, max(1e-6, 1e3 * tol)),
        "README.md": told(done, values, len(given)),
        **{name: filled(name, values) for name in ("mpc.h", "mpc.c", "main.c", "Makefile")},
    }
    settings["rho"] = rho
    _write(target, texts, lambda folder: _generate(program, settings, folder, precision))
    return done


def _write(target: Path, texts: dict[str, str], generate: Callable[[Path], None]) -> None:
    """Make a folder beside the target, and rename it: what is there is whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    try:
        for name, text in texts.items():
            (made / name).write_text(text, "utf-8")
        generate(made / "osqp")
        if target.exists():
            shutil.rmtree(target)
        made.chmod(0o755)
        made.rename(target)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _settings(tol: float, max_iterations: int) -> dict[str, Any]:
    # Four times finer than what `mpc_step` asks for: OSQP's two tolerances and its split add up.
    return {
        **{"eps_abs": tol / 4, "eps_rel": tol / 4, "eps_prim_inf": max(1e-5, tol / 10)},
        **{"max_iter": max_iterations, "check_termination": 5, "check_dualgap": False},
        **{"scaling": 0, "adaptive_rho": False, "polishing": False, "verbose": False},
    }


def _solver(program: AffineProgram, settings: dict[str, Any]) -> Any:
    import osqp

    solver = osqp.OSQP()
    P, rows = (sp.csc_matrix(part) for part in (sp.triu(program.P), program.rows))
    lower, upper = (np.clip(bound, -1e30, 1e30) for bound in (program.lower, program.upper))
    solver.setup(P, program.q, rows, lower, upper, **settings)
    return solver


def _generate(program: AffineProgram, settings: dict[str, Any], folder: Path, kind: str) -> None:
    solver = _solver(program, settings)
    options = {"parameters": "vectors", "include_codegen_src": True, "compile": False}
    solver.codegen(str(folder), use_float=kind == "float", prefix="mpc_osqp_", **options)
    for name in ("emosqp.c", "bindings.cpp", "setup.py", "CMakeLists.txt", "Makefile"):
        (folder / name).unlink(missing_ok=True)  # of OSQP's own example
    (folder / "LICENSE").write_text(_licence(), "utf-8")


def _licence() -> str:
    """Return the text of Apache 2.0 that came with OSQP: its generator leaves it out."""
    for path in metadata.distribution("osqp").files or []:
        if path.name.startswith("LICENSE"):
            return path.read_text("utf-8")
    return (
        "OSQP, Copyright its authors, is licensed under the Apache License, Version 2.0;\n"
        "you may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0\n"
    )


def _states(
    controller: LinearMPC, condensed: AffineProgram, states: ArrayLike | None
) -> np.ndarray:
    """Return the states that were given, or random ones; those for which there is a solution."""
    nx = controller.system.nx
    if states is not None:
        given = np.asarray(shaped("states", finite_array("states", states, ndim=2), (None, nx)))
    else:
        given = _random(controller, condensed)
    solved = [x for x in given if controller.solve(x).status == "solved"]
    if not solved:
        raise ValueError(f"states must have a solution, got {len(given)} for which there is none")
    return np.array(solved)


def _random(controller: LinearMPC, condensed: AffineProgram) -> np.ndarray:
    system, rng = controller.system, np.random.default_rng(0)
    x = rng.normal(size=(COUNT, system.nx)) * controller._program.dx
    plan = -np.linalg.lstsq(condensed.P.toarray(), condensed.F[:, : system.nx] @ x.T)[0]
    asked = np.abs(condensed.S @ plan + condensed.T[:, : system.nx] @ x.T).T
    most = np.maximum(np.abs(system.u_min), np.abs(system.u_max))
    known = np.isfinite(most) & (most > 0)
    share = (asked[:, known] / most[known]).max(axis=1, initial=0.0)
    x *= (10 ** rng.uniform(-1, 0.5, COUNT) / np.where(share > 0, share, 1.0))[:, None]
    for _ in range(10):  # towards the origin, until there is a solution
        far = [i for i, start in enumerate(x) if controller.solve(start).status != "solved"]
        x[far] /= 2
    return x


def _smaller(sparse: AffineProgram, condensed: AffineProgram) -> tuple[str, AffineProgram]:
    """Return the form that takes less memory, of those that are well conditioned."""
    if not condensed.condition <= WELL:
        return "sparse", sparse
    lines = []
    for program in (sparse, condensed):
        with tempfile.TemporaryDirectory() as folder:
            _generate(program, _settings(1e-6, 10), Path(folder, "osqp"), "double")
            # A line a number, and our own of the affine part.
            text = Path(folder, "osqp", "mpc_osqp_workspace.c").read_text()
            lines.append(len(text.splitlines()))
        lines[-1] += int(2 * np.count_nonzero(program.E) + 2 * np.count_nonzero(program.F))
    return ("condensed", condensed) if lines[1] <= lines[0] else ("sparse", sparse)


def _penalty(
    program: AffineProgram,
    settings: dict[str, Any],
    states: np.ndarray,
    reference: SteadyState | None,
) -> tuple[float, np.ndarray]:
    """Return the ρ with the fewest iterations at worst, and the iterations of all states."""

    def iterations(rho: float, some: np.ndarray, most: int) -> np.ndarray:
        solver, out = _solver(program, {**settings, "rho": rho, "max_iter": most}), []
        for x in some:
            p = np.zeros(program.F.shape[1])
            p[: len(x)] = x
            if reference is not None:
                held = np.concatenate([reference.x, reference.u])
                p[len(x) : len(x) + len(held)] = held
            q, lower, upper = program.at(p)
            solver.update(q=q, l=np.clip(lower, -1e30, 1e30), u=np.clip(upper, -1e30, 1e30))
            solver.warm_start(x=np.zeros(len(q)), y=np.zeros(len(lower)))
            out.append(solver.solve(raise_error=False).info.iter)
        return np.array(out)

    def worst(rho: float) -> tuple[int, int]:
        counts = iterations(rho, states[:TRIED], min(ENOUGH, settings["max_iter"]))
        return int(counts.max()), int(counts.sum())

    best = float(min(PENALTIES, key=worst))
    return best, iterations(best, states, settings["max_iter"])
