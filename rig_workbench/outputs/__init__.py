"""What is made of a run: the report, exports for controllers, the trend of several."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any


def template(
    path: pathlib.Path, html: bool = False, **filters: Callable[[Any], str]
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
