"""The report: one HTML file with every figure inside, and the numbers as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from benchmarks.paper.exhibits.exhibit import Claim, Exhibit, Verdict
from benchmarks.paper.exhibits.study import Settings
from jaxcal.extras import versions
from jaxcal.reports import page as pages

_TONES: dict[Verdict, tuple[Literal["good", "fair", "bad", "neutral"], str]] = {
    "agrees": ("good", "agree"),
    "agrees in part": ("fair", "agree in part"),
    "disagrees": ("bad", "disagree"),
    "not comparable": ("neutral", "cannot be compared"),
}


@dataclasses.dataclass(frozen=True)
class Link(pages.Code):
    """A link to a section (``#key``) or to a file beside the page."""

    href: str

    def __post_init__(self) -> None:
        if ":" in self.href or self.href.startswith("/"):
            raise ValueError(
                "href must be '#key' or a path relative to the page, which works "
                f"without a network, got {self.href!r}"
            )


def page(
    exhibits: Sequence[Exhibit],
    claims: Sequence[Claim],
    images: Mapping[str, bytes],
    settings: Settings,
) -> str:
    """One self-contained page; ``images`` are the SVG files by figure name."""
    count = Counter[str](claim.verdict for claim in claims)
    said = [f"{count[v]} {plural}" for v, (_, plural) in _TONES.items() if count[v]]
    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    intro = (
        "Hu, Celler, Mu and Su, “D-Optimality-Guided Reinforcement Learning for "
        "Efficient Open-Loop Calibration of a 3-DOF Ankle Rehabilitation Robot”: every "
        "figure and table reproduced from our own runs, each beside what the paper "
        f"states. Of {len(claims)} claims, {', '.join(said)}. What it claims of PPO is "
        "judged with agents that PPO trained on its 210 numbers; the policy that ships "
        "as default, trained by imitation of solvers, stands beside and is named so."
    )
    code, about = pages.Code, settings.about_recordings
    small_print: list[pages.Inline] = [
        *("Made by ", code(settings.command), f" (seed {settings.seed}). {about} "),
        "Intervals in brackets are 95 % confidence intervals. The data behind each ",
        *("figure is in ", code("data/"), ", every number in "),
        *(code("reproduction.json"), ", each figure as PNG and SVG in "),
        *(code("figures/"), f". {made_with}."),
    ]
    rows = [
        (
            Link(_typeset(claim.claim), f"#{claim.where}"),
            *(_typeset(claim.paper), _typeset(claim.ours), _badge(claim.verdict)),
        )
        for claim in claims
    ]
    table = pages.Table(("claim", "paper", "ours", "verdict"), rows, numeric=False)
    first = pages.Section("Claim by claim", [table], "claims")
    return pages.render(
        pages.Page(
            "The paper, figure by figure",
            [first, *(_section(exhibit, images) for exhibit in exhibits)],
            [intro, pages.Text(small_print, "note")],
            contents=True,
        )
    )


def _section(exhibit: Exhibit, images: Mapping[str, bytes]) -> pages.Section:
    sides = _typeset(exhibit.paper), _typeset(exhibit.ours)
    blocks: list[pages.Block] = [
        pages.Table(("The paper", "Ours"), [sides], numeric=False)
    ]
    if exhibit.policy:
        blocks.append(pages.Text(_typeset(exhibit.policy), "note"))
    if exhibit.rows:
        head, *body = exhibit.rows
        blocks.append(pages.Table(head, body, numeric=False))
    for name in exhibit.figures:
        alt = f"{exhibit.title}: {name.replace('_', ' ')}"
        blocks.append(pages.Figure(images[name], alt))
    if exhibit.caption:
        blocks.append(pages.Text(_typeset(exhibit.caption), "note"))
    files: list[pages.Inline] = []
    for name in exhibit.tables:
        files += [", " if files else "Data: ", Link(name, f"data/{name}")]
    if files:
        blocks.append(pages.Text(files, "note"))
    badge = None if exhibit.verdict is None else _badge(exhibit.verdict)
    return pages.Section(_typeset(exhibit.title), blocks, exhibit.key, badge)


def _badge(verdict: Verdict) -> pages.Badge:
    return pages.Badge(verdict, _TONES[verdict][0])


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
        "format": "jaxcal-reproduction",
        "version": 1,
        "settings": {"seed": settings.seed, "quick": settings.quick, "data": data},
        "versions": versions(),
        "claims": [dataclasses.asdict(claim) for claim in claims],
        "exhibits": {
            exhibit.key: {
                **{name: getattr(exhibit, name) for name in _AS_THEY_ARE},
                "figures": list(exhibit.figures),
                "data": list(exhibit.tables),
                "numbers": _plain(exhibit.numbers),
            }
            for exhibit in exhibits
        },
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


_AS_THEY_ARE = ("title", "policy", "caption", "paper", "ours", "verdict")


def _plain(value: Any) -> Any:
    """JSON values of whatever the exhibits hold; what is not finite becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
