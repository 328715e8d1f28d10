"""Sphinx extension: drop duplicate scripts and style sheets from every page.

Several extensions of Jupyter Book add the same file once for every event that they listen
to. A script that declares a constant then fails at its second run in the browser.
"""

from __future__ import annotations

from typing import Any


def drop_duplicates(
    app: Any, pagename: str, templatename: str, context: dict[str, Any], doctree: Any
) -> None:
    """Keep the first of equal entries of the page's scripts and style sheets."""
    for kind in ("script_files", "css_files"):
        seen: set[tuple[str, str]] = set()
        kept = []
        for entry in context.get(kind, []):
            attributes = getattr(entry, "attributes", {})
            key = (str(getattr(entry, "filename", entry)), str(attributes.get("body", "")))
            if key not in seen:
                seen.add(key)
                kept.append(entry)
        context[kind] = kept


def setup(app: Any) -> dict[str, bool]:
    app.connect("html-page-context", drop_duplicates, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
