"""Reports as one self-contained HTML file: no other file, no network, no script.

A page is a tree of the blocks below; one template draws it and escapes every string.
Figures come as bytes, so this module needs no drawing library.
"""

from __future__ import annotations

import base64
import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from jaxcal.extras import needs
from jaxcal.files import write_text

__all__ = [
    "Badge",
    "Block",
    "Box",
    "Code",
    "Content",
    "Figure",
    "Link",
    "Page",
    "Row",
    "Section",
    "Strong",
    "Table",
    "Text",
    "Values",
    "render",
    "write_page",
]


@dataclasses.dataclass(frozen=True)
class Link:
    """A link to a section (``#key``) or to a file beside the page."""

    text: str
    href: str
    kind: ClassVar[str] = "link"

    def __post_init__(self) -> None:
        if ":" in self.href or self.href.startswith("/"):
            raise ValueError(
                "href must be '#key' or a path relative to the page, which works "
                f"without a network, got {self.href!r}"
            )


@dataclasses.dataclass(frozen=True)
class Badge:
    """A short word in a coloured outline: a verdict."""

    text: str
    tone: Literal["good", "fair", "bad", "neutral"] = "neutral"
    kind: ClassVar[str] = "badge"


@dataclasses.dataclass(frozen=True)
class Code:
    """A command or a file name."""

    text: str
    kind: ClassVar[str] = "code"


@dataclasses.dataclass(frozen=True)
class Strong:
    """What must not be overlooked."""

    text: str
    kind: ClassVar[str] = "strong"


Inline = str | Link | Badge | Code | Strong
Content = Inline | Sequence[Inline]
"""A piece of text, or several that follow one another"""


@dataclasses.dataclass(frozen=True)
class Text:
    """A paragraph. A plain string stands for one without a role."""

    text: Content
    role: Literal["", "note", "warning"] = ""  # small print, or a highlighted warning
    kind: ClassVar[str] = "text"


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows under a header; a wide one scrolls by itself on a phone."""

    head: Sequence[Content]
    rows: Sequence[Sequence[Content]]
    caption: Content = ""
    numeric: bool = True  # all columns but the first are aligned to the right
    kind: ClassVar[str] = "table"

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

    data: bytes | str  # an SVG, PNG or GIF file
    alt: str  # what it shows, for readers who do not see it
    caption: Content = ""
    on_paper: bool = True  # False: left out when the page is printed, a film say
    kind: ClassVar[str] = "figure"

    @property
    def uri(self) -> str:
        """The file as a data URI.

        Raises:
            ValueError: it is neither SVG nor PNG nor GIF.
        """
        data = self.data.encode() if isinstance(self.data, str) else self.data
        if data.startswith(b"\x89PNG"):
            media = "png"
        elif data.startswith(b"GIF8"):
            media = "gif"
        elif b"<svg" in data[:1000]:
            media = "svg+xml"
        else:
            raise ValueError(f"figure {self.alt!r} must be an SVG, PNG or GIF file")
        return f"data:image/{media};base64,{base64.b64encode(data).decode('ascii')}"


@dataclasses.dataclass(frozen=True)
class Values:
    """Names with their values, one a line."""

    items: Mapping[str, Content]
    kind: ClassVar[str] = "values"


@dataclasses.dataclass(frozen=True)
class Box:
    """A titled, shaded paragraph."""

    title: str
    text: Content
    kind: ClassVar[str] = "box"


@dataclasses.dataclass(frozen=True)
class Row:
    """Blocks side by side, one below the other on a phone."""

    blocks: Sequence[str | Text | Table | Figure | Values | Box]
    kind: ClassVar[str] = "row"


Block = str | Text | Table | Figure | Values | Box | Row


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading and what is below it."""

    title: str
    blocks: Sequence[Block]
    key: str = ""  # what ``Link("...", "#key")`` leads to
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
    """The HTML file as text.

    Raises:
        MissingExtraError: jinja2 is not installed.
        ValueError: a figure is not an SVG, PNG or GIF file.
    """
    with needs("study", "an HTML report"):
        import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxcal", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["pieces"] = _pieces
    return environment.get_template("page.html.j2").render(page=page).lstrip()


def write_page(path: str | os.PathLike[str], page: Page) -> None:
    """Write the page atomically.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
    write_text(path, render(page))


def _pieces(content: Content) -> Sequence[Any]:
    """The content as a sequence of inline pieces."""
    return content if isinstance(content, list | tuple) else (content,)
