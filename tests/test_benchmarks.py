"""The benchmarks in miniature: do all solvers mean the same problems, and is all of it stored?"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PARTS = {"loops", "constrained", "learning", "tables", "growth", "limit", "solvers", "nonlinear"}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "results.json"
    script = ROOT / "benchmarks" / "run.py"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", script, "--mini", "--out", out],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "× ours" in done.stdout
    return json.loads(out.read_text())


def test_the_file_has_the_documented_keys(results):
    assert set(results) == {"machine", "mini", "seconds"} | PARTS
    assert set(results["seconds"]) == PARTS
    assert set(results["machine"]) == {"cpu", "cores", "system", "python", "versions"}
    assert {"jax", "numpy", "daqp", "osqp", "piqp", "qpax"} <= set(results["machine"]["versions"])
    for row in results["loops"]["one_controller"]["rows"]:
        wanted = {"name", "seconds", "times_ours", "largest_error", "loops_run"}
        assert wanted <= set(row)


@pytest.mark.parametrize("table", ["one_controller", "many_controllers", "single"])
def test_all_solvers_run_the_same_closed_loops(results, table):
    for row in results["loops"][table]["rows"]:
        assert row["largest_error"] < (1e-3 if row["name"] == "qpax" else 3e-6), row
        assert row["name"] == "qpax" or row.get("failed_elsewhere", 0) == 0, row


def test_with_limits_on_the_states_too(results):
    table = results["constrained"]["with_times"]
    assert table["active_share"] > 0.2
    for row in table["rows"]:
        assert row["largest_error"] < 3e-6, row
        assert row["status_differs"] == 0, row


def test_random_programs_have_the_verdicts_of_clarabel(results):
    found = results["solvers"]["programs"]
    assert {row["ours"] for row in found["rows"]} == {"solved", "infeasible"}
    assert all(row["ours"] == row["Clarabel"] for row in found["rows"])
    assert found["finite"]
    assert found["largest_difference"] < 1e-6
    found = results["solvers"]["mpc"]
    assert found["share_solved"] == 1
    assert found["sound"]
    assert found["largest_difference"] < 1e-6


def test_learners_of_one_problem_reach_one_minimum(results):
    rows = results["learning"]["by_size"]["rows"]
    convex = [row for row in rows if row["problem"] == "MAP"]
    assert len(convex) == 3
    for row in convex:
        assert row["excess"] < 1e-6, row
    # From random starts the recipe stops anywhere above its one minimum, never below.
    recipe = {row["name"]: row for row in rows if row["problem"] == "recipe"}
    assert recipe["fit_global"]["excess"] == pytest.approx(0, abs=1e-6)
    together, apart = (
        recipe[name]["objective"]
        for name in ("fit, 20 restarts at once", "jaxopt, 20 restarts one by one")
    )
    assert together == pytest.approx(apart, rel=1e-6)


def test_growth_and_limit_ran(results):
    assert results["growth"]["m"]["rows"][0]["largest_error"] < 1e-6
    assert all(row["times_floor"] > 0 for row in results["limit"]["rows"])
    assert results["limit"]["rates"]["flops_small"] > 0


def test_controllers_agree(results):
    assert results["solvers"]["agreement"]["largest_difference"]["u"] < 1e-5
    assert results["nonlinear"]["agreement"]["rows"][0]["difference"] < 1e-5
