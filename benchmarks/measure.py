"""Time, memory, the machine, and tables: what all parts of the benchmark share."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = (
    "jax",
    "numpy",
    "scipy",
    "daqp",
    "osqp",
    "piqp",
    "qpax",
    "cvxpy",
    "clarabel",
    "jaxopt",
    "casadi",
)
QUICK = 0.05
"""Work that takes less (in s) is done several times in each round."""


def seconds_of(work: Callable[[], Any]) -> float:
    """Return the wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def medians(works: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the median wall time of each work, after one call of each that is not counted.

    Round by round, so that whatever else the machine does meets all of them alike.
    """
    first = {name: seconds_of(work) for name, work in works.items()}
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            again = 5 if repeats > 1 and min([first[name], *times[name]]) < QUICK else 1
            times[name] += [seconds_of(work) for _ in range(again)]
    return {name: float(np.median(several)) for name, several in times.items()}


def median(work: Callable[[], Any], repeats: int) -> float:
    """Return the median wall time of one work, after one call that is not counted."""
    return medians({"": work}, repeats)[""]


def child(code: str, *arguments: Any) -> Any:
    """Run Python code in a process of its own, without JAX's cache of compiled programs.

    Returns what the last line that it prints says in JSON.
    """
    keep = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION_CACHE")}
    here = Path(__file__).resolve().parent
    path = [
        str(here),
        str(here.parent),
        str(here.parent / "book"),
        *filter(None, [keep.get("PYTHONPATH")]),
    ]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)],
        check=True,
        capture_output=True,
        text=True,
        env={**keep, "PYTHONPATH": os.pathsep.join(path)},
    )
    return json.loads(done.stdout.splitlines()[-1])


def peak_memory() -> float:
    """Return the most memory that this process has held so far, in MB."""
    # ru_maxrss would count what the parent held when it forked.
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def slope(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return the exponent p of values ~ sizesᵖ, by least squares over the upper half."""
    if len(sizes) < 2:
        return 0.0
    half = (len(sizes) - 1) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(values[half:]), 1)[0])


def machine() -> dict[str, Any]:
    """Say what this ran on."""
    name = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = lines[0].partition(":")[2].strip() if lines else name
    return {
        "cpu": name,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in PACKAGES},
    }


def milliseconds(value: float | None) -> str:
    """Return seconds as milliseconds with three digits, a dash for None."""
    if value is None:
        return "–"
    value *= 1e3
    if value < 1e-6:
        return "0"
    return f"{value:.{max(0, 2 - int(np.floor(np.log10(max(value, 1e-9)))))}f}"


def brief(value: Any) -> str:
    """Return a number with few digits, a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.0e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"
    return str(value)


def show(title: str, rows: Iterable[dict[str, Any]], columns: dict[str, str]) -> None:
    """Print rows as a table; ``columns`` maps keys to headings.

    Keys that end in "seconds" are printed in milliseconds.
    """
    body = [
        [milliseconds(row.get(k)) if k.endswith("seconds") else brief(row.get(k)) for k in columns]
        for row in rows
    ]
    heads = list(columns.values())
    widths = [max(len(line[i]) for line in [heads, *body]) for i in range(len(heads))]
    print(f"\n{title}")
    for line in [heads, *body]:
        cells = [line[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        print("  " + "  ".join(cells), flush=True)
