"""The package as a whole: what importing it costs, what it exports, which way it depends."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
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


# What each module may import of prefmpc: arrows point one way. See ARCHITECTURE.md.
HELPERS = {"_checks", "_pytree", "_random"}
LAYERS = {
    "_checks": set(),
    "_files": set(),
    "_pytree": set(),
    "_random": {"_checks"},
    "_lbfgsb": set(),
    "_units": set(),
    "systems": HELPERS | {"_units"},
    "sets": HELPERS,
    "trajectories": HELPERS | {"systems"},
    "pools": HELPERS | {"systems", "trajectories"},
    "preferences": HELPERS | {"trajectories"},
    "comparisons": HELPERS | {"_files", "trajectories", "preferences"},
    "models": HELPERS | {"systems", "sets", "trajectories", "pools"},
    "losses": HELPERS | {"trajectories", "comparisons"},
    "training": HELPERS | {"_lbfgsb", "trajectories", "models", "comparisons", "losses"},
    "priors": HELPERS,
    "_newton": HELPERS | {"_sharding", "trajectories", "comparisons", "models", "priors"},
    "_chart": HELPERS | {"_newton"},
    "uncertainty": {
        *HELPERS,
        *("_newton", "_chart", "trajectories", "comparisons", "models", "convex"),
    },
    "selection": HELPERS | {"_newton", "_chart", "comparisons", "convex", "losses", "priors"},
    "global_fit": HELPERS | {"_newton", "comparisons", "models", "losses"},
    "convex": {
        *HELPERS,
        *("_newton", "_sharding", "trajectories", "comparisons", "models", "losses", "priors"),
    },
    "_network": HELPERS | {"trajectories"},
    "networks": HELPERS | {"_network", "sets"},
    "mlp": HELPERS | {"_network"},
    "separable": HELPERS | {"trajectories"},
    "signals": HELPERS | {"trajectories", "models"},
    "nonlinear": HELPERS | {"systems"},
    "plants": HELPERS | {"nonlinear"},
    "early_stopping": HELPERS | {"trajectories", "models", "comparisons", "losses", "training"},
    "mpc": {
        *HELPERS,
        *("_units", "systems", "nonlinear", "sets", "trajectories", "models", "networks", "mpc"),
    },
    "_sharding": HELPERS,
    "loops": {
        *HELPERS,
        *("_sharding", "systems", "sets", "trajectories", "models", "mpc"),
    },
    "evaluation": {
        *HELPERS,
        *("systems", "trajectories", "preferences", "comparisons", "models", "mpc"),
    },
    "studies": {
        *HELPERS,
        "_files",
        *("systems", "sets", "trajectories", "pools", "preferences", "comparisons", "models"),
        *(
            "networks",
            "mlp",
            "separable",
            "signals",
            "nonlinear",
            "plants",
            "early_stopping",
            "training",
        ),
        *("priors", "convex", "uncertainty", "selection"),
        *("mpc", "evaluation", "loops", "studies"),
    },
    "plots": {"_checks"},
}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: path.name)
def test_imports_follow_the_layers(path):
    module = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if module == "__init__":
        return
    used = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path.name} imports by a relative path"
            names = [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        used |= {n.split(".")[1] for n in names if n.startswith("prefmpc.")}
        assert "prefmpc" not in names, f"{path.name} imports the whole package"
    assert used <= LAYERS[module]


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
