"""The one HTML template: escaping, self-containment, and what the blocks become."""

from __future__ import annotations

import base64
import html.parser
import pathlib
import re
import subprocess
import sys

import pytest

from benchmarks.paper.exhibits.page import Link
from jaxcal.reports.page import (
    Badge,
    Code,
    Figure,
    Page,
    Section,
    Table,
    Text,
    render,
    write_page,
)

SVG = b"<svg xmlns='urn:x'><text>a & b</text></svg>"
EVIL = '<script>alert(1)</script> & "it\'s"'


class Reader(html.parser.HTMLParser):
    """Tags, attributes and text of a page; tags must be closed in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def everything(text: str) -> Page:
    """A page with every block, all of their text the given one."""
    inline = (text, Code(text), Link(text, "#one"), Badge(text, "bad"))
    return Page(
        title=text,
        intro=[text, Text(inline, "warning")],
        contents=True,
        sections=[
            Section(
                text,
                [
                    Table((text, text), [(text, inline)]),
                    Figure(SVG, text),
                ],
                key="one",
                badge=Badge(text),
            )
        ],
        footer=[Text(text, "note")],
    )


def test_every_text_is_escaped_wherever_it_stands():
    found = Reader(render(everything(EVIL)))
    assert not found.all("script")
    # Two runs of four inline pieces, ten strings by themselves.
    assert sum(word.count(EVIL) for word in found.words) == 2 * 4 + 10
    assert found.all("img")[0]["alt"] == EVIL


def test_page_is_self_contained_and_fits_a_phone():
    page = render(everything("plain"))
    found = Reader(page)
    assert page.startswith("<!doctype html>") and page.endswith("</html>\n")
    assert not re.search(r"(href|src)=['\"]?(https?:)?//", page)
    assert "@import" not in page and "url(" not in page
    keys = [attributes.get("id") for attributes in found.all("section")]
    assert {a["href"] for a in found.all("a")} == {f"#{key}" for key in keys}
    assert "width=device-width" in page and "@media print" in page
    assert found.all("div")[0]["class"] == "wide"  # a wide table scrolls by itself


def test_figure_is_embedded_to_the_byte():
    page = Page("t", [Section("s", [Figure(SVG, "alt")])])
    source = Reader(render(page)).all("img")[0]["src"]
    kind, _, encoded = source.partition(",")
    assert kind == "data:image/svg+xml;base64"
    assert base64.b64decode(encoded) == SVG


def test_what_cannot_be_shown_is_refused():
    with pytest.raises(ValueError, match="'x' must be an SVG file"):
        render(Page("t", [Section("s", [Figure(b"JFIF", "x")])]))
    with pytest.raises(ValueError, match="2 cells as the header has, got 1"):
        Table(("a", "b"), [("1",)])
    for href in ("https://example.org", "//example.org", "javascript:x", "/etc"):
        with pytest.raises(ValueError, match="relative to the page"):
            Link("x", href)


def test_write_page_replaces_the_file_atomically(tmp_path: pathlib.Path):
    path = tmp_path / "index.html"
    write_page(path, everything("one"))
    before = path.read_text()
    bad = Page("t", [Section("s", [Figure(b"JFIF", "x")])])
    with pytest.raises(ValueError, match="must be an SVG"):
        write_page(path, bad)
    assert path.read_text() == before == render(everything("one"))
    assert [file.name for file in tmp_path.iterdir()] == ["index.html"]


def test_pages_load_no_drawing_library():
    code = (
        "import sys, jaxcal.reports.page as p; p.render(p.Page('t', []));"
        "print([m for m in ('matplotlib', 'jax', 'scipy') if m in sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert shown.stdout.strip() == "[]"
