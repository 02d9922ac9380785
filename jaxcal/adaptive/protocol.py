"""A closed loop for other programs: a JSON object per line, each with an answer.

``do`` is ``suggest``, ``observed`` or ``state``: see docs/adaptive.md. ``observed``
takes the outcome of what was suggested, or with a ``design``, an index or coordinates,
that of another one; with a ``number`` it is refused unless that measurement is the
next, so a program that does not know whether its last line arrived sends it again.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np

from jaxcal.adaptive.loop import Loop, estimates
from jaxcal.evaluation.report import finite

_FIELDS = {"suggest": (), "observed": ("outcome", "design", "number"), "state": ()}


def answers(loop: Loop, lines: Iterable[str]) -> Iterator[str]:
    """The answer to each line of requests, with its newline; empty lines have none. An
    outcome is in the journal of the session before it is answered."""
    for line in lines:
        if line.strip():
            try:
                answer = _answer(loop, line)
            except ValueError as error:
                answer = {"error": " ".join(str(error).split())}
            yield json.dumps(answer, allow_nan=False) + "\n"


def _answer(loop: Loop, line: str) -> dict[str, Any]:
    try:
        request = json.loads(line)
    except ValueError as error:
        raise ValueError(
            f"a request must be a JSON object on one line: {error}"
        ) from None
    asked = request.get("do") if isinstance(request, dict) else None
    if asked not in tuple(_FIELDS):  # a list has no hash
        requests = ", ".join(_FIELDS)
        raise ValueError(f"do must be one of {requests}, got {line.strip()[:80]}")
    if more := set(request) - {"do", *_FIELDS[asked]}:
        raise ValueError(f"{asked} takes no {min(more)!r}")
    number = int(loop.session.made)
    if asked == "suggest":
        return _suggested(loop)
    if asked == "state":
        return _state(loop)
    if "outcome" not in request:
        raise ValueError("observed needs the outcome")
    if request.get("number", number) != number:
        raise ValueError(
            f"number must be {number}, the next measurement, got {request['number']!r}"
        )
    loop.observed(request["outcome"], request.get("design"))
    return {"number": number + 1}


def _suggested(loop: Loop) -> dict[str, Any]:
    proposal = loop.suggest()
    if proposal.design is None:
        return {"number": proposal.number, "over": True}
    answer: dict[str, Any] = {"number": proposal.number}
    for name in ("design", "coordinates"):
        value = getattr(proposal, name)
        answer[name] = jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), value)
    return answer | {n: getattr(proposal, n) for n in ("gain", "seconds", "uses")}


def _state(loop: Loop) -> dict[str, Any]:
    session, belief = loop.session, loop.belief
    named = hasattr(loop.task, "theta_names") or hasattr(belief.model, "names")
    unknowns = estimates(loop.task, belief) if named else {}
    return {
        "number": int(session.made),
        "over": bool(loop.task.over(session)),
        "seconds": finite(session.seconds),
        "uses": int(session.uses),
        "entropy": finite(belief.entropy()),
        "unknowns": {name: dataclasses.asdict(unknowns[name]) for name in unknowns},
    }
