"""Evaluation of any number of episodes: constant memory, resumable, shared.

An endless dataset is evaluated in parts; the rows of a part are a file of its own,
written when it is done. So a run that was stopped resumes, more episodes start from
what is there, and any processes that see the folder share the work; none of that
changes a digit, because the same parts are averaged in the same order.
"""

from __future__ import annotations

import json
import math
import pathlib
import random
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import POLICIES, evaluate
from jaxcal.evaluation.postures import summary_of
from jaxcal.evaluation.results import MethodNumbers, Summary, finite
from jaxcal.extras import versions
from jaxcal.files import write_text

PART = 5_000  # episodes whose rows are one file; the draws' blocks of 1,000 divide it
_MEANS = ("ratio_to_exact", "hit_rate", "d_efficiency", "seconds_per_selection")


def evaluate_stream(
    draw: Callable[[int, int], Dataset],
    episodes: int,
    folder: pathlib.Path,
    plan: Mapping[str, Any],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Summary:
    """Evaluate the first episodes of a dataset, resuming from the parts in a folder.

    Args:
        draw: (begin, end) -> episodes; ``begin`` is a multiple of 1,000.
        episodes: how many.
        folder: made where it is missing.
        plan: JSON values: ``dataset``, and the arguments of ``evaluate``, ``methods``
            and ``seed`` among them. Parts of another plan are refused.
        progress: called as parts are completed.
    """
    options = {name: value for name, value in plan.items() if name != "dataset"}
    options["methods"] = list(dict.fromkeys([*options["methods"], "random"]))

    def solve(begin: int, end: int) -> Summary:
        seed = options["seed"] + begin
        return evaluate(draw(begin, end), **options | {"seed": seed}).summarise()

    facts = solve(0, 1).facts  # what is wrong is said before anything is kept
    _open(folder, plan)
    cuts = [(begin, min(begin + PART, episodes)) for begin in range(0, episodes, PART)]
    files = {folder / f"part-{a:012d}-{b:012d}.json": (a, b) for a, b in cuts}
    todo = [path for path in files if not path.exists()]
    random.shuffle(todo)
    for number, path in enumerate(todo):
        progress("parts", number, len(todo))
        if not path.exists():  # no other process was sooner
            begin, end = files[path]
            part = solve(begin, end)
            kept = [(row.method, row.checkpoint, row.numbers) for row in part.rows]
            proven = round(part.facts["proven"] * (end - begin))
            write_text(path, json.dumps({"proven": proven, "rows": kept}))
    progress("parts", len(todo), len(todo))

    parts = [_read(path) for path in files]
    counts = [end - begin for begin, end in cuts]
    rows = []
    for i, (method, checkpoint, _) in enumerate(parts[0]["rows"]):
        numbers = total(counts, [part["rows"][i][2] for part in parts])
        rows.append(MethodNumbers(method, checkpoint, numbers))
    middle = {row.method: row.numbers["det_s"]["mean"] for row in rows}["random"]
    for row in rows:
        mean = row.numbers["det_s"]["mean"]
        row.numbers["ratio_to_random"] = mean / middle if mean and middle else None
    facts = {
        "dataset": facts["dataset"] | {"episodes": episodes},
        "k": options["k"],
        "seed": options["seed"],
        "criterion": "D",
    }
    asked = tuple(row for row in rows if row.method in plan["methods"])
    return summary_of(facts, asked, sum(part["proven"] for part in parts))


def total(counts: list[int], parts: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of all parts, of ``counts`` episodes each; a number that one of their
    rows lacks is lacking."""

    def mean(values: Any) -> float:
        return float(np.average(np.array(values, float), weights=counts))  # None: NaN

    # Medians and variances of parts do not add up.
    row = {k: v for k, v in parts[0].items() if k != "parameter_variance"}
    for name in _MEANS:
        row[name] = finite(mean([part[name] for part in parts]))
    for name in ("det_s", "log_det_s"):
        held = [[part[name]["mean"], part[name]["std"]] for part in parts]
        middles, stds = np.array(held, float).T
        middle = mean(middles)
        std = math.sqrt(mean(stds**2 + (middles - middle) ** 2))
        row[name] = {"mean": finite(middle), "std": finite(std), "median": None}
    return row


def _open(folder: pathlib.Path, plan: Mapping[str, Any]) -> None:
    """Make sure that the parts in a folder add up with those of this plan."""
    weights = {}
    if set(plan["methods"]) & set(POLICIES):
        from jaxcal.learning.training.checkpoint import load

        for checkpoint in plan["checkpoints"]:
            weights[checkpoint or "default"] = load(checkpoint).weights.fingerprint
    head = {"format": "jaxcal-evaluation-stream", "version": 4, "part": PART}
    whole = {**head, **plan, "weights": weights, "versions": versions()}
    settings, path = json.loads(json.dumps(whole)), folder / "stream.json"
    folder.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        write_text(path, json.dumps(settings, indent=1) + "\n")
    held = _read(path)
    for name in (name for name in settings if held.get(name) != settings[name]):
        raise ValueError(
            f"{folder} holds parts of another evaluation: its {name} is "
            f"{held.get(name)!r}, not {settings[name]!r}; name another folder"
        )


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}). Delete it; it will be computed again"
        ) from None
