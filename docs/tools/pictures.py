"""Pictures of a page's code on the page: what a block has drawn follows the block.

``executed`` turns each ``python`` block of a page into one that markdown-exec runs:
what it prints follows it, and then its figures. A block that ends in a call of
``.plot()`` shows its picture as a notebook would. Blocks marked ``py`` are not run.
"""

from __future__ import annotations

import base64
import re
from typing import Any

from jaxcal.reports.plots import as_bytes

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
DRAWN = re.compile(r"((?!axes\b|[\w, ]+ = )[^#]*\.plot\([^#]*\))(\s+#.*)?")


def executed(markdown: str, session: str) -> str:
    """A page whose ``python`` blocks are run, one after the other, in one session."""

    def run(block: re.Match[str]) -> str:
        code = block[1]
        if shown := DRAWN.fullmatch(code.rstrip().rpartition("\n")[2]):
            code += f"picture_{block.start()} = {shown[1]}  # markdown-exec: hide\n"
        return (
            f'```python exec="on" source="above" result="text" session="{session}"\n'
            f'{code}```\n\n```python exec="on" html="on" session="{session}"\n'
            "import pictures\nprint(pictures.drawn(globals()))\n```"
        )

    return BLOCK.sub(run, markdown)


def drawn(names: dict[str, Any]) -> str:
    """The figures among these that were not shown yet, as images of a page."""
    found = []
    for value in list(names.values()):
        figure = getattr(value, "figure", None)  # of axes, and of a figure itself
        if hasattr(figure, "savefig") and not hasattr(figure, "on_page"):
            figure.on_page = True
            svg = base64.b64encode(as_bytes(figure, "svg")).decode()
            source = f"data:image/svg+xml;base64,{svg}"
            found.append(f'<p><img alt="Drawn by the code above" src="{source}"></p>')
    return "\n".join(found)
