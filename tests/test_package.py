"""The package as a whole: what importing it costs, what it exports, which way it depends."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import prefmpc

ROOT = Path(prefmpc.__file__).resolve().parent
TESTS = Path(__file__).resolve().parent
MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages([str(ROOT)], "prefmpc.")
    if "_checks" not in info.name
)


def run(code: str) -> str:
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_ENABLE_X64", None)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=environment,
        cwd=ROOT.parent,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_prefmpc_leaves_the_heavy_packages_alone():
    heavy = {"matplotlib", "cvxpy", "control", "osqp", "tqdm", "pandas"}
    loaded = run("import sys, prefmpc; print(*{name.split('.')[0] for name in sys.modules})")
    assert "jax" in loaded.split()
    assert heavy.isdisjoint(loaded.split())


WITHOUT_X64 = """
import jax, numpy as np, prefmpc as p
key = jax.random.key(0)
one = np.ones((1, 1))
entries = {
    "LinearSystem": lambda: p.LinearSystem(one, one, dt=1),
    "oscillating_masses": lambda: p.oscillating_masses(),
    "Polyhedron": lambda: p.Polyhedron(one, [1]),
    "Trajectory": lambda: p.Trajectory(np.ones((2, 1)), one),
    "QuadraticCost": lambda: p.QuadraticCost(one, one),
    "QuadraticCost.random": lambda: p.QuadraticCost.random(1, 1, key=key),
    "QuadraticPreference": lambda: p.QuadraticPreference(one, one),
    "random_states": lambda: p.random_states([1.0], key=key),
    "random_weights": lambda: p.random_weights(1, 1, key=key),
    "settling_time": lambda: p.settling_time(one),
    "from_arrays": lambda: p.Comparisons.from_arrays(one, one, one, one, [1]),
    "fit": lambda: p.fit(None, key=key),
}
for name, entry in entries.items():
    try:
        entry()
    except ValueError as error:
        assert 'jax.config.update("jax_enable_x64", True)' in str(error), (name, error)
    else:
        raise AssertionError(name + " computed in float32")
print(len(entries), jax.config.jax_enable_x64)
"""


def test_without_float64_every_door_says_what_to_call():
    assert run(WITHOUT_X64).split() == ["12", "False"]


def test_exported_names_are_sorted_and_complete():
    assert prefmpc.__all__ == sorted(prefmpc.__all__)
    found = {
        name
        for name, value in vars(prefmpc).items()
        if not name.startswith("_") and not inspect.ismodule(value)
    }
    assert found - {"annotations"} == set(prefmpc.__all__)


@pytest.mark.parametrize("name", ["prefmpc", *MODULES])
def test_everything_public_has_a_docstring(name):
    module = importlib.import_module(name)
    assert module.__doc__
    for label, value in vars(module).items():
        if label.startswith("_") or getattr(value, "__module__", None) != name:
            continue
        if inspect.isfunction(value) or inspect.isclass(value) or hasattr(value, "__wrapped__"):
            assert value.__doc__, label
        if inspect.isclass(value):
            for method, body in vars(value).items():
                body = getattr(body, "__func__", getattr(body, "fget", body))
                if not method.startswith("_") and inspect.isfunction(body):
                    assert body.__doc__, f"{label}.{method}"


# What each room may import of the others: arrows point one way. Small helpers and what serves all
# stand at the top.
ROOMS = {
    "systems": set(),
    "preferences": {"systems"},
    "models": {"systems", "preferences"},
    "learning": {"preferences", "models"},
    "mpc": {"systems", "preferences", "models"},
    "asking": {"systems", "preferences", "models", "learning", "mpc"},
    "evaluation": {"systems", "preferences", "models", "mpc"},
    "plots": set(),
}
HELPERS = {path.stem for path in ROOT.glob("_*.py")} - {"__init__"}


def imported(path):
    """Return the modules of prefmpc that a file imports, as tuples."""
    used = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path.name} imports by a relative path"
            names = [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        assert "prefmpc" not in names, f"{path.name} imports the whole package"
        assert "studies" not in {n.split(".")[0] for n in names}, "the book is not the library's"
        used |= {tuple(n.split(".")[1:]) for n in names if n.startswith("prefmpc.")}
    return used


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: path.name)
def test_imports_follow_the_rooms(path):
    room = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if room == "__init__":
        return
    used = {names[0] for names in imported(path)} - HELPERS
    assert used <= (set() if room in HELPERS else ROOMS[room] | {room})


def test_no_module_depends_on_itself():
    files = {path.relative_to(ROOT).with_suffix("").parts: path for path in ROOT.rglob("*.py")}
    graph = {}
    for names, path in files.items():
        if names[-1] != "__init__":
            graph[names] = {used for used in imported(path) if used in files}
    tuple(TopologicalSorter(graph).static_order())


# These are made by the library, or hold no input of their own.
MADE = {
    *(
        "ClosedLoops",
        "CostModel",
        "FitError",
        "FitResult",
        "GlobalResult",
        "Interval",
        "MPCError",
        "MPCSolution",
        "MapResult",
        "Moments",
        "NetworkFit",
        "Posterior",
        "PriorChoice",
        "Question",
        "StabilityCheck",
        "SteadyState",
        "TerminalIngredients",
        "WinRate",
    ),
}
TYPES = {"Criterion", "Preference"}


def test_every_name_that_takes_input_is_tested_with_bad_input():
    tried = set()
    for path in TESTS.glob("test_*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and "bad_input" in node.name:
                tried |= {
                    n.id
                    for d in node.decorator_list
                    for n in ast.walk(d)
                    if isinstance(n, ast.Name)
                }
    # Called through a shorthand of their test module.
    tried |= {"closed_loops"} if "loops" in tried else set()
    assert set(prefmpc.__all__) - MADE - TYPES <= tried
