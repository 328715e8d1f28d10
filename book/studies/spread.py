"""Results of many draws, kept in small JSON files that the book reads."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from prefmpc._files import atomic_write


def write_spread(path: Path, head: Mapping[str, Any], draws: Sequence[Mapping[str, Any]]) -> None:
    """Write ``head`` and the named arrays of every draw, a line each, rounded to 4 decimals,
    small ones to 3 digits.

    NaN is written as null and infinity as the text "inf". An interrupted write leaves an old file
    whole.
    """

    def plain(value: Any) -> Any:
        if np.ndim(value):
            return [plain(part) for part in value]
        if np.isnan(value):
            return None
        if not np.isfinite(value):
            return str(value)
        return round(float(value), 4) if abs(value) >= 0.01 else float(f"{value:.3g}")

    rows = [
        json.dumps({k: plain(np.asarray(v)) for k, v in draw.items()}, ensure_ascii=False)
        for draw in draws
    ]
    text = json.dumps({**head, "draws": []}, ensure_ascii=False)
    text = text.removesuffix("]}") + "\n" + ",\n".join(rows) + "\n]}\n"
    with atomic_write(path, overwrite=True) as file:
        file.write(text.encode())


def read_spread(path: str | Path) -> dict[str, np.ndarray]:
    """Read what `write_spread` wrote: every array by its name, with the draws along axis 0."""
    draws = json.loads(Path(path).read_text(encoding="utf-8"))["draws"]
    return {name: np.array([d[name] for d in draws], dtype=np.float64) for name in draws[0]}


def quantiles(draws: Any, q: Any) -> np.ndarray:
    """Return quantiles over the draws (axis 0) that are values themselves: inf is allowed."""
    return np.quantile(draws, q, axis=0, method="inverted_cdf")
