"""The live page: another process that reads a run's folder and shows it in a browser.

It can ask the session to pause or to stop, and can move nothing. A session knows
nothing of it: the commands start it, and it ends by itself. Nothing here loads a web
framework.
"""

from __future__ import annotations

import functools
import pathlib
import time
from collections.abc import Sequence
from typing import Any

from jaxcal.reports.page import template
from rig_workbench.outputs.view import angle


def draw(part: str, **values: Any) -> str:
    """A part of the page as HTML, escaped: a macro of page.html.j2."""
    return str(getattr(_template(), part)(**values))


@functools.cache
def _template() -> Any:
    def angles(values: Sequence[float]) -> str:
        return " ".join(angle(value, 2) for value in values)

    def clock(when: float) -> str:
        return time.strftime("%H:%M:%S", time.localtime(when))

    path = pathlib.Path(__file__).with_name("page.html.j2")
    return template(path, html=True, angles=angles, clock=clock).module
