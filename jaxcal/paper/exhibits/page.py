"""The report: one HTML file with every figure inside, and the numbers as JSON."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcal.evaluation.report import versions
from jaxcal.paper.exhibits.exhibit import Claim, Exhibit

__all__ = ["FORMAT", "VERSION", "json_document", "page"]

FORMAT = "jaxcal-reproduction"
VERSION = 1

_COLOURS = {
    "agrees": "#00664a",
    "agrees in part": "#8a5a00",
    "disagrees": "#a63603",
    "not comparable": "#555",
}
_STYLE = """
:root{color-scheme:light}
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;
padding:0 1rem;color:#222;background:#fff}
h1{line-height:1.2;margin-bottom:.2em}h2{margin:2.2em 0 .3em;line-height:1.25}
h2 .verdict{margin-left:.5em;vertical-align:.15em}
table{border-collapse:collapse;margin:1em 0;width:100%;font-size:.92rem}
th,td{padding:.35em .6em;border-bottom:1px solid #ddd;text-align:left;
vertical-align:top}th{background:#f4f4f4}
.verdict{font-size:.8rem;font-weight:600;white-space:nowrap;border:1px solid;
border-radius:1em;padding:.05em .6em}
.sides{display:grid;grid-template-columns:1fr 2fr;gap:1rem;margin:.6em 0}
.sides>div{background:#f7f7f7;padding:.6em .9em;border-radius:.4em}
.sides b{display:block;font-size:.8rem;color:#555}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:1rem}
figure{margin:1em 0;text-align:center}img{max-width:100%;height:auto}
.note{color:#555;font-size:.88rem}nav{columns:2;font-size:.92rem}
nav a{display:block;padding:.1em 0}a{color:#0b5394}
.wide{overflow-x:auto}
@media(max-width:40rem){.sides,.pair{grid-template-columns:1fr}nav{columns:1}}
@media print{body{max-width:none;margin:0;font-size:9.5pt}nav{display:none}
h1{font-size:18pt}h2{font-size:13pt}table{font-size:8.5pt}
.film{display:none}.pair{display:block}
figure,.sides,.head,tr{break-inside:avoid}h2,.head{break-after:avoid}
figure+.note{break-before:avoid}.sides{grid-template-columns:1fr 2fr}a{color:inherit;
text-decoration:none}.sides>div{background:none;border:1px solid #bbb}
thead{display:table-header-group}@page{margin:16mm}}
"""


def page(
    exhibits: Sequence[Exhibit],
    claims: Sequence[Claim],
    images: Mapping[str, bytes],
    *,
    command: str,
    seed: int,
    note: str,
) -> str:
    """One self-contained page.

    Args:
        exhibits: in the order they are shown.
        claims: of the paper.
        images: SVG files by figure name.
        command: that makes this page again.
        seed: of everything random.
        note: where the recordings come from.
    """
    count = Counter[str](claim.verdict for claim in claims)
    summary = ", ".join(f"{count[v]} {v}" for v in _COLOURS if count[v])
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width,initial-scale=1'>",
        f"<title>The paper, figure by figure</title><style>{_STYLE}</style></head>",
        "<body><h1>The paper, figure by figure</h1>",
        "<p>Hu, Celler, Mu and Su, “D-Optimality-Guided Reinforcement Learning for "
        "Efficient Open-Loop Calibration of a 3-DOF Ankle Rehabilitation Robot”: every "
        "figure and table made again from our own runs, each beside what the paper "
        f"states. Of {len(claims)} claims: {summary}.</p>",
        f"<p class='note'>Made by <code>{_safe(command)}</code> (seed {seed}). "
        f"{_safe(note)} Intervals in brackets are 95 % confidence intervals. The data "
        "behind each figure is in <code>data/</code>, every number in "
        "<code>reproduction.json</code>, each figure as PNG and SVG and the robot's "
        "picture and film in <code>figures/</code>. "
        f"{_safe(', '.join(f'{k} {v}' for k, v in versions().items()))}.</p>",
        "<h2 id='claims'>Claim by claim</h2>",
        _claims_table(claims, {exhibit.key: exhibit.title for exhibit in exhibits}),
        "<nav>",
        *(f"<a href='#{e.key}'>{_typeset(e.title)}</a>" for e in exhibits),
        "</nav>",
    ]
    for exhibit in exhibits:
        parts += _section(exhibit, images)
    parts.append("</body></html>")
    return "\n".join(parts) + "\n"


def _claims_table(claims: Sequence[Claim], titles: Mapping[str, str]) -> str:
    rows = [
        "<div class='wide'><table><thead><tr><th>claim</th><th>paper</th><th>ours</th>"
        "<th>verdict</th></tr></thead><tbody>"
    ]
    for claim in claims:
        name = _typeset(claim.claim)
        if claim.where in titles:
            name = f"<a href='#{claim.where}'>{name}</a>"
        rows.append(
            f"<tr><td>{name}</td><td>{_typeset(claim.paper)}</td>"
            f"<td>{_typeset(claim.ours)}</td><td>{_badge(claim.verdict)}</td></tr>"
        )
    return "\n".join([*rows, "</tbody></table></div>"])


def _section(exhibit: Exhibit, images: Mapping[str, bytes]) -> list[str]:
    badge = "" if exhibit.verdict is None else _badge(exhibit.verdict)
    parts = [
        f"<section id='{exhibit.key}'><div class='head'>",
        f"<h2>{_typeset(exhibit.title)} {badge}</h2>",
        f"<div class='sides'><div><b>The paper</b>{_typeset(exhibit.paper)}</div>",
        f"<div><b>Ours</b>{_typeset(exhibit.ours)}</div></div></div>",
    ]
    if exhibit.rows:
        parts.append("<div class='wide'>" + _table(exhibit.rows) + "</div>")
    for name in exhibit.figures:
        encoded = base64.b64encode(images[name]).decode("ascii")
        parts.append(
            f"<figure><img alt='{_safe(exhibit.title)}: "
            f"{_safe(name.replace('_', ' '))}' "
            f"src='data:image/svg+xml;base64,{encoded}'></figure>"
        )
    parts += ["<div class='pair'>"] if exhibit.pictures else []
    for name, data in exhibit.pictures.items():
        kind = name.rpartition(".")[2]
        encoded = base64.b64encode(data).decode("ascii")
        what = "film" if kind == "gif" else "picture"
        parts.append(
            f"<figure class='{what}'><img alt='{_safe(exhibit.title)}: {what}' "
            f"src='data:image/{kind};base64,{encoded}'><figcaption class='note'>"
            f"<a href='figures/{name}'>{name}</a></figcaption></figure>"
        )
    parts += ["</div>"] if exhibit.pictures else []
    if exhibit.caption:
        parts.append(f"<p class='note'>{_typeset(exhibit.caption)}</p>")
    if exhibit.data:
        files = ", ".join(
            f"<a href='data/{exhibit.key}_{name}.csv'>{exhibit.key}_{name}.csv</a>"
            for name in exhibit.data
        )
        parts.append(f"<p class='note'>Data: {files}</p>")
    return [*parts, "</section>"]


def _badge(verdict: str) -> str:
    return f"<span class='verdict' style='color:{_COLOURS[verdict]}'>{verdict}</span>"


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = ["<table><thead><tr>", *(f"<th>{_safe(c)}</th>" for c in head)]
    lines.append("</tr></thead><tbody>")
    for row in body:
        lines.append("<tr>" + "".join(f"<td>{_safe(c)}</td>" for c in row) + "</tr>")
    return "".join([*lines, "</tbody></table>"])


def _safe(text: str) -> str:
    return html.escape(text)


def _typeset(text: str) -> str:
    """Escaped, with the paper's X_0 and X_* as they are printed."""
    return re.sub(r"X_(0|\*)", r"X<sub>\1</sub>", _safe(text))


def json_document(
    exhibits: Sequence[Exhibit],
    claims: Sequence[Claim],
    *,
    settings: Mapping[str, Any],
) -> str:
    """Every number of the report; the layout is in docs/reproduction.md.

    Nothing in it depends on when or how fast it was made.
    """
    document = {
        "format": FORMAT,
        "version": VERSION,
        "settings": dict(settings),
        "versions": versions(),
        "claims": [dataclasses.asdict(claim) for claim in claims],
        "exhibits": {
            exhibit.key: {
                "title": exhibit.title,
                "caption": exhibit.caption,
                "paper": exhibit.paper,
                "ours": exhibit.ours,
                "verdict": exhibit.verdict,
                "figures": list(exhibit.figures),
                "pictures": list(exhibit.pictures),
                "data": [f"{exhibit.key}_{name}.csv" for name in exhibit.data],
                "numbers": _plain(exhibit.numbers),
            }
            for exhibit in exhibits
        },
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """JSON values of whatever the exhibits hold; what is not finite becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
