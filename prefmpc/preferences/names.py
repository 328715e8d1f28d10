"""Who gave each answer: checked where it enters."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from prefmpc._checks import is_whole, sequence


def names_of(who: Any, size: int) -> np.ndarray | None:
    """Return who gave each of ``size`` answers as an array (size,) of whole numbers or of texts.

    Warns where two names differ in blanks or in case only: one person under two names would be
    taken for two who agree.

    Raises
    ------
    ValueError
        If there are not so many, or one is neither a whole number nor a text, or is blank.
    """
    if who is None:
        return None
    try:
        entries = [getattr(e, "item", lambda e=e: e)() for e in sequence("who", who)]
    except (TypeError, NotImplementedError) as error:  # of arrays of something else
        raise ValueError(f"who must hold whole numbers, or texts: {error}") from None
    if len(entries) != size:
        raise ValueError(f"who must name {size} people, one for each label, got {len(entries)}")
    texts = [isinstance(entry, str) and bool(entry.strip()) for entry in entries]
    wrong = [e for e, text in zip(entries, texts, strict=True) if not text and not is_whole(e)]
    if wrong or len(set(texts)) > 1:
        got = repr(wrong[0]) if wrong else "both"
        raise ValueError(f"who must hold whole numbers, or texts that are not blank, got {got}")
    try:
        names = np.array(entries, dtype=np.str_ if texts[0] else np.int64)
    except OverflowError as error:
        raise ValueError(f"who must hold whole numbers of 64 bits: {error}") from None
    if names.dtype.kind == "U":
        _warn_of_twins(np.unique(names))
    return names


def _warn_of_twins(names: np.ndarray) -> None:
    seen: dict[str, str] = {}
    for name in names.tolist():
        other = seen.setdefault("".join(name.split()).casefold(), name)
        if other != name:
            warnings.warn(
                f"who has {other!r} and {name!r}, which differ in blanks or in case only: if they "
                "are one person, give them one name",
                UserWarning,
                stacklevel=4,
            )
