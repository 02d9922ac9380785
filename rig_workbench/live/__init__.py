"""The live page: another process that reads a run's folder and shows it in a browser.

It can ask the session to pause or to stop, and can move nothing. A session knows
nothing of it: the commands start it, and it ends by itself. Nothing here loads a web
framework.
"""

from __future__ import annotations

import functools
import pathlib
import time
from typing import Any


def draw(part: str, **values: Any) -> str:
    """A part of the page as HTML, escaped: a macro of page.html.j2."""
    return str(getattr(_template(), part)(**values))


@functools.cache
def _template() -> Any:
    import jinja2

    from rig_workbench.outputs.view import angle

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["angles"] = lambda values: " ".join(
        angle(value, 2) for value in values
    )
    environment.filters["clock"] = lambda when: time.strftime(
        "%H:%M:%S", time.localtime(when)
    )
    return environment.get_template("page.html.j2").module
