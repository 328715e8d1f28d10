"""Execute the book's notebooks in place, so that two runs give the same bytes.

    python scripts/execute_notebooks.py                    all notebooks under book/
    python scripts/execute_notebooks.py book/teaser.ipynb  only these

A notebook whose cell raises an error is not written: the old file stays as it was.
"""

from __future__ import annotations

import argparse
import base64
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError
from nbformat import NotebookNode

# One module of the library without the rest: JAX takes a second, and does not like the forks below.
sys.path.append(str(Path(__file__).resolve().parents[1] / "prefmpc"))

from _files import atomic_write

ROOT = Path(__file__).resolve().parent.parent
BOOK = ROOT / "book"

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
CELL_METADATA = ("tags", "mystnb", "not_compared")
PNG_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"pHYs", b"IDAT", b"IEND")


def set_environment() -> None:
    """What the kernels inherit: the library's folder, the processor, no dates in figures."""
    path = [str(ROOT), str(ROOT / "book"), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(path)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["SOURCE_DATE_EPOCH"] = "0"


def plain_png(encoded: str) -> str:
    """A base64 PNG without its text chunks (the name and version of the program)."""
    data = base64.b64decode(encoded)
    parts, start = [data[:8]], 8
    while start < len(data):
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        if data[start + 4 : start + 8] in PNG_CHUNKS:
            parts.append(data[start:end])
        start = end
    return base64.b64encode(b"".join(parts)).decode("ascii")


def prepare(notebook: NotebookNode) -> NotebookNode:
    """Drop empty cells and trailing blanks; number the cells."""
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    notebook.cells = [cell for cell in notebook.cells if cell.source.strip()]
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number}"
        cell.source = "\n".join(line.rstrip() for line in cell.source.strip("\n").split("\n"))
        cell.metadata = nbformat.from_dict(
            {key: cell.metadata[key] for key in CELL_METADATA if key in cell.metadata}
        )
    notebook.metadata = nbformat.from_dict(METADATA)
    return notebook


def clean(notebook: NotebookNode) -> NotebookNode:
    """Remove from the executed notebook what depends on the machine or on the moment."""
    notebook.metadata = nbformat.from_dict(METADATA)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if output.output_type == "error":  # only cells tagged raises-exception have one
                output.traceback = [f"{output.ename}: {output.evalue}"]
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = plain_png(data["image/png"])
            # A widget lives in its kernel: its picture stays, and no page waits for the network.
            data.pop("application/vnd.jupyter.widget-view+json", None)
    return notebook


def execute(path: Path, timeout: int) -> str | None:
    """Execute one notebook and replace its file; return what went wrong, or None."""
    notebook = prepare(nbformat.read(path, as_version=4))
    client = NotebookClient(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
        record_timing=False,
        store_widget_state=False,
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],
    )
    try:
        client.execute()
    except (CellControlSignal, DeadKernelError) as error:
        return str(error)
    clean(notebook)
    nbformat.validate(notebook)
    with atomic_write(path, overwrite=True) as file:
        file.write((nbformat.writes(notebook).rstrip("\n") + "\n").encode())
    return None


def timed(path: Path, timeout: int) -> tuple[Path, float, str | None]:
    start = time.perf_counter()
    problem = execute(path, timeout)
    return path, time.perf_counter() - start, problem


def find_notebooks() -> list[Path]:
    """All notebooks of the book, without editors' copies."""
    return sorted(p for p in BOOK.rglob("*.ipynb") if ".ipynb_checkpoints" not in p.parts)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all under book/")
    parser.add_argument("-j", "--jobs", type=int, default=min(4, os.cpu_count() or 1))
    parser.add_argument("--timeout", type=int, default=120, help="seconds for one cell")
    options = parser.parse_args()

    paths = [p.resolve() for p in options.notebooks] or find_notebooks()
    if not paths:
        print("error: no notebook found under book/", file=sys.stderr)
        return 1
    set_environment()
    failed = 0
    with ProcessPoolExecutor(max_workers=min(options.jobs, len(paths))) as pool:
        jobs = [pool.submit(timed, path, options.timeout) for path in paths]
        for job in jobs:
            path, seconds, problem = job.result()
            name = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
            print(f"{'FAILED' if problem else 'ok'} {name} ({seconds:.1f} s)", flush=True)
            if problem:
                failed += 1
                print(f"{problem}\n{name} was not written.", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
