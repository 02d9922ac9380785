"""The report: one HTML file with every figure inside, and the numbers as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from jaxcal import pages
from jaxcal.evaluation.report import versions
from jaxcal.paper.exhibits.exhibit import Claim, Exhibit, Verdict
from jaxcal.paper.exhibits.settings import Settings

__all__ = ["FORMAT", "VERSION", "json_document", "page"]

FORMAT = "jaxcal-reproduction"
VERSION = 1

_TONES: dict[Verdict, Literal["good", "fair", "bad", "neutral"]] = {
    "agrees": "good",
    "agrees in part": "fair",
    "disagrees": "bad",
    "not comparable": "neutral",
}
_PLURAL = {
    "agrees": "agree",
    "agrees in part": "agree in part",
    "disagrees": "disagree",
    "not comparable": "cannot be compared",
}


def page(
    exhibits: Sequence[Exhibit],
    claims: Sequence[Claim],
    images: Mapping[str, bytes],
    settings: Settings,
) -> str:
    """One self-contained page.

    Args:
        exhibits: in the order they are shown.
        claims: of the paper.
        images: SVG files by figure name.
        settings: that the exhibits were made with.
    """
    count = Counter[str](claim.verdict for claim in claims)
    summary = ", ".join(f"{count[v]} {_PLURAL[v]}" for v in _TONES if count[v])
    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    intro = (
        "Hu, Celler, Mu and Su, “D-Optimality-Guided Reinforcement Learning for "
        "Efficient Open-Loop Calibration of a 3-DOF Ankle Rehabilitation Robot”: every "
        "figure and table reproduced from our own runs, each beside what the paper "
        f"states. Of {len(claims)} claims, {summary}."
    )
    code, about = pages.Code, settings.about_recordings
    small_print: list[pages.Inline] = [
        *("Made by ", code(settings.command), f" (seed {settings.seed}). {about} "),
        "Intervals in brackets are 95 % confidence intervals. The data behind each ",
        *("figure is in ", code("data/"), ", every number in "),
        *(code("reproduction.json"), ", each figure as PNG and SVG and the robot's "),
        *("picture and film in ", code("figures/"), f". {made_with}."),
    ]
    keys = {exhibit.key for exhibit in exhibits}
    rows = [_claim_row(claim, claim.where in keys) for claim in claims]
    table = pages.Table(("claim", "paper", "ours", "verdict"), rows, numeric=False)
    sections = [_section(exhibit, images) for exhibit in exhibits]
    return pages.render(
        pages.Page(
            "The paper, figure by figure",
            [pages.Section("Claim by claim", [table], "claims"), *sections],
            [intro, pages.Text(small_print, "note")],
            contents=True,
        )
    )


def _claim_row(claim: Claim, shown: bool) -> list[pages.Content]:
    name = _typeset(claim.claim)
    link = pages.Link(name, f"#{claim.where}") if shown else name
    return [link, _typeset(claim.paper), _typeset(claim.ours), _badge(claim.verdict)]


def _section(exhibit: Exhibit, images: Mapping[str, bytes]) -> pages.Section:
    sides = {"The paper": exhibit.paper, "Ours": exhibit.ours}
    blocks: list[pages.Block] = [
        pages.Row([pages.Box(who, _typeset(text)) for who, text in sides.items()])
    ]
    if exhibit.rows:
        head, *body = exhibit.rows
        blocks.append(pages.Table(head, body, numeric=False))
    blocks += [
        pages.Figure(images[name], f"{exhibit.title}: {name.replace('_', ' ')}")
        for name in exhibit.figures
    ]
    if exhibit.pictures:
        blocks.append(pages.Row([_picture(exhibit, name) for name in exhibit.pictures]))
    if exhibit.caption:
        blocks.append(pages.Text(_typeset(exhibit.caption), "note"))
    if exhibit.data:
        files: list[pages.Inline] = ["Data: "]
        for name in exhibit.tables:
            files += [pages.Link(name, f"data/{name}"), ", "]
        blocks.append(pages.Text(files[:-1], "note"))
    badge = None if exhibit.verdict is None else _badge(exhibit.verdict)
    return pages.Section(_typeset(exhibit.title), blocks, exhibit.key, badge)


def _picture(exhibit: Exhibit, name: str) -> pages.Figure:
    still = name.endswith(".png")
    return pages.Figure(
        exhibit.pictures[name],
        f"{exhibit.title}: {'picture' if still else 'film'}",
        pages.Link(name, f"figures/{name}"),
        on_paper=still,
    )


def _badge(verdict: Verdict) -> pages.Badge:
    return pages.Badge(verdict, _TONES[verdict])


def _typeset(text: str) -> str:
    """The paper's X_0 and X_* as they are printed."""
    return text.replace("X_0", "X₀").replace("X_*", "X*")


def json_document(
    exhibits: Sequence[Exhibit], claims: Sequence[Claim], settings: Settings
) -> str:
    """Every number of the report; the layout is in docs/reproduction.md.

    Nothing in it depends on when or how fast it was made.
    """
    data = None if settings.data is None else str(settings.data)
    document = {
        "format": FORMAT,
        "version": VERSION,
        "settings": {"seed": settings.seed, "quick": settings.quick, "data": data},
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
                "data": list(exhibit.tables),
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
