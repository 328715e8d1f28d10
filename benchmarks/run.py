"""``make bench``: all measurements, as tables and as one JSON file.

``--mini`` runs a miniature of everything but what needs a process of its own: for correctness,
not for times. Every ratio is between two numbers of one run.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from pathlib import Path

# The library of this checkout, whatever is installed; small matrices, for which threads only wait.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "book"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
from measure import machine

from prefmpc._files import atomic_write

PARTS = ("loops", "constrained", "learning", "tables", "growth", "limit", "solvers", "nonlinear")


def main() -> None:
    """Run the parts one after the other, and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--mini", action="store_true", help="tiny sizes, once")
    out = Path(__file__).resolve().parent / "results.json"
    parser.add_argument("--out", type=Path, default=out, help="the JSON file")
    options = parser.parse_args()
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    jax.config.update("jax_enable_x64", True)
    results = {"machine": machine(), "mini": options.mini, "seconds": {}}
    for name in options.parts or PARTS:
        print(f"\n======== {name}", flush=True)
        began = time.perf_counter()
        results[name] = importlib.import_module(name).run(mini=options.mini)
        results["seconds"][name] = round(time.perf_counter() - began, 1)
        print(f"\n({name}: {results['seconds'][name]:.0f} s)", flush=True)
    text = json.dumps(results, indent=1, ensure_ascii=False) + "\n"
    with atomic_write(options.out, overwrite=True) as file:
        file.write(text.encode())
    print(f"\nwritten: {options.out}")


if __name__ == "__main__":
    main()
