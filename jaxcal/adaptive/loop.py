"""The next measurement for a user who makes it, the closed loop, what is known then."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.history import (
    after,
    begin,
    checked_entry,
    from_leaves,
    step_keys,
    what_is_left,
)
from jaxcal.adaptive.lookahead import fit
from jaxcal.adaptive.particles import ParticleBelief
from jaxcal.adaptive.rules import SHARES, Gain
from jaxcal.adaptive.session import (
    Decider,
    SequentialTask,
    Session,
    fingerprint,
    jit_by_class,
)
from jaxcal.checks import Array
from jaxcal.jsonlines import JsonLines, Record

History = Iterable[tuple[Any, Any]]  # (design, outcome) of each measurement, in order

_KIND = "jaxcal adaptive session"  # of a journal
_DRAWS = 32  # of the gain that is told, which a single one leaves uncertain by a third


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


def next_measurement(
    task: SequentialTask,
    history: History = (),
    decider: Decider | None = None,
    *,
    seconds: float | None = None,
    uses: int | None = None,
    seed: int = 0,
) -> Proposal:
    """What to measure next, given what was measured; a ValueError names, by its number,
    an entry of the history that cannot be.

    Args:
        task: what is unknown and what may be measured.
        history: (design, outcome) of each measurement in order. A design is an index of
            ``task.designs`` (a whole number) or its coordinates.
        decider: when not given, the largest expected gain; where time or uses count,
            what ``lookahead.fit`` finds for the task and this budget, in some seconds
            at the first call.
        seconds: budget of the whole session; the task's when not given.
        uses: budget of the countable resource; the task's when not given.
        seed: of random draws; the same arguments give the same proposal.
    """
    with Loop(task, decider, seconds=seconds, uses=uses, seed=seed) as loop:
        loop.follow(history)
        return loop.suggest()


def run(
    task: SequentialTask,
    decider: Decider | None,
    measure: Callable[[Proposal], Any],
    *,
    journal: str | os.PathLike[str] | None = None,
    **budget: Any,
) -> Loop:
    """Propose, measure, update, until the budget is spent; the loop at its end.

    Args:
        task, decider: as in ``next_measurement``.
        measure: makes the measurement and returns its outcome; whatever it raises ends
            the loop, and what was measured before is in the journal.
        journal: file of the session. Where it is there the session goes on as if it had
            not been interrupted.
        budget: ``seconds``, ``uses`` and ``seed`` of ``next_measurement``.

    Raises:
        ValueError: the journal is of another task, decider or budget; an outcome is not
            one of the task's, or cannot follow what was measured before.
    """
    with Loop(task, decider, journal=journal, **budget) as loop:
        while (proposal := loop.suggest()).design is not None:
            loop.observed(measure(proposal))
        return loop


class Loop:
    """A session step by step, for a program that has its own loop.

    It holds ``history``, pairs (design, outcome), ``belief`` and ``session``. Arguments
    and errors are those of ``run``.
    """

    def __init__(
        self,
        task: SequentialTask,
        decider: Decider | None = None,
        *,
        journal: str | os.PathLike[str] | None = None,
        seconds: float | None = None,
        uses: int | None = None,
        seed: int = 0,
    ) -> None:
        self.task, self._seed = task, seed
        self.belief, self.session = begin(task, seconds, uses, seed)
        self.history: list[tuple[Any, Any]] = []
        budget = float(self.session.seconds)
        header = {
            "task": fingerprint(task),
            "decider": fingerprint(decider),
            "seconds": budget if math.isfinite(budget) else "no limit",
            "uses": int(self.session.uses),
            "seed": seed,
        }
        self._decider = _default(task, self.session) if decider is None else decider
        self._proposal: Proposal | None = None
        self._journal = None if journal is None else _opened(journal, header)
        lines = [] if self._journal is None else self._journal.records[1:]
        try:
            self.follow(
                (from_leaves(self, line["design"]), line["outcome"]) for line in lines
            )
        except BaseException:
            self.close()
            raise

    def follow(self, history: History) -> None:
        """Take measurements that were made before, which no journal notes; a ValueError
        names, by its number from 0, an entry that cannot be."""
        for number, entry in enumerate(history):
            where = f"history[{number}]"
            try:
                design, outcome = entry
            except (TypeError, ValueError):
                raise ValueError(
                    f"{where} must be a pair (design, outcome), got {entry!r}"
                ) from None
            if bool(self.session.spent):
                raise ValueError(
                    f"{where} was measured after the budget was used up: "
                    f"{what_is_left(self.session)}"
                )
            self._advance(checked_entry(self, design, outcome, where))

    def _advance(self, entry: tuple[Any, Any]) -> None:
        key = step_keys(self._seed, int(self.session.made))[2]
        state = self.task, self.belief, self.session
        self.belief, self.session = after(*state, *entry, key)
        self.history.append(entry)
        self._proposal = None

    def suggest(self) -> Proposal:
        """What to measure next; its design is None where the session is over."""
        self._proposal = self._proposal or self._proposed()
        return self._proposal

    def _proposed(self) -> Proposal:
        task, belief, session = self.task, self.belief, self.session
        number = int(session.made)
        end = Proposal(None, None, 0.0, 0.0, 0.0, number, belief, session)
        if bool(task.over(session)):
            return end
        keys = step_keys(self._seed, number)
        design, gain, took, uses, payable = _choose(
            task, self._decider, belief, session, keys
        )
        if not took >= 0.0:
            raise ValueError(f"a measurement costs at least 0 s, got {float(took):g}")
        if not payable:
            return end
        coordinates = design = jax.tree.map(np.asarray, design)
        if (table := getattr(task, "designs", None)) is not None:
            design = int(design)
            coordinates = np.asarray(table[design])
        numbers = float(gain), float(took), float(uses)
        return Proposal(design, coordinates, *numbers, number, belief, session)

    def observed(self, outcome: Any, design: Any = None) -> None:
        """Take an outcome: of what was suggested, or of another design that was made;
        it is in the journal when this returns. A ValueError says that the session is
        over, or that the design or the outcome cannot be."""
        where = f"measurement {int(self.session.made)}"
        if design is None:
            design = self.suggest().design
        if design is None or bool(self.task.over(self.session)):
            raise ValueError(f"{where}: the session is over")
        entry = checked_entry(self, design, outcome, where)
        if self._journal is not None:
            line = {"design": _leaves(entry[0]), "outcome": _leaves(entry[1])[0]}
            self._journal.append(lambda: line, sync=True)
        self._advance(entry)

    def close(self) -> None:
        """Let another process write the journal."""
        if self._journal is not None:
            self._journal.close()

    def __enter__(self) -> Loop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _default(task: SequentialTask, session: Session) -> Decider:
    counted = isinstance(task, GridTask) and bool((task.uses > 0).any())
    if not (math.isfinite(session.seconds) or counted):
        return Gain()
    if type(task) is not GridTask:
        return SHARES
    return fit(task, float(session.seconds), int(session.uses))


def _opened(path: str | os.PathLike[str], header: Record) -> JsonLines:
    """A journal: a header, which says what is measured and how, then measurements; a
    ValueError where the file is of another task, decider or budget, damaged, or another
    process is writing it."""
    header = {"kind": _KIND, "version": 1, **header}

    def whole(number: int, record: Record) -> bool:
        return number == 0 or {"design", "outcome"} <= record.keys()

    def check(records: list[Record]) -> None:
        if not records:
            return
        if records[0].get("kind") != _KIND:
            raise ValueError(f"{path} is not a journal of a session")
        for name, value in header.items():
            if (written := records[0].get(name)) != value:
                raise ValueError(
                    f"{path} is of a session with another {name}: {written!r}, "
                    f"not {value!r}. Use another path, or the same {name}"
                )

    lines = JsonLines(path, whole, check)
    if not lines.records:
        lines.append(lambda: header, sync=True)
    return lines


@jit_by_class
def _choose(
    task: SequentialTask,
    decider: Decider,
    belief: Any,
    session: Session,
    keys: jax.Array,
) -> tuple[Any, ...]:
    key_options, key_choice, _, key_gain = keys
    options = task.options(belief, session, key_options)
    index = decider(task, belief, session, options, key_choice)
    seconds, uses = task.expected(belief, session, options)
    design = jax.tree.map(lambda leaf: leaf[index], options.designs)
    draws = jax.random.split(key_gain, _DRAWS)
    gain = jax.vmap(lambda key: belief.gain(task, design, key))(draws).mean()
    return design, gain, seconds[index], uses[index], options.allowed.any()


def _leaves(value: Any) -> list[Any]:
    return [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(value)]


# -- what is known ---------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One unknown."""

    mean: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width of the interval."""
        return self.high - self.low


def estimates(task: Any, belief: Any, level: float = 0.95) -> dict[str, Estimate]:
    """Mean and equal-tailed interval of each unknown, by name.

    On a grid each value of theta stands for a cell that ends half way to the next
    value, with a uniform density. Of a ``ParticleTask`` the model must have ``names``
    of its unknowns, as one made by ``ParticleTask.of`` has.

    Args:
        task: whose unknowns they are.
        belief: after some measurements.
        level: probability that the unknown lies in the interval.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level:g}")
    tails = (0.5 - level / 2.0, 0.5 + level / 2.0)
    if isinstance(belief, ParticleBelief):
        return _of_particles(belief, tails)
    weights = np.asarray(belief.weights, np.float64)
    columns = np.asarray(task.theta, np.float64).T
    return {
        name: _of_cells(values, weights, tails)
        for name, values in zip(task.theta_names, columns, strict=True)
    }


