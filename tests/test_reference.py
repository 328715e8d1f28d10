"""The pages of reference: every public name stands on one of them, with an example that holds."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest

import prefmpc
from prefmpc import plots

FOLDER = Path(__file__).parents[1] / "book" / "reference" / "api"
PAGES = {path.stem: path.read_text("utf-8") for path in sorted(FOLDER.glob("*.md"))}
PUBLIC = {name: page for name, page in PAGES.items() if name != "studies"}
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
PRINTED = re.compile(r"^ *print\(.*\)  # (.*)$", re.M)
LISTED = re.compile(r"^\| \[`([\w.]+)`\]", re.M)
SECTION = re.compile(r"^## `([\w.]+)`\n\n```python\n", re.M)
# What a page tells of a room's inside has its longer name.
DOCUMENTED = re.compile(r"^\.\. (?:auto|py:)\w+:: prefmpc\.((?:plots\.)?\w+)$", re.M)


def test_every_public_name_is_listed_shown_and_documented_once():
    drawn = [name for name, value in vars(plots).items() if inspect.getmodule(value) is plots]
    names = {*prefmpc.__all__, *(f"plots.{name}" for name in drawn if not name.startswith("_"))}
    for pattern in (LISTED, SECTION, DOCUMENTED):
        found = [name for page in PUBLIC.values() for name in pattern.findall(page)]
        assert sorted(found) == sorted(names), pattern.pattern
    for page in PUBLIC.values():
        assert LISTED.findall(page) == SECTION.findall(page) == DOCUMENTED.findall(page)


@pytest.mark.parametrize("name", PUBLIC)
def test_every_example_holds_on_its_own(name):
    """It needs the first block of its page alone, and prints what stands beside ``print``."""
    setup, *examples = EXAMPLE.findall(PUBLIC[name])
    matplotlib.use("Agg")
    ready: dict[str, object] = {}
    with matplotlib.rc_context():
        exec(setup, ready)
        for example in examples:
            printed: list[str] = []

            def record(*values, into=printed):
                into.append(" ".join(map(str, values)))

            exec(compile(example, f"{name}:\n{example}", "exec"), {**ready, "print": record})
            assert printed == PRINTED.findall(example), example


def test_the_readme_s_examples_run_one_after_the_other():
    page = (FOLDER.parents[2] / "README.md").read_text("utf-8")
    names: dict[str, Any] = {}
    for example in EXAMPLE.findall(page):
        exec(compile(example, f"README.md:\n{example}", "exec"), names)
    assert names["interview"].finished() is not None
    assert names["sigma"].Q[0, 0] > 0
