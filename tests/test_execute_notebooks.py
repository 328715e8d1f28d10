"""Executing a notebook: the same bytes twice, and never half a file."""

from __future__ import annotations

import base64
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "execute_notebooks.py"
DRAWS = """import matplotlib.pyplot as plt
import prefmpc
plt.plot([0, 1])
print("first"); print("second")
plt.show()"""


def write(path: Path, *sources: str) -> bytes:
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path.read_bytes()


def run(*paths: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, paths)]
    return subprocess.run(command, cwd=paths[0].parent, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str, bytes, bytes, bytes]]:
    """A sound and a failing notebook, executed together, twice."""
    folder = tmp_path_factory.mktemp("notebooks")
    good, bad = folder / "good.ipynb", folder / "bad.ipynb"
    write(good, DRAWS, "1 + 1")
    before = write(bad, "2 + 2", "raise ValueError('on purpose')")
    results = []
    for _ in range(2):
        done = run(good, bad)
        results.append((done.returncode, done.stderr, good.read_bytes(), bad.read_bytes(), before))
    assert sorted(p.name for p in folder.iterdir()) == ["bad.ipynb", "good.ipynb"]
    return results


def test_two_runs_give_the_same_bytes(runs: list[tuple[int, str, bytes, bytes, bytes]]) -> None:
    assert runs[0][2] == runs[1][2]


def test_failure_is_reported_and_leaves_the_old_file(
    runs: list[tuple[int, str, bytes, bytes, bytes]],
) -> None:
    for code, message, _, bad, before in runs:
        assert code == 1
        assert "on purpose" in message
        assert "bad.ipynb was not written" in message
        assert bad == before


def test_result_is_reduced(runs: list[tuple[int, str, bytes, bytes, bytes]]) -> None:
    notebook = nbformat.reads(runs[0][2].decode("utf-8"), as_version=4)
    first, second = notebook.cells
    assert [first.id, second.id] == ["cell-1", "cell-2"]
    assert [first.execution_count, second.execution_count] == [1, 2]
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert first.metadata == {}
    assert first.outputs[0].text == "first\nsecond\n"
    image = base64.b64decode(first.outputs[1].data["image/png"])
    assert image.startswith(b"\x89PNG")
    assert b"tEXt" not in image
    assert b"atplotlib" not in image
