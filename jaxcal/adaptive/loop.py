"""The next measurement for a user who makes it, the closed loop, what is known then."""

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
    checked_entry,
    from_leaves,
    replay,
    step_keys,
)
from jaxcal.adaptive.journal import fingerprint, open_journal
from jaxcal.adaptive.lookahead import AHEAD
from jaxcal.adaptive.particles import ParticleBelief
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.session import Decider, SequentialTask, Session, jit_by_class
from jaxcal.checks import Array

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
    outside: tuple[str, ...]  # ``fit_ahead.outside``; empty where a decider was given


@dataclasses.dataclass(frozen=True)
class SessionResult:
    """A session that has ended."""

    history: list[tuple[Any, Any]]  # (design, outcome)
    belief: Any
    session: Session


def next_measurement(
    task: SequentialTask,
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
        uses: budget of the countable resource; the task's when not given.
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
    task: SequentialTask,
    decider: Decider | None,
    measure: Callable[[Proposal], Any],
    *,
    journal: str | os.PathLike[str] | None = None,
    seconds: float | None = None,
    uses: int | None = None,
    seed: int = 0,
) -> SessionResult:
    """Propose, measure, update, until the budget is spent.

    Args:
        task, decider, seconds, uses, seed: as in ``next_measurement``.
        measure: makes the measurement and returns its outcome; whatever it raises ends
            the loop, and what was measured before is in the journal.
        journal: file of the session. Where it is there the session goes on as if it had
            not been interrupted.

    Raises:
        ValueError: the journal is of another task, decider or budget; an outcome is not
            one of the task's, or cannot follow what was measured before.
    """
    with Loop(
        task, decider, journal=journal, seconds=seconds, uses=uses, seed=seed
    ) as loop:
        while True:
            proposal = loop.suggest()
            if proposal.design is None:
                return SessionResult(loop.history, loop.belief, loop.session)
            loop.observed(measure(proposal))


class Loop:
    """A session step by step, for a program that has its own loop; see ``run``.

    Args:
        task, decider, journal, seconds, uses, seed: as of ``run``.

    Raises:
        ValueError: as ``run``.
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
        belief, session = begin(task, seconds, uses, seed)
        budget = float(session.seconds)
        header = {
            "task": fingerprint(task),
            "decider": fingerprint(decider),
            "seconds": budget if math.isfinite(budget) else "no limit",
            "uses": int(session.uses),
            "seed": seed,
        }
        self._outside = outside(task) if decider is None else ()
        self._decider = _default(task, session) if decider is None else decider
        self._journal = None if journal is None else open_journal(journal, header)
        try:
            lines = [] if self._journal is None else self._journal.records[1:]
            made = [
                (from_leaves(task, belief, session, line["design"]), line["outcome"])
                for line in lines
            ]
            self.belief, self.session, self.history = replay(
                task, made, belief, session, seed
            )
        except BaseException:
            self.close()
            raise
        self._proposal: Proposal | None = None

    def suggest(self) -> Proposal:
        """What to measure next; its design is None where the session is over."""
        if self._proposal is None:
            self._proposal = _proposal(
                self.task, self._decider, self.belief, self.session, self._seed,
                self._outside,
            )  # fmt: skip
        return self._proposal

    def observed(self, outcome: Any, design: Any = None) -> None:
        """Take an outcome: of what was suggested, or of another design that was made.

        It is in the journal when this returns.

        Raises:
            ValueError: the session is over, or the design or the outcome cannot be.
        """
        number = int(self.session.made)
        if design is None:
            design = self.suggest().design
        if design is None or bool(self.task.over(self.session)):
            raise ValueError(f"measurement {number}: the session is over")
        entry = checked_entry(
            self.task, self.belief, self.session, design, outcome,
            f"measurement {number}",
        )  # fmt: skip
        if self._journal is not None:
            line = {"design": _leaves(entry[0]), "outcome": _leaves(entry[1])[0]}
            self._journal.append(lambda: line, sync=True)
        key = step_keys(self._seed, number).update
        self.belief, self.session = after(
            self.task, self.belief, self.session, *entry, key
        )
        self.history.append(entry)
        self._proposal = None

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
    if type(task) is not GridTask:  # a kind of its own may not allow every design
        return AHEAD
    return fit(task, float(session.seconds), int(session.uses)).decider


def _proposal(
    task: SequentialTask,
    decider: Decider,
    belief: Any,
    session: Session,
    seed: int,
    beyond: tuple[str, ...],
) -> Proposal:
    number = int(session.made)
    end = Proposal(None, None, 0.0, 0.0, 0.0, number, belief, session, beyond)
    if bool(task.over(session)):
        return end
    keys = step_keys(seed, number)
    design, gain, took, uses, any_left = _choose(task, decider, belief, session, keys)
    if not took >= 0.0:
        raise ValueError(f"a measurement costs at least 0 s, got {float(took):g}")
    if not any_left:
        return end
    table = getattr(task, "designs", None)
    design = jax.tree.map(np.asarray, design)
    coordinates = design if table is None else np.asarray(table[int(design)])
    return Proposal(
        design if table is None else int(design), coordinates,
        float(gain), float(took), float(uses), number, belief, session, beyond,
    )  # fmt: skip


@jit_by_class
def _choose(
    task: SequentialTask,
    decider: Decider,
    belief: Any,
    session: Session,
    keys: StepKeys,
) -> tuple[Any, ...]:
    options = task.options(belief, session, keys.options)
    index = decider(task, belief, session, options, keys.choice)
    seconds, uses = task.expected(belief, session, options)
    design = jax.tree.map(lambda leaf: leaf[index], options.designs)
    draws = jax.random.split(keys.gain, _DRAWS)
    gain = jax.vmap(lambda key: belief.gain(task, design, key))(draws).mean()
    return design, gain, seconds[index], uses[index], options.allowed.any()


def _leaves(value: Any) -> list[Any]:
    """Numbers, or lists of them, for JSON."""
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
    first, last = (
        (2.0 * cells[0] - middle[0], 2.0 * cells[-1] - middle[-1])
        if len(cells) > 1
        else (cells[0], cells[0])
    )
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
