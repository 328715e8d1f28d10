"""The built book must work offline. `make test` builds it and then runs this file."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

import pytest
from bs4 import BeautifulSoup, Tag

ROOT = Path(__file__).resolve().parent.parent.parent
HTML = ROOT / "_build" / "html"
# Elements that make the browser load something, and the attribute that names it.
LOADING = {
    "script": ["src"],
    "link": ["href"],
    "img": ["src", "srcset"],
    "iframe": ["src"],
    "source": ["src", "srcset"],
    "video": ["src", "poster"],
    "audio": ["src"],
    "embed": ["src"],
    "object": ["data"],
    "track": ["src"],
    "input": ["src"],
    "base": ["href"],
}
# <link> elements of these kinds only state a relation; the browser loads nothing.
NOT_LOADED = {"next", "prev", "search", "index", "canonical", "author", "license", "contents"}
CSS_URL = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")
SCRIPT_URL = re.compile(r"(?:src\s*=|import\(|fetch\(|importScripts\()\s*['\"`](https?:)?//")


def find_pages() -> list[Path]:
    return sorted(p for p in HTML.rglob("*.html") if "_static" not in p.relative_to(HTML).parts)


PAGES = find_pages()
BOOK_PAGES = [p for p in PAGES if p.is_relative_to(HTML / "book")]
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(HTML)))
each_book_page = pytest.mark.parametrize("page", BOOK_PAGES, ids=lambda p: str(p.relative_to(HTML)))


@cache
def parsed(page: Path) -> BeautifulSoup:
    return BeautifulSoup(page.read_text(encoding="utf-8"), "html.parser")


@cache
def anchors(page: Path) -> frozenset[str]:
    return frozenset(str(tag["id"]) for tag in parsed(page).find_all(id=True))


def is_external(address: str) -> bool:
    return bool(urlparse(address).netloc) or urlparse(address).scheme in {"http", "https"}


def external_in_html(soup: BeautifulSoup) -> list[str]:
    """All addresses outside of the book that the browser would load with this page."""
    found = []
    for name, attributes in LOADING.items():
        for tag in soup.find_all(name):
            relation = set(tag.get("rel") or [])
            if name == "link" and relation and relation <= NOT_LOADED:
                continue
            for attribute in attributes:
                found += [
                    f"<{name} {attribute}={part}>"
                    for part in str(tag.get(attribute) or "").split()
                    if is_external(part)
                ]
    for tag in soup.find_all(style=True):
        found += external_in_css(str(tag["style"]))
    for tag in soup.find_all("style"):
        found += external_in_css(tag.get_text())
    for tag in soup.find_all("script"):
        found += [m.group(0) for m in SCRIPT_URL.finditer(tag.get_text())]
    for tag in soup.find_all("meta", attrs={"http-equiv": re.compile("refresh", re.I)}):
        target = str(tag.get("content", "")).partition("url=")[2]
        found += [f"<meta refresh {target}>"] if is_external(target) else []
    return found


def external_in_css(text: str) -> list[str]:
    addresses = ["".join(groups) for groups in CSS_URL.findall(text)]
    return [a for a in addresses if is_external(a) and not a.startswith("data:")]


def test_book_was_built() -> None:
    assert (HTML / "index.html").is_file(), "no _build/html/index.html: run `make html`"
    assert (HTML / "book" / "index.html").is_file()
    assert len(BOOK_PAGES) >= 5


@each_page
def test_nothing_is_loaded_from_the_network(page: Path) -> None:
    assert external_in_html(parsed(page)) == []


def test_style_sheets_load_nothing_from_the_network() -> None:
    sheets = sorted(HTML.rglob("*.css"))
    assert sheets
    found = {str(s.relative_to(HTML)): external_in_css(s.read_text("utf-8")) for s in sheets}
    assert {name: urls for name, urls in found.items() if urls} == {}


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for tag in parsed(page).find_all(["a", "img", "script", "link"]):
        address = str(tag.get("href") or tag.get("src") or "")
        if not address or is_external(address) or urlparse(address).scheme in {"mailto", "data"}:
            continue
        path, anchor = urldefrag(address)
        target = (page.parent / unquote(urlparse(path).path)).resolve() if path else page
        if not target.is_file():
            broken.append(address)
        elif anchor and tag.name == "a" and target.suffix == ".html":
            if unquote(anchor) not in anchors(target):
                broken.append(address)
    assert sorted(set(broken)) == []


@each_book_page
def test_page_has_a_title(page: Path) -> None:
    soup = parsed(page)
    assert soup.title is not None
    assert soup.title.get_text(strip=True)
    assert len(soup.select("article h1")) == 1
    assert soup.html is not None
    assert soup.html.get("lang") == "en"


@each_book_page
def test_math_has_its_local_typesetter(page: Path) -> None:
    soup = parsed(page)
    scripts = [str(tag["src"]) for tag in soup.find_all("script", src=True)]
    mathjax = [s for s in scripts if "mathjax" in s.lower()]
    if soup.find(class_="math"):
        assert len(mathjax) == 1
        assert mathjax[0].partition("?")[0].endswith("_static/mathjax/tex-svg.js")


def test_some_page_has_math() -> None:
    assert any(parsed(page).find(class_="math") for page in BOOK_PAGES)


@each_book_page
def test_no_script_twice(page: Path) -> None:
    tags = parsed(page).find_all("script")
    keys = [str(t.get("src")) if t.get("src") else t.get_text().strip() for t in tags]
    twice = {k for k in keys if k and keys.count(k) > 1}
    assert twice == set()


@each_book_page
def test_figures_have_text_for_those_who_cannot_see_them(page: Path) -> None:
    images = [t for t in parsed(page).find_all("img") if isinstance(t, Tag)]
    assert [str(t.get("src")) for t in images if t.get("alt") is None] == []


# ---- the checks themselves ----


@pytest.mark.parametrize(
    "html",
    [
        '<script src="https://cdn.example.org/a.js"></script>',
        '<script src="//cdn.example.org/a.js"></script>',
        '<link rel="stylesheet" href="http://example.org/a.css">',
        '<link rel="preconnect" href="https://fonts.example.org">',
        '<img src="https://example.org/a.png">',
        '<img srcset="a.png 1x, https://example.org/b.png 2x">',
        '<iframe src="https://example.org"></iframe>',
        "<style>@import 'https://example.org/a.css';</style>",
        "<style>@font-face {src: url(https://example.org/a.woff2)}</style>",
        '<p style="background: url(//example.org/a.png)">x</p>',
        '<script>import("https://example.org/a.js")</script>',
        '<meta http-equiv="refresh" content="0; url=https://example.org">',
    ],
)
def test_what_comes_from_the_network_is_seen(html: str) -> None:
    assert external_in_html(BeautifulSoup(html, "html.parser"))


def test_what_is_local_is_allowed() -> None:
    html = (
        '<script src="_static/a.js"></script><link rel="stylesheet" href="../a.css?v=1">'
        '<a href="https://example.org">a link that the reader may follow</a>'
        '<img src="data:image/png;base64,AA=="><style>a {b: url(data:image/svg+xml;x)}</style>'
    )
    assert external_in_html(BeautifulSoup(html, "html.parser")) == []
