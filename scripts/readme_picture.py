"""Write book/_static/readme.png: the last figure of the teaser, taken from its stored outputs."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path

# One module of the library without the rest: JAX takes a second.
sys.path.append(str(Path(__file__).resolve().parents[1] / "prefmpc"))

from _files import atomic_write

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Copy the picture; the notebook must have been executed."""
    notebook = json.loads((ROOT / "book/teaser.ipynb").read_text(encoding="utf-8"))
    pictures = [
        output["data"]["image/png"]
        for cell in notebook["cells"]
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    with atomic_write(ROOT / "book/_static/readme.png", overwrite=True) as file:
        file.write(base64.b64decode("".join(pictures[-1])))


if __name__ == "__main__":
    main()
