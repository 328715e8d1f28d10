"""The pages for those who cannot see, or cannot point: axe-core finds nothing serious in them.

PREFMPC_AXE names its script, ``axe.min.js`` of the package axe-core.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from chromium import BROWSER, Browser

if not BROWSER:
    pytest.skip("no Chromium was found on the PATH", allow_module_level=True)
if not os.environ.get("PREFMPC_AXE"):
    pytest.skip("PREFMPC_AXE names no script of axe-core", allow_module_level=True)

AXE = Path(os.environ["PREFMPC_AXE"])
BOOK = Path(__file__).resolve().parent.parent.parent / "_build" / "html" / "book"
RUN = """axe.run().then(({ violations }) => violations
  .filter(({ impact }) => impact === "serious" || impact === "critical")
  .map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.target).join("; ")}`))"""

each_window = pytest.mark.parametrize(
    ("width", "scheme"), [(390, "light"), (390, "dark"), (1280, "light"), (1280, "dark")]
)


def opened(page: str, width: int, scheme: str) -> Browser:
    """Return a window that stands still, with axe-core in it."""
    still = {"prefers_color_scheme": scheme, "prefers_reduced_motion": "reduce"}
    browser = Browser(width, 1000, **still)
    browser.open((BOOK / page).as_uri())
    browser.call("Runtime.evaluate", expression=AXE.read_text(encoding="utf-8"))
    return browser


def found(browser: Browser) -> Any:
    return browser(RUN)


@each_window
def test_the_page_that_asks(width: int, scheme: str) -> None:
    with opened("ask.html", width, scheme) as browser:
        browser.wait("document.querySelector('.ask-count')?.textContent === 'Question 1'")
        assert found(browser) == []
        browser.press("ArrowLeft")
        browser.wait("document.querySelector('.ask-count').textContent === 'Question 2'")
        browser("document.querySelectorAll('.ask details').forEach((d) => { d.open = true; })")
        assert found(browser) == []
        browser.click(".ask-stop")
        browser.wait("!document.querySelector('.ask-over').hidden")
        assert found(browser) == []


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1280, "light")])
@pytest.mark.parametrize("chapter", ["extensions/asking.html", "practice/asking_people.html"])
def test_chapters(chapter: str, width: int, scheme: str) -> None:
    with opened(chapter, width, scheme) as browser:
        assert found(browser) == []