def _of_cells(values: Array, weights: Array, tails: tuple[float, float]) -> Estimate:
    cells, cell = np.unique(values, return_inverse=True)
    mass = np.bincount(cell, weights=weights) / weights.sum()
    middle = (cells[1:] + cells[:-1]) / 2.0
    first, last = cells[0], cells[-1]
    if len(cells) > 1:
        first, last = 2.0 * first - middle[0], 2.0 * last - middle[-1]
    edges = np.concatenate([[first], middle, [last]])
    below = np.concatenate([[0.0], np.cumsum(mass)])
    # Quantiles of the piecewise linear distribution function.
    low, high = np.interp(tails, below, edges)
    return Estimate(float(mass @ cells), float(low), float(high))


def _of_particles(
    belief: ParticleBelief, tails: tuple[float, float]
) -> dict[str, Estimate]:
    names = getattr(belief.model, "names", None)
    if names is None:
        raise ValueError("the task's model must have names of its unknowns")
    unknowns = np.asarray(jax.vmap(belief.model.unknowns)(belief.z), np.float64)
    weights = np.exp(np.asarray(belief.log_weight, np.float64))
    weights /= weights.sum()
    estimate_of = {}
    for name, values in zip(names, unknowns.T, strict=True):
        order = np.argsort(values)
        # Half of a particle's weight lies below it.
        below = np.cumsum(weights[order]) - weights[order] / 2.0
        low, high = np.interp(tails, below, values[order])
        estimate_of[name] = Estimate(float(weights @ values), float(low), float(high))
    return estimate_of
