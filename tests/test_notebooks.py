"""The form of the notebooks: what nbval cannot see, since it only runs and compares cells."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
BOOK = ROOT / "book"
MAX_LINES = 25
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
X64 = re.compile(r"^jax\.config\.update\(['\"]jax_enable_x64['\"], True\)", re.MULTILINE)
REASON = re.compile(r"#\s*not compared:\s*\S+")
NBVAL_COMMENT = re.compile(
    r"^\s*#+\s*(NBVAL_|PYTEST_VALIDATE_IGNORE_OUTPUT)", re.IGNORECASE | re.MULTILINE
)
CHANGING = {
    "an object address": re.compile(r"\bat 0x[0-9a-fA-F]+"),
    "a timing": re.compile(r"Wall time|CPU times|per loop|\belapsed\b", re.IGNORECASE),
    "a progress bar": re.compile(r"\d+%\|| ?\d+it/s|\r(?!\n)"),
    "a traceback": re.compile(r"Traceback \(most recent call last\)"),
    "a path of this machine": re.compile(
        rf"(?<![\w.])/(?:home|root|tmp|usr|opt|Users)/\w|{re.escape(str(ROOT))}\b"
    ),
}


def find_notebooks() -> list[Path]:
    return sorted(p for p in BOOK.rglob("*.ipynb") if ".ipynb_checkpoints" not in p.parts)


def text_of(value: str | list[str]) -> str:
    return value if isinstance(value, str) else "".join(value)


def texts_of(output: dict[str, Any]) -> Iterator[str]:
    """All that an output shows as text (not images)."""
    if output["output_type"] == "stream":
        yield text_of(output["text"])
    elif output["output_type"] == "error":
        yield "\n".join([output["ename"], output["evalue"], *output["traceback"]])
    else:
        for kind, value in output["data"].items():
            if kind.startswith("text/") or kind == "image/svg+xml":
                yield text_of(value)


def check_code_cell(cell: dict[str, Any], count: int, name: str) -> Iterator[str]:
    source = text_of(cell["source"])
    tags = cell["metadata"].get("tags", [])
    outputs = cell["outputs"]

    if cell["execution_count"] != count:
        yield f"{name}: execution count {cell['execution_count']}, expected {count}"
    if len(source.splitlines()) > MAX_LINES:
        yield f"{name}: {len(source.splitlines())} lines, at most {MAX_LINES}"

    for tag in tags:
        if tag.startswith("nbval-") and tag != "nbval-ignore-output":
            yield f"{name}: the tag {tag} is not allowed"
    if NBVAL_COMMENT.search(source):
        yield f"{name}: say it with a tag, not with a comment for nbval"
    if "nbval-ignore-output" in tags:
        first = source.splitlines()[0] if source else ""
        if not REASON.match(first) and not str(cell["metadata"].get("not_compared", "")).strip():
            yield f"{name}: its output is not compared; begin it with '# not compared: <reason>'"

    errors = [output for output in outputs if output["output_type"] == "error"]
    if errors and "raises-exception" not in tags:
        yield f"{name}: stores an error ({errors[0]['ename']}) without the tag raises-exception"
    if "raises-exception" in tags and not errors:
        yield f"{name}: tagged raises-exception but stores no error"

    for output in outputs:
        if output["output_type"] == "stream" and output["name"] == "stderr":
            yield f"{name}: writes to stderr"
        if output["output_type"] == "execute_result" and output["execution_count"] != count:
            yield f"{name}: its result has the execution count {output['execution_count']}"
        for text in texts_of(output):
            for what, pattern in CHANGING.items():
                hidden = what == "a timing" and "nbval-ignore-output" in tags
                if pattern.search(text) and not hidden:
                    yield f"{name}: the output holds {what}"


def check_notebook(notebook: dict[str, Any]) -> list[str]:
    """All that is wrong with the form of a notebook, in words; empty if nothing is."""
    problems = []
    if notebook["metadata"] != METADATA:
        problems.append("metadata is more than the kernel's name: run `make notebooks`")
    cells = notebook["cells"]
    if [cell.get("id") for cell in cells] != [f"cell-{k}" for k in range(1, len(cells) + 1)]:
        problems.append("cell ids are not cell-1, cell-2, ...: run `make notebooks`")
    if not cells or cells[0]["cell_type"] != "markdown":
        problems.append("the first cell is not text")
    elif not text_of(cells[0]["source"]).lstrip().startswith(("# ", "(")):
        problems.append("the first cell has no title")

    code = [cell for cell in cells if cell["cell_type"] == "code"]
    if not code:
        problems.append("no code cell: make it a Markdown page")
    elif not X64.search(text_of(code[0]["source"])):
        problems.append('the first code cell lacks jax.config.update("jax_enable_x64", True)')
    for count, cell in enumerate(code, start=1):
        problems += check_code_cell(cell, count, f"code cell {count}")
        extra = set(cell["metadata"]) - {"tags", "mystnb", "not_compared"}
        if extra:
            problems.append(f"code cell {count}: metadata {sorted(extra)}: run `make notebooks`")
    return problems


# ---- the book ----


def test_there_are_notebooks() -> None:
    assert find_notebooks(), "book/ holds no notebook"


@pytest.mark.parametrize("path", find_notebooks(), ids=lambda p: str(p.relative_to(BOOK)))
def test_form(path: Path) -> None:
    problems = check_notebook(json.loads(path.read_text(encoding="utf-8")))
    assert not problems, "\n".join([str(path.relative_to(ROOT)), *problems])


def pages_in_contents(entry: dict[str, Any]) -> Iterator[str]:
    yield from (entry[key] for key in ("root", "file") if key in entry)
    for key in ("parts", "chapters", "sections"):
        for child in entry.get(key, []):
            yield from pages_in_contents(child)


def test_contents_and_pages_agree() -> None:
    listed = list(pages_in_contents(yaml.safe_load((ROOT / "_toc.yml").read_text())))
    assert len(listed) == len(set(listed)), "a page is listed twice in _toc.yml"
    markdown = [p for p in BOOK.rglob("*.md") if ".ipynb_checkpoints" not in p.parts]
    files = {str(p.relative_to(ROOT).with_suffix("")) for p in [*find_notebooks(), *markdown]}
    assert set(listed) - files == set(), "listed in _toc.yml, but no such page"
    assert files - set(listed) == set(), "pages that _toc.yml does not list"


# ---- the checks themselves: each broken notebook must be refused ----


def sound() -> dict[str, Any]:
    """A small notebook with nothing wrong."""

    def code(k: int, source: str, outputs: list[Any], tags: list[str] | None = None) -> Any:
        return {
            "cell_type": "code",
            "id": f"cell-{k}",
            "execution_count": k - 1,
            "metadata": {"tags": tags} if tags else {},
            "source": source,
            "outputs": outputs,
        }

    value = {
        "output_type": "execute_result",
        "execution_count": 2,
        "metadata": {},
        "data": {"text/plain": ["6"]},
    }
    error = {"output_type": "error", "ename": "ValueError", "evalue": "no", "traceback": []}
    return {
        "nbformat": 4,
        "nbformat_minor": 5,
        "metadata": copy.deepcopy(METADATA),
        "cells": [
            {"cell_type": "markdown", "id": "cell-1", "metadata": {}, "source": "# Title"},
            code(2, 'import jax\n\njax.config.update("jax_enable_x64", True)', []),
            code(3, "2 * 3", [value]),
            code(4, "raise ValueError('no')", [error], ["raises-exception"]),
            code(5, "# not compared: a time\nprint(1)", [], ["nbval-ignore-output"]),
        ],
    }


def test_sound_notebook_passes() -> None:
    assert check_notebook(sound()) == []


def stream(text: str, name: str = "stdout") -> dict[str, Any]:
    return {"output_type": "stream", "name": name, "text": [text]}


def strip(nb: dict[str, Any]) -> None:
    for cell in nb["cells"][1:]:
        cell.update(execution_count=None, outputs=[])


def hide_without_reason(nb: dict[str, Any]) -> None:
    nb["cells"][4]["source"] = "print(1)"


BREAKS: list[tuple[str, str, Callable[[dict[str, Any]], Any]]] = [
    ("stripped", "execution count None", strip),
    (
        "one cell stripped",
        "execution count None",
        lambda nb: nb["cells"][2].update(execution_count=None, outputs=[]),
    ),
    ("run out of order", "execution count 7", lambda nb: nb["cells"][2].update(execution_count=7)),
    (
        "result of another run",
        "its result has the execution count",
        lambda nb: nb["cells"][2]["outputs"][0].update(execution_count=9),
    ),
    ("error", "without the tag", lambda nb: nb["cells"][3].update(metadata={})),
    ("error expected, none", "stores no error", lambda nb: nb["cells"][3].update(outputs=[])),
    ("hidden without a reason", "not compared", hide_without_reason),
    ("skipped", "not allowed", lambda nb: nb["cells"][2].update(metadata={"tags": ["nbval-skip"]})),
    (
        "hidden by a comment",
        "say it with a tag",
        lambda nb: nb["cells"][2].update(source="# NBVAL_IGNORE_OUTPUT\n2 * 3"),
    ),
    ("long", "26 lines", lambda nb: nb["cells"][2].update(source="\n".join(["x = 1"] * 26))),
    ("float32", "jax_enable_x64", lambda nb: nb["cells"][1].update(source="import jax")),
    (
        "float32 again",
        "jax_enable_x64",
        lambda nb: nb["cells"][1].update(source='# jax.config.update("jax_enable_x64", True)'),
    ),
    ("ids", "cell ids", lambda nb: nb["cells"][2].update(id="a1b2")),
    ("metadata", "metadata is more", lambda nb: nb["metadata"].update(widgets={})),
    (
        "cell metadata",
        "metadata ['execution']",
        lambda nb: nb["cells"][2]["metadata"].update(execution={}),
    ),
    ("stderr", "stderr", lambda nb: nb["cells"][2].update(outputs=[stream("warning", "stderr")])),
    (
        "address",
        "an object address",
        lambda nb: nb["cells"][2].update(outputs=[stream("<object object at 0x7f1c>")]),
    ),
    ("timing", "a timing", lambda nb: nb["cells"][2].update(outputs=[stream("Wall time: 2 s")])),
    (
        "progress bar",
        "a progress bar",
        lambda nb: nb["cells"][2].update(outputs=[stream(" 40%|####      | 4/10")]),
    ),
    (
        "traceback",
        "a traceback",
        lambda nb: nb["cells"][2].update(outputs=[stream("Traceback (most recent call last):")]),
    ),
    ("path", "a path", lambda nb: nb["cells"][2].update(outputs=[stream("in /home/me/x.py")])),
    ("no code", "no code cell", lambda nb: nb.update(cells=nb["cells"][:1])),
    ("empty", "no code cell", lambda nb: nb.update(cells=[])),
    ("no title", "no title", lambda nb: nb["cells"][0].update(source="text")),
]


@pytest.mark.parametrize(("message", "damage"), [b[1:] for b in BREAKS], ids=[b[0] for b in BREAKS])
def test_broken_notebook_is_refused(message: str, damage: Callable[[dict[str, Any]], Any]) -> None:
    notebook = sound()
    damage(notebook)
    problems = check_notebook(notebook)
    assert any(message in problem for problem in problems), problems
