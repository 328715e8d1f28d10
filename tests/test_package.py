"""The package as a whole: what importing it costs, what it exports, which way it depends."""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import os
import pkgutil
import re
import subprocess
import sys
import tokenize
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import prefmpc

LINES, CODE = 19_800, 13_000
"""The library has at most so many lines, and so many without docstrings, comments and blanks."""

FILE, FUNCTION, HOUR = 350, 60, 3_500
"""Lines at most of a file, of a function without its docstring, and of the one-hour read."""

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
    rooms = [importlib.import_module(f"prefmpc.{room}") for room in ROOMS if room != "plots"]
    listed = [name for room in rooms for name in room.__all__]
    assert sorted(listed) == prefmpc.__all__
    assert all(room.__all__ == sorted(room.__all__) for room in rooms)


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


EACH_FILE = pytest.mark.parametrize(
    "path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT))
)


@EACH_FILE
def test_imports_follow_the_rooms(path):
    room = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if room == "__init__":
        return
    used = {names[0] for names in imported(path)} - HELPERS
    assert used <= (set() if room in HELPERS else ROOMS[room] | {room})


def test_between_plants_and_the_package_are_four_rooms_at_most():
    graph = {}
    for path in ROOT.rglob("*.py"):
        room = path.relative_to(ROOT).parts[0].removesuffix(".py")
        graph.setdefault(room, set()).update(names[0] for names in imported(path))
    depth = {}
    for room in TopologicalSorter({a: b - {a} for a, b in graph.items()}).static_order():
        if room not in HELPERS:
            depth[room] = 1 + max((depth[used] for used in graph[room] & depth.keys()), default=-1)
    assert depth["systems"] == 0
    assert depth["__init__"] - 1 <= 4, depth


SOLVERS = {
    *("cvxpy", "osqp", "clarabel", "scipy.optimize", "jaxopt", "optax", "control"),
    *("ipyopt", "daqp", "piqp", "qpax", "casadi"),
}


@EACH_FILE
def test_a_module_knows_one_solver_at_most(path):
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    used = {one for one in SOLVERS for name in names if f"{name}.".startswith(f"{one}.")}
    assert len(used) <= 1, used


def documented(tree):
    """Return the functions, classes and the module that have a docstring, each with that."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(tree) if isinstance(node, kinds)]
    return {node: node.body[0] for node in nodes if ast.get_docstring(node, clean=False)}


def height(node):
    return node.end_lineno - node.lineno + 1


@EACH_FILE
def test_files_and_functions_are_short(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= FILE
    tree = ast.parse(text)
    docs = documented(tree)
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            lines = height(node) - (height(docs[node]) if node in docs else 0)
            assert lines <= FUNCTION, f"{node.name} has {lines} lines"


def code_lines(text):
    """Count the lines that hold code: no docstring, comment or blank."""
    lines = set()
    nothing = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in nothing | {tokenize.ENDMARKER}:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for doc in documented(ast.parse(text)).values():
        lines -= set(range(doc.lineno, doc.end_lineno + 1))
    return len(lines)


def test_the_library_stays_small():
    texts = [path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")]
    assert sum(len(text.splitlines()) for text in texts) <= LINES
    assert sum(map(code_lines, texts)) <= CODE


def test_the_paper_alone_is_read_in_an_hour():
    """CONTRIBUTING lists the files of that read, and how many lines they have in all."""
    guide = (ROOT.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = guide.split("## The one-hour read")[1].split("\n## ")[0]
    files = [ROOT / name for name in re.findall(r"`(\w+/?\w+\.py)`", section)]
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
    (said,) = re.findall(r"about ([\d,]+) lines", section)
    assert len(files) == len(set(files)) > 10
    assert abs(lines - int(said.replace(",", ""))) <= 100, lines
    assert lines <= HOUR


def test_the_wheel_holds_the_library_and_no_studies():
    listed = run(
        "from setuptools import Distribution\n"
        "plan = Distribution({'script_name': 'setup.py'})\n"
        "plan.parse_config_files()\n"
        "command = plan.get_command_obj('build_py')\n"
        "command.ensure_finalized()\n"
        "print(*command.get_outputs(include_bytecode=False), sep='\\n')"
    )
    built = {str(Path(line).relative_to("build/lib")) for line in listed.split()}
    there = {str(path.relative_to(ROOT.parent)) for path in ROOT.rglob("*.py")}
    scripts = {str(path.relative_to(ROOT.parent)) for path in ROOT.rglob("static/ask/*.*")}
    in_c = {str(path.relative_to(ROOT.parent)) for path in ROOT.glob("mpc/static/*")}
    assert built == there | scripts | in_c | {"prefmpc/py.typed"}
    assert len(scripts) > 15


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
        "Agreement",
        "CExport",
        "Camps",
        "ChangeTest",
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
        "PeoplePosterior",
        "PeopleResult",
        "Posterior",
        "PriorChoice",
        "Question",
        "Shared",
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
