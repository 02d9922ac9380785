"""Reports as one self-contained HTML file: no other file, no network, no script.

A page is a tree of the blocks below; one template draws it and escapes every string.
Figures come as bytes, so this module needs no drawing library.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, Literal

from jaxcal.extras import needs
from jaxcal.files import AnyPath, write_text


@dataclasses.dataclass(frozen=True)
class Badge:
    """A short word in a coloured outline: a verdict."""

    text: str
    tone: Literal["good", "fair", "bad", "neutral"] = "neutral"


@dataclasses.dataclass(frozen=True)
class Code:
    """A command or a file name."""

    text: str


Inline = str | Badge | Code
Content = Inline | Sequence[Inline]
"""A piece of text, or several that follow one another"""


@dataclasses.dataclass(frozen=True)
class Text:
    """A paragraph. A plain string stands for one without a role."""

    text: Content
    role: Literal["", "note", "warning"] = ""  # small print, or a highlighted warning


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows under a header; a wide one scrolls by itself on a phone."""

    head: Sequence[Content]
    rows: Sequence[Sequence[Content]]
    caption: Content = ""
    numeric: bool = True  # all columns but the first are aligned to the right

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.head):
                raise ValueError(
                    f"a row must have {len(self.head)} cells as the header has, got "
                    f"{len(row)}: {row!r}"
                )


@dataclasses.dataclass(frozen=True)
class Figure:
    """A picture inside the page."""

    data: bytes  # an SVG file
    alt: str  # what it shows, for readers who do not see it

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        if b"<svg" not in self.data[:1000]:
            raise ValueError(f"figure {self.alt!r} must be an SVG file")
        return f"data:image/svg+xml;base64,{base64.b64encode(self.data).decode()}"


Block = str | Text | Table | Figure


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading and what is below it."""

    title: str
    blocks: Sequence[Block]
    key: str = ""  # what a link to "#key" leads to
    badge: Badge | None = None  # beside the heading


@dataclasses.dataclass(frozen=True)
class Page:
    """A report."""

    title: str
    sections: Sequence[Section]
    intro: Sequence[Block] = ()
    contents: bool = False  # links to every section with a key, below the intro
    footer: Sequence[Block] = ()


def render(page: Page) -> str:
    """The HTML file as text; a ValueError where a figure is not an SVG file."""
    return str(_template().render(page=page)).lstrip()


@functools.cache
def _template() -> Any:
    """The page's template; compiling it takes a quarter of a second."""
    path = pathlib.Path(__file__).with_name("page.html.j2")
    with needs("plots", "an HTML report"):
        return template(
            path,
            html=True,
            pieces=lambda c: c if isinstance(c, list | tuple) else (c,),
            kind=lambda piece: type(piece).__name__.lower(),
        )


def template(
    path: pathlib.Path, html: bool = False, **filters: Callable[[Any], Any]
) -> Any:
    """A jinja2 template by its file, and what it may call; ``html`` is escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        autoescape=html,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= filters
    return environment.get_template(path.name)


def write_page(path: AnyPath, page: Page) -> None:
    """Write the page atomically."""
    write_text(path, render(page))
