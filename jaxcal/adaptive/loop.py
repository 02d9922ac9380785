"""The next measurement for a user who makes it, and the closed loop."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxcal.adaptive.fit_ahead import fit, outside
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.history import (
    History,
    StepKeys,
    after,
    begin,
    checked,
    from_leaves,
    replay,
    step_keys,
)
from jaxcal.adaptive.journal import Journal, fingerprint
from jaxcal.adaptive.lookahead import AHEAD
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.session import Decider, Session, Task

__all__ = ["Finished", "Proposal", "next_measurement", "run"]


@dataclasses.dataclass(frozen=True)
class Proposal:
    """What to measure next, its expected gain and cost, and the present belief."""

    design: Any  # an index where the task has a table of designs; None: session is over
    coordinates: Any  # the design itself, (e,); None: session is over
    gain: float  # expected information gain, nats
    seconds: float  # expected
    uses: float  # expected
    number: int  # measurements made before it
    belief: Any
    session: Session  # what is left
    outside: tuple[str, ...]  # ``fit_ahead.outside``; empty where a decider was given


@dataclasses.dataclass(frozen=True)
class Finished:
    """A session that has ended."""

    history: list[tuple[Any, Any]]  # (design, outcome)
    belief: Any
    session: Session


def next_measurement(
    task: Task,
    history: History = (),
    decider: Decider | None = None,
    *,
    seconds: float | None = None,
    uses: int | None = None,
    seed: int = 0,
) -> Proposal:
    """What to measure next, given what was measured.

    Args:
        task: what is unknown and what may be measured.
        history: (design, outcome) of each measurement in order. A design is an index of
            ``task.designs`` (a whole number) or its coordinates.
        decider: when not given, the largest expected gain; where time or uses count,
            what ``fit_ahead.fit`` finds for the task and this budget, in some seconds
            at the first call.
        seconds: budget of the whole session; the task's when not given.
        uses: budget of the countable resource, likewise.
        seed: of random draws; the same arguments give the same proposal.

    Raises:
        ValueError: an entry of the history that cannot be, by its number.
    """
    belief, session = begin(task, seconds, uses, seed)
    beyond = outside(task) if decider is None else ()
    decider = _default(task, session) if decider is None else decider
    belief, session, _ = replay(task, history, belief, session, seed)
    return _proposal(task, decider, belief, session, seed, beyond)


def run(
    task: Task,
    decider: Decider | None,
    measure: Callable[[Proposal], Any],
    *,
    journal: str | os.PathLike[str] | None = None,
    seconds: float | None = None,
    uses: int | None = None,
    seed: int = 0,
    enough: Callable[[Proposal], bool] = lambda proposal: False,
) -> Finished:
    """Propose, measure, update, until the budget is spent.

    Args:
        task, decider, seconds, uses, seed: as in ``next_measurement``.
        measure: makes the measurement and returns its outcome; whatever it raises ends
            the loop, and what was measured before is in the journal.
        journal: file of the session. Where it is there the session goes on as if it had
            not been interrupted.
        enough: asked before each measurement; True ends the session.

    Raises:
        ValueError: the journal is of another task, decider or budget; an outcome is not
            one of the task's, or cannot follow what was measured before.
    """
    belief, session = begin(task, seconds, uses, seed)
    header = {
        "task": fingerprint(task),
        "decider": fingerprint(decider),
        "seconds": _budget(float(session.seconds)),
        "uses": int(session.uses),
        "seed": seed,
    }
    beyond = outside(task) if decider is None else ()
    decider = _default(task, session) if decider is None else decider
    file = None if journal is None else Journal(journal, header)
    try:
        kept = [] if file is None else file.entries
        made = [
            (from_leaves(task, belief, session, each["design"]), each["outcome"])
            for each in kept
        ]
        belief, session, entries = replay(task, made, belief, session, seed)
        while True:
            proposal = _proposal(task, decider, belief, session, seed, beyond)
            if proposal.design is None or enough(proposal):
                return Finished(entries, belief, session)
            outcome = measure(proposal)
            where = f"measurement {proposal.number}"
            entry = checked(task, belief, session, proposal.design, outcome, where)
            if file is not None:
                file.append(design=_leaves(entry[0]), outcome=_leaves(entry[1])[0])
            key = step_keys(seed, proposal.number).update
            belief, session = after(task, belief, session, *entry, key)
            entries.append(entry)
    finally:
        if file is not None:
            file.close()


def _default(task: Task, session: Session) -> Decider:
    counted = isinstance(task, GridTask) and bool((task.uses > 0).any())
    if not (math.isfinite(session.seconds) or counted):
        return Gain()
    if type(task) is not GridTask:  # a kind of its own may not allow every design
        return AHEAD
    return fit(task, float(session.seconds), int(session.uses)).decider


def _proposal(
    task: Task,
    decider: Decider,
    belief: Any,
    session: Session,
    seed: int,
    beyond: tuple[str, ...],
) -> Proposal:
    number = int(session.made)
    if bool(task.over(session)):
        return Proposal(None, None, 0.0, 0.0, 0.0, number, belief, session, beyond)
    keys = step_keys(seed, number)
    design, gain, took, uses, any_left = _choose(task, decider, belief, session, keys)
    if not took >= 0.0:
        raise ValueError(f"a measurement must cost at least 0 s, got {float(took):g}")
    if not any_left:
        return Proposal(None, None, 0.0, 0.0, 0.0, number, belief, session, beyond)
    table = getattr(task, "designs", None)
    design = jax.tree.map(np.asarray, design)
    coordinates = design if table is None else np.asarray(table[int(design)])
    return Proposal(
        design if table is None else int(design), coordinates,
        float(gain), float(took), float(uses), number, belief, session, beyond,
    )  # fmt: skip


@jax.jit
def _choose(
    task: Task,
    decider: Decider,
    belief: Any,
    session: Session,
    keys: StepKeys,
) -> tuple[Any, ...]:
    options = task.options(belief, session, keys.options)
    index = decider(task, belief, session, options, keys.choice)
    seconds, uses = task.expected(belief, session, options)
    design = jax.tree.map(lambda leaf: leaf[index], options.designs)
    gain = belief.gain(task, design, keys.gain)
    return design, gain, seconds[index], uses[index], options.allowed.any()


def _budget(seconds: float) -> float | str:
    return seconds if math.isfinite(seconds) else "no limit"


def _leaves(value: Any) -> list[Any]:
    """Numbers, or lists of them, for JSON."""
    return [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(value)]
