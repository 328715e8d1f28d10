"""Write book/_static/readme.png: the last figure of the teaser, taken from its stored outputs."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path

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
    target = ROOT / "book/_static/readme.png"
    temporary = target.with_suffix(".part")
    temporary.write_bytes(base64.b64decode("".join(pictures[-1])))
    os.replace(temporary, target)


if __name__ == "__main__":
    main()
