"""Tasks of finitely many unknowns, designs and outcomes, and their exact belief."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike, NDArray

from jaxcal.adaptive import grid_tables as checked
from jaxcal.adaptive.session import Options, Session, pays
from jaxcal.checks import Array, whole_number

_SMALL = 1e-30  # probability whose logarithm is still finite in float32
_NO_LIMIT = 1e30  # seconds, uses


@struct.dataclass
class GridBelief:
    """The exact posterior over S values of the unknown."""

    weights: jax.Array  # (S,) sum to one

    def predictive(self, task: GridTask) -> jax.Array:
        """(A, Y) probability of every outcome of every design."""
        return task.by_design([part.likelihood @ w for part, w in self._parts(task)])

    def _parts(self, task: GridTask) -> list[tuple[Part, jax.Array]]:
        """The task's parts with the (K,) marginal that each depends on."""
        grid = self.weights.reshape(task.shape)
        axes = set(range(len(task.shape)))
        return [
            (part, grid.sum(tuple(axes - set(part.axes))).ravel())
            for part in task.parts
        ]

    def gains(
        self,
        task: GridTask,
        options: Options | None = None,
        key: jax.Array | None = None,
    ) -> jax.Array:
        """(A,) nats: entropy of the outcome less its entropy if theta were known."""
        p = self.predictive(task)
        outcome = -(p * jnp.log(p + _SMALL)).sum(axis=-1)
        noise = [(part.p_log_p @ w).sum(axis=-1) for part, w in self._parts(task)]
        return jnp.maximum(outcome + task.by_design(noise), 0.0)

    def gain(
        self, task: GridTask, design: jax.Array, key: jax.Array | None = None
    ) -> jax.Array:
        """() nats of one design, that of ``gains``, which are exact."""
        return self.gains(task)[design]

    def entropies_after(self, task: GridTask) -> jax.Array:
        """(A, Y) nats: posterior entropy of the coordinates a design depends on."""

        def of(part: Part, w: jax.Array) -> jax.Array:
            p = part.likelihood @ w + _SMALL
            known = part.likelihood @ (w * jnp.log(w + _SMALL)) + part.p_log_p @ w
            return jnp.maximum(jnp.log(p) - known / p, 0.0)

        return task.by_design([of(part, w) for part, w in self._parts(task)])

    def update(
        self,
        task: GridTask,
        design: jax.Array,
        outcome: jax.Array,
        key: jax.Array | None = None,
    ) -> GridBelief:
        """The belief after a measurement."""
        weights = self.weights * task.likelihood[design, outcome]
        return GridBelief(weights / (weights.sum() + _SMALL))

    def draw(self, key: jax.Array) -> jax.Array:
        """() int32 a value of the unknown, drawn."""
        below = jnp.cumsum(self.weights)
        at = jax.random.uniform(key) * below[-1]
        index = jnp.searchsorted(below, at, side="right")
        return jnp.minimum(index, len(below) - 1).astype(jnp.int32)

    def outcomes(
        self, task: GridTask, design: jax.Array, key: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """(Y,) all outcomes of a design and (Y,) their probabilities."""
        p = task.likelihood[design] @ self.weights
        return jnp.arange(len(p)), p

    def entropy(self) -> jax.Array:
        """() nats."""
        return -(self.weights * jnp.log(self.weights + _SMALL)).sum()

    def log_density(self, truth: jax.Array) -> jax.Array:
        """() log probability of the truth, an index in [0, S)."""
        return jnp.log(self.weights[truth] + _SMALL)


@struct.dataclass
class Part:
    """Designs whose outcomes depend on the same coordinates of theta, and on no other.

    Their gains follow from the marginal over those coordinates, which is far shorter
    than the belief: 32 values in place of 1,024 in ``tasks.knee``.
    """

    likelihood: jax.Array  # (A', Y, K)
    p_log_p: jax.Array  # (A', Y, K) of the likelihood
    axes: tuple[int, ...] = struct.field(pytree_node=False)


@struct.dataclass
class GridTask:
    """S values of theta, A designs, Y outcomes, P places; made by ``make``.

    A design is an index in [0, A), an outcome one in [0, Y), the truth one in [0, S).
    """

    theta: jax.Array  # (S, d)
    prior: jax.Array  # (S,) sums to one
    designs: jax.Array  # (A, e) coordinates, for users and features
    likelihood: jax.Array  # (A, Y, S)
    parts: tuple[Part, ...]  # the same likelihood, by what designs depend on
    order: jax.Array  # (A,) int32 where each design is among those of the parts
    travel: jax.Array  # (P, A) seconds from a place until a design is measured
    place_after: jax.Array  # (A, Y) int32
    extra: jax.Array  # (A, Y) seconds that an outcome costs
    uses: jax.Array  # (A, Y) int32 that an outcome takes of a countable resource
    most_extra: jax.Array  # (A,) largest ``extra`` of an outcome that is possible
    most_uses: jax.Array  # (A,) int32 largest ``uses`` of an outcome that is possible
    seconds: jax.Array  # (2,) budget of a session, uniform between the two
    num_uses: jax.Array  # (E,) int32 equally likely budgets
    place: jax.Array  # () int32 at the start
    groups: jax.Array  # (A,) int32 group of each design, such as its joint
    num_groups: int = struct.field(pytree_node=False)
    shape: tuple[int, ...] = struct.field(pytree_node=False)  # of theta as a grid
    horizon: int = struct.field(pytree_node=False)
    overrun: bool = struct.field(pytree_node=False)  # the last one may cost too much
    theta_names: tuple[str, ...] = struct.field(pytree_node=False)

    @staticmethod
    def make(
        theta: ArrayLike,
        designs: ArrayLike,
        likelihood: ArrayLike,
        *,
        prior: ArrayLike | None = None,
        travel: ArrayLike = 0.0,
        place_after: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        extra: ArrayLike = 0.0,
        uses: ArrayLike = 0,
        seconds: float | tuple[float, float] = np.inf,
        num_uses: int | Sequence[int] = 1,
        horizon: int,
        overrun: bool = False,
        theta_names: Sequence[str] = (),
    ) -> GridTask:
        """Check the tables of a task; a ValueError names the table, rule and value.

        Args:
            theta: (S, d) or (S,) values that the unknown may have.
            designs: (A, e) or (A,) what may be measured.
            likelihood: (A, Y, S) probability of each outcome.
            prior: (S,) weights; equal when not given.
            travel: seconds from a place to a measured design: a number, (A,) or
                (P, A). Places 0 to A - 1 are the designs, others are the task's own.
                Where it is not (P, A), a place A is added. A session starts at the
                last place.
            place_after: (A, Y) place after an outcome; the design itself by default.
            groups: (A,) group of each design from 0, such as its joint; a shortlist
                holds the best of each group. One group by default.
            extra: (A, Y), or what broadcasts to it, seconds that an outcome costs.
            uses: (A, Y), or what broadcasts to it, of a countable resource.
            seconds: budget of a session, or (least, most) to draw it from.
            num_uses: uses that end a session, or the list it is drawn from.
            horizon: measurements after which a session ends in any case.
            overrun: True: a measurement may begin while any time and uses are left. By
                default none that could exceed what is left; a session in which all
                could is over.
        """
        at, grid = checked.columns("designs", designs), checked.columns("theta", theta)
        table = checked.probabilities(likelihood, at, grid)
        weights, possible = checked.weights(prior, table)
        shape, lengths = table.shape[:2], checked.grid(grid)
        times, after = checked.places(travel, place_after, shape)
        more = checked.costs("extra", extra, shape)
        used = checked.costs("uses", uses, shape)
        group = checked.groups(groups, len(at))
        parts, order = _split(table, lengths)
        task = GridTask(
            theta=checked.single(grid),
            prior=checked.single(weights / weights.sum()),
            designs=checked.single(at),
            likelihood=checked.single(table),
            parts=parts,
            order=checked.whole(order),
            travel=checked.single(times),
            place_after=checked.whole(after),
            extra=checked.single(more),
            uses=checked.whole(used),
            most_extra=checked.single(np.where(possible, more, 0.0).max(axis=1)),
            most_uses=checked.whole(np.where(possible, used, 0.0).max(axis=1)),
            seconds=checked.single(checked.seconds(seconds)),
            num_uses=checked.whole(checked.ends(num_uses)),
            place=checked.whole(len(times) - 1),
            groups=checked.whole(group),
            num_groups=int(group.max()) + 1,
            shape=lengths,
            horizon=whole_number("horizon", horizon, 1),
            overrun=bool(overrun),
            theta_names=checked.names(theta_names, grid.shape[1]),
        )
        _require_affordable(task)
        return task

    def by_design(self, of_parts: Sequence[jax.Array]) -> jax.Array:
        """(A, ...) values in the order of designs, from those of parts (A', ...)."""
        if len(of_parts) == 1:
            return of_parts[0]
        return jnp.concatenate(of_parts)[self.order]

    def draw(self, key: jax.Array) -> jax.Array:
        """() int32 index of the truth."""
        return GridBelief(self.prior).draw(key)

    def begin(self, key: jax.Array) -> tuple[GridBelief, Session]:
        """The prior, and a session with a random budget."""
        key_seconds, key_uses = jax.random.split(key)
        low, high = self.seconds
        spread = jnp.where(jnp.isfinite(high), high - low, 0.0)
        seconds = low + spread * jax.random.uniform(key_seconds)
        uses = jax.random.choice(key_uses, self.num_uses)
        return GridBelief(self.prior), self.session(seconds, uses)

    def session(self, seconds: Any, uses: Any) -> Session:
        """A session with this budget."""
        return Session(
            place=self.place,
            seconds=jnp.asarray(seconds, jnp.float32),
            uses=jnp.asarray(uses, jnp.int32),
            made=jnp.int32(0),
        )

    def options(
        self,
        belief: GridBelief | None,
        session: Session,
        key: jax.Array | None = None,
    ) -> Options:
        """All designs; allowed are those that what is left pays for."""
        return Options(
            designs=jnp.arange(len(self.designs)),
            seconds=self.travel[session.place],
            allowed=self.payable(session),
        )

    def payable(self, session: Session) -> jax.Array:
        """(A,) bool: what is left pays for the measurement, whatever its outcome."""
        extra, uses = self.limits
        cost = self.travel[session.place] + extra
        return pays(session.seconds, cost) & (uses <= session.uses)

    def over(self, session: Session) -> jax.Array:
        """() bool: nothing is left, or nothing that it pays for."""
        ended = session.spent | (session.made >= self.horizon)
        return ended | ~self.options(None, session).allowed.any()

    @property
    def limits(self) -> tuple[jax.Array, jax.Array]:
        """(A,) extra seconds and (A,) uses for which something must be left."""
        most = self.most_extra, self.most_uses.astype(jnp.float32)
        if not self.overrun:
            return most
        return jnp.full_like(most[0], -_NO_LIMIT), jnp.full_like(most[1], -_NO_LIMIT)

    def measure(self, truth: jax.Array, design: jax.Array, key: jax.Array) -> jax.Array:
        """() int32 outcome, drawn."""
        below = jnp.cumsum(self.likelihood[design, :, truth])[:-1]
        return (jax.random.uniform(key) >= below).sum().astype(jnp.int32)

    def spend(self, session: Session, design: jax.Array, outcome: jax.Array) -> Session:
        """The session after a measurement."""
        took = self.travel[session.place, design] + self.extra[design, outcome]
        return Session(
            place=self.place_after[design, outcome],
            seconds=session.seconds - took,
            uses=session.uses - self.uses[design, outcome],
            made=session.made + 1,
        )

    def expected(
        self, belief: GridBelief, session: Session, options: Options
    ) -> tuple[jax.Array, jax.Array]:
        """(A,) seconds and (A,) uses that each measurement is expected to take."""
        p = belief.predictive(self)
        uses = (p * self.uses).sum(axis=-1)
        return options.seconds + (p * self.extra).sum(axis=-1), uses


def _require_affordable(task: GridTask) -> None:
    """The smallest budget must pay for a first measurement."""
    if task.overrun:
        return
    seconds, uses = float(task.seconds[0]), int(np.min(task.num_uses))
    cost = np.asarray(task.travel)[int(task.place)] + np.asarray(task.most_extra)
    needs = np.asarray(task.most_uses)
    if not (np.asarray(pays(seconds, cost)) & (needs <= uses)).any():
        cheapest = int(np.lexsort((cost, needs > uses))[0])
        raise ValueError(
            "seconds and num_uses do not suffice for a first measurement with every "
            f"outcome: the cheapest, design {cheapest}, takes up to {cost[cheapest]:g} "
            f"s and {needs[cheapest]} uses, of {seconds:g} s and {uses}; overrun=True "
            "lets the last one exceed the budget"
        )


def _split(
    table: Array, shape: tuple[int, ...]
) -> tuple[tuple[Part, ...], NDArray[np.int64]]:
    """Parts of a likelihood (A, Y, S), and where each design is among theirs."""
    grid = table.reshape(*table.shape[:2], *shape)
    varies = [
        (grid != grid.take([0], axis=2 + i)).any(axis=tuple(range(1, grid.ndim)))
        for i in range(len(shape))
    ]
    members: dict[tuple[int, ...], list[int]] = {}
    for design, which in enumerate(np.stack(varies, axis=1)):
        members.setdefault(tuple(np.flatnonzero(which).tolist()), []).append(design)
    parts = []
    for axes, designs in members.items():
        whole = slice(None)
        first = [whole if i in axes else 0 for i in range(len(shape))]
        mine = grid[designs][(whole, whole, *first)]
        mine = mine.reshape(len(designs), table.shape[1], -1)
        product = mine * np.log(np.where(mine > 0.0, mine, 1.0))
        parts.append(Part(checked.single(mine), checked.single(product), axes))
    return tuple(parts), np.argsort(np.concatenate(list(members.values())))
