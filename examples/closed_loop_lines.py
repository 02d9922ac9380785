"""A closed loop that a program in any language drives by lines of JSON.

    $ python examples/closed_loop_lines.py peak.py --journal session.jsonl
    {"do": "suggest"}
    {"number": 0, "design": 15, "coordinates": [3.05], "gain": 0.055, ...}
    {"do": "observed", "outcome": 0.42}
    {"number": 1}
    {"do": "state"}

``do`` is ``suggest``, ``observed`` or ``state``: see docs/adaptive.md. ``observed``
takes the outcome of what was suggested, or with a ``design``, an index or coordinates,
that of another one; with a ``number`` it is refused unless that measurement is the
next, so a program that does not know whether its last line arrived sends it again. Each
outcome is in the journal before the answer; killed, a session resumes when started
again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np

from jaxcal.adaptive.loop import Loop, estimates
from jaxcal.adaptive.tasks import registry
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


def main() -> None:
    """Answer standard input until it ends."""
    parser = argparse.ArgumentParser(description="a closed loop by lines of JSON")
    parser.add_argument("task", help="a task's name, or a Python file with an ENTRY")
    parser.add_argument("--journal", help="of the session; one that exists is resumed")
    more = {"nargs": "*", "default": [], "metavar": "OPTION=VALUE"}
    parser.add_argument("--with", dest="options", help="options of the task", **more)
    parser.add_argument("--seconds", type=float, help="budget [the task's]")
    parser.add_argument("--uses", type=int, help="budget [the task's]")
    parser.add_argument("--seed", type=int, default=0, help="of the random draws [0]")
    given = parser.parse_args()
    budget = {"seconds": given.seconds, "uses": given.uses, "seed": given.seed}
    try:
        entry = registry.load(given.task)
        task = entry.make(**registry.options_from(entry, given.options))
        with Loop(task, journal=given.journal, **budget) as session:
            for answer in answers(session, iter(sys.stdin.readline, "")):
                sys.stdout.write(answer)
                sys.stdout.flush()
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
