"""Sphinx extension: what the built book needs to be free of errors, and of the network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

THEME = {
    '<button class="btn search-button-field search-button__button pst-js-only" title="Search" '
    'aria-label="Search"': '<button class="btn search-button-field search-button__button '
    'pst-js-only" title="Search"',
    'theme-switch-button pst-js-only" aria-label="Color mode" data-bs-title="Color mode"  '
    'data-bs-placement="bottom" data-bs-toggle="tooltip">': 'theme-switch-button pst-js-only" '
    'data-bs-title="Color mode" data-bs-placement="bottom" data-bs-toggle="tooltip">'
    '<span class="visually-hidden">Color mode</span>',
    '<summary aria-label="Toggle hidden content">': "<summary>",
    '<summary><span class="toctree-toggle"': '<summary aria-label="Pages below"><span '
    'class="toctree-toggle"',
}
"""What theme and folded cells write, and the same with names that buttons lack or have wrongly."""


def use_svg_math(app: Any, config: Any) -> None:
    """Choose MathJax's SVG output.

    The default of sphinx-mathjax-offline (CHTML) loses thin bars, as the one of a transpose,
    at normal zoom. That extension sets the path by itself, so _config.yml cannot.
    """
    config.mathjax_path = "mathjax/tex-svg.js"


def drop_duplicates(app: Any, pagename: str, templatename: str, context: Any, doctree: Any) -> None:
    """Keep the first of equal scripts and style sheets of a page.

    Some extensions register the same file or line twice; a script that declares a constant
    then fails at its second run in the browser. The list is changed in place, because
    extensions that come later still add to it.
    """
    for kind in ("script_files", "css_files"):
        kept: list[Any] = []
        seen: set[tuple[str, str]] = set()
        for entry in context[kind]:
            key = (str(entry.filename or ""), str(entry.attributes.get("body", "")))
            if key not in seen:
                seen.add(key)
                kept.append(entry)
        context[kind][:] = kept


def name_buttons(app: Any, error: Exception | None) -> None:
    """Let what can be pressed be called what stands on it, for who hears or speaks it."""
    if error is None and app.builder.format == "html":
        for path in Path(app.outdir).rglob("*.html"):
            old = new = path.read_text(encoding="utf-8")
            for part, better in THEME.items():
                new = new.replace(part, better)
            if new != old:
                path.write_text(new, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    app.connect("config-inited", use_svg_math, priority=900)
    app.connect("html-page-context", drop_duplicates, priority=0)
    app.connect("build-finished", name_buttons)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
