"""Several chains in one model: two arms on a torso, a positioner beside an arm."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components

from jaxcal.arms.arm import COLUMNS, WAVES, common
from jaxcal.arms.chain import SerialChain
from jaxcal.arms.fitting import ChainsFitting
from jaxcal.arms.sensors import Sensor
from jaxcal.arms.sensors.sensor import BASE, Readings, label
from jaxcal.arms.sensors.several import OneTable, stacked
from jaxcal.checks import Array, one_of
from jaxcal.files import AnyPath
from jaxcal.late import late
from jaxcal.models.model import Model, Rows, Theta, as_commands, as_parameters
from jaxcal.models.uncertainty import Noise, Prior

ChainTable = tuple[int, Array, Array | None]  # which, its commands, what it read


@dataclasses.dataclass(frozen=True, eq=False)
class Chains(Model):
    """Chains by the names of their tips; shared parameters occur once.

    Chains that begin with the same joints (a torso's) share their columns, and the
    parameters of the links between; a sensor that is given to several chains as one
    object is one, found from the arm that reads it most. All else is each chain's own,
    ``left: a3``. Commands are the columns of all joints, 0 where they are not of the
    row's chain; ``chain``, whose tip was read, from 0; and the sensors' columns.
    Readings are in units of their sensor's noise, as ``together`` makes them.

    Attributes:
        tips: names of the chains, two or more.
        chains: in this order.
        stands: of each chain the numbers of its sensor's members (itself, but of
            ``Several``), equal where two chains have one object.
    """

    # Of modules that know this one.
    write = late("jaxcal.arms.files.write:write")

    tips: tuple[str, ...]
    chains: tuple[SerialChain, ...]
    stands: tuple[tuple[int, ...], ...]

    fitting = functools.cached_property(ChainsFitting)

    @classmethod
    def of(cls, chains: Mapping[str, SerialChain]) -> Self:
        """The model of chains by the names of their tips.

        Raises:
            ValueError: there are fewer than two, or a joint is in two that differ
                before it.
        """
        tips, arms = tuple(chains), tuple(chains.values())
        if len(arms) < 2 or not all(isinstance(arm, SerialChain) for arm in arms):
            raise ValueError("chains must hold at least two arms (SerialChain), by tip")
        for k, arm in enumerate(arms):
            for other, before in zip(arms[:k], tips, strict=False):
                differing = arm.joint_names[common(other, arm) :]
                twice = set(other.joint_names).intersection(differing)
                if twice:
                    raise ValueError(
                        f"joint {sorted(twice)[0]} is in the chains {before} and "
                        f"{tips[k]}, which differ before it. Give joints of different "
                        "chains different names (joint_names)"
                    )
        numbers: dict[tuple[int, int], int] = {}  # one for one object of several chains
        stands = []
        for of_chain in (arm.sensor.members for arm in arms):
            keys = [(id(x), of_chain[:i].count(x)) for i, x in enumerate(of_chain)]
            stands.append(tuple(numbers.setdefault(key, len(numbers)) for key in keys))
        return cls(tips, arms, tuple(stands))

    @classmethod
    def from_urdf(
        cls,
        path: AnyPath,
        sensors: Mapping[str, Sensor],
        *,
        base: str | None = None,
        locked: Mapping[str, float] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> Self:
        """The chains of a URDF file from one base to several tips.

        Joints that chains share are stiff: what a torso yields by depends on all that
        it carries. The others yield as those of an arm alone do.

        Args:
            sensors: of each tip link; one object for two tips stands once.
            base, locked, limits: as of ``SerialChain.from_urdf``, of joints of any
                chain.
        """
        arms, ends = {}, dict(limits or {})
        for tip, sensor in sensors.items():
            arm = SerialChain.from_urdf(
                path, base=base, tip=tip, sensor=sensor, locked=locked
            )
            arms[tip] = arm._limited({n: ends[n] for n in arm.joint_names if n in ends})
        for name in ends:
            one_of(
                "limits", name, [n for arm in arms.values() for n in arm.joint_names]
            )
        model = cls.of(arms)
        chains = []
        for arm, shared in zip(model.chains, model._shared, strict=True):
            bending = tuple(i for i in arm.compliance if i > shared)
            yields = np.zeros(len(bending))
            chains.append(dataclasses.replace(arm, compliance=bending, yields=yields))
        return dataclasses.replace(model, chains=tuple(chains))

    @functools.cached_property
    def _shared(self) -> tuple[int, ...]:
        """(C,) leading joints of each chain that another one has too."""
        return tuple(
            max(common(arm, other) for other in self.chains if other is not arm)
            for arm in self.chains
        )

    @functools.cached_property
    def _firsts(self) -> list[int]:
        """(C,) the first chain that has the base of each."""
        arms = [*enumerate(self.chains)]
        return [next(j for j, b in arms if j == k or common(b, a)) for k, a in arms]

    @functools.cached_property
    def _members(self) -> list[list[tuple[int, int]]]:
        """Chains that have each of the sensors, and which member of theirs it is."""
        owners: dict[int, list[tuple[int, int]]] = {}
        for k, numbers in enumerate(self.stands):
            for i, number in enumerate(numbers):
                owners.setdefault(number, []).append((k, i))
        return [owners[number] for number in sorted(owners)]

    @functools.cached_property
    def _cells(self) -> NDArray[np.int32]:
        """(C,) equal for chains that show where each other stands: by joints or things
        that they share."""
        linked = np.array([[common(a, b) for b in self.chains] for a in self.chains])
        for owners in self._members:
            k, i = owners[0]
            if self.chains[k].sensor.members[i].stands:
                numbers = [number for number, _ in owners]
                linked[np.ix_(numbers, numbers)] = 1
        return np.asarray(connected_components(linked)[1])

    @functools.cached_property
    def _named(self) -> list[list[str]]:
        """Names in this model of the parameters of each chain."""
        named = []
        chains = zip(self.tips, self.chains, self._shared, strict=True)
        for k, (tip, arm, shared) in enumerate(chains):
            links = [f"{name}{i}" for i in range(1, shared) for name in COLUMNS]
            of_joint = ("gear{}", "compliance{}", *(f"theta{{}} {w}" for w in WAVES))
            joints = [n.format(i) for i in range(1, shared + 1) for n in of_joint]
            of_all = {*links, *joints, *(BASE if shared else ())}
            of_arm = [n if n in of_all else f"{tip}: {n}" for n in arm.names]
            for i, number in enumerate(self.stands[k]):
                (first, at), *others = self._members[number]
                if others:
                    names = self.chains[first].names[self.chains[first]._own(at)]
                    everywhere = len(others) == len(self.chains) - 1
                    of_first = "" if everywhere else f"{self.tips[first]}: "
                    of_arm[arm._own(i)] = [of_first + name for name in names]
            named.append(of_arm)
        return named

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """p: of chain after chain, harmonics of all last."""
        first: list[str] = []
        waves: list[str] = []
        for arm, named in zip(self.chains, self._named, strict=True):
            end = arm._at["harmonics"].start
            first, waves = first + named[:end], waves + named[end:]
        return tuple(dict.fromkeys(first + waves))

    @functools.cached_property
    def members(self) -> tuple[NDArray[np.intp], ...]:
        """Where each chain's parameters are among those of this model."""
        at = {name: i for i, name in enumerate(self.names)}
        return tuple(np.array([at[n] for n in named]) for named in self._named)

    def _gather(self, values: Sequence[Any]) -> Any:
        """(p,) from each chain's, the first chain's where they share one."""
        result = np.empty(len(self.names), dtype=np.asarray(values[0]).dtype)
        for at, of_arm in zip(self.members[::-1], values[::-1], strict=True):
            result[at] = of_arm
        return result

    def _of_arms(
        self, some: Callable[[SerialChain], Collection[str]]
    ) -> tuple[str, ...]:
        """Names here of some of each chain's parameters, those shared once."""
        names: dict[str, None] = {}
        for arm, named in zip(self.chains, self._named, strict=True):
            wanted, both = some(arm), zip(named, arm.names, strict=True)
            names |= dict.fromkeys(name for name, short in both if short in wanted)
        return tuple(names)

    def _with(
        self, sensors: Mapping[int, Sensor], arm: SerialChain, k: int
    ) -> SerialChain:
        """An arm with sensors by number."""
        for i, number in enumerate(self.stands[k]):
            if number in sensors:
                arm = arm._with_member(i, sensors[number])
        return arm

    def _with_member(self, number: int, sensor: Sensor) -> Self:
        """These chains with another sensor in the place of ``number``."""
        chains = [self._with({number: sensor}, a, k) for k, a in enumerate(self.chains)]
        return dataclasses.replace(self, chains=tuple(chains))

    def _each(self, change: Callable[[SerialChain], SerialChain]) -> Self:
        """These chains with each changed; themselves where none is."""
        arms = tuple(change(arm) for arm in self.chains)
        if all(a is b for a, b in zip(arms, self.chains, strict=True)):
            return self
        return dataclasses.replace(self, chains=arms)

    def _parts(self, commands: Array) -> Iterator[tuple[int, SerialChain, Rows, Array]]:
        """Each chain that was read and its number, its rows, its commands there."""
        which = label("chain", commands[:, len(self.joint_names)], len(self.chains))
        for k in np.unique(which).tolist():
            rows = np.flatnonzero(which == k)
            yield k, self.chains[k], rows, commands[rows][:, self._columns[k]]

    @functools.cached_property
    def _columns(self) -> tuple[list[int], ...]:
        """Columns of the commands of each chain."""
        wanted = [(*a.joint_names, *a.sensor.inputs) for a in self.chains]
        return tuple([self.inputs.index(name) for name in names] for names in wanted)

    def _scale(self, k: int) -> Array:
        """(q,) units of a chain's readings."""
        arm = self.chains[k]
        return arm.sensor.stds(arm.length or 1.0)

    def _by_member(
        self, arms: Sequence[SerialChain], tables: Sequence[ChainTable]
    ) -> dict[int, list[Readings]]:
        """What each chain read of a sensor, by its number."""
        by_member: dict[int, list[Readings]] = {}
        for k, commands, measured in tables:
            of_members = arms[k].readings(commands, measured)
            for number, readings in zip(self.stands[k], of_members, strict=True):
                by_member.setdefault(number, []).append(readings)
        return by_member

    @contextlib.contextmanager
    def _naming(self, k: int) -> Iterator[None]:
        """The chain's name before what is refused of it."""
        try:
            yield
        except ValueError as error:
            raise ValueError(f"{self.tips[k]}: {error}") from None

    @functools.cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Columns of the joints, chain after chain."""
        return tuple(dict.fromkeys(n for arm in self.chains for n in arm.joint_names))

    @functools.cached_property
    def inputs(self) -> tuple[str, ...]:
        columns = (name for arm in self.chains for name in arm.sensor.inputs)
        return (*self.joint_names, "chain", *dict.fromkeys(columns))

    @property
    def num_inputs(self) -> int:
        """n."""
        return len(self.inputs)

    @property
    def num_outputs(self) -> int:
        """q, of the sensor that reads most."""
        return max(arm.num_outputs for arm in self.chains)

    def together(
        self, tables: Mapping[str, tuple[ArrayLike, ArrayLike | None]]
    ) -> tuple[Array, Array]:
        """Commands (N, n) and readings (N, q) in noise of all chains, for a fit.

        Args:
            tables: by tip a pair: commands of that chain with its sensor's columns, and
                what it measured, or None for zeros (contacts) and candidates.
        """
        named = []
        for tip, pair in tables.items():
            k = self.tips.index(one_of("tip", tip, self.tips))
            named.append(OneTable(tip, k, self._columns[k], self._scale(k), *pair))
        return stacked(self, len(self.joint_names), named)

    @property
    def nominal(self) -> Array:
        """(p,)."""
        return np.asarray(self._gather([arm.nominal for arm in self.chains]))

    @property
    def units(self) -> tuple[str, ...]:
        """p units, as of ``SerialChain``."""
        units = [np.array(arm.units, dtype=object) for arm in self.chains]
        return tuple(self._gather(units))

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Readings (N, q) in noise, 0 beyond those of a row's sensor."""
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        values = np.zeros((len(commands), self.num_outputs))
        for k, arm, rows, arm_commands in self._parts(commands):
            read = arm.predict(arm_commands, theta[self.members[k]]) / self._scale(k)
            values[rows, : arm.num_outputs] = read
        return values

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        return self._slopes("jacobian", commands, parameters, self.members)

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        return self._slopes("command_jacobian", commands, parameters, self._columns)

    def _slopes(
        self, by: str, commands: ArrayLike, parameters: Theta, at: Any
    ) -> Array:
        commands, theta = as_commands(self, commands), as_parameters(self, parameters)
        width = len(self.names) if by == "jacobian" else self.num_inputs
        slopes = np.zeros((len(commands), self.num_outputs, width))
        for k, arm, rows, arm_commands in self._parts(commands):
            of_chain = getattr(arm, by)(arm_commands, theta[self.members[k]])
            outputs = np.arange(arm.num_outputs)
            slopes[np.ix_(rows, outputs, at[k])] = of_chain / self._scale(k)[:, None]
        return slopes

    def length_unit(self, measured_unit: str) -> str:
        """The unit of lengths, which all arms share; see ``SerialChain``."""
        return self.chains[0].length_unit(measured_unit)

    def default_noise(self) -> Noise:
        return Noise(std=1.0)

    def default_prior(self) -> Prior:
        """Prior of each chain; held is what no chain that has it sees.

        Where arms with bases of their own touch the same sockets, the first one's base
        is held, but for what another's sensor shows, and the others' are found.
        """
        priors = [arm.default_prior() for arm in self.chains]
        fixed = [set(prior.fixed) for prior in priors]
        for k, cell in enumerate(self._cells):
            alike = np.flatnonzero(self._cells == cell)
            fixed[k] -= set(BASE)
            if k == alike[0] or common(self.chains[alike[0]], self.chains[k]):
                fixed[k] |= set(BASE).intersection(*(priors[j].fixed for j in alike))
        hidden = dict(zip(self.chains, fixed, strict=True))
        seen = {*self._of_arms(lambda arm: {*arm.names} - hidden[arm])}
        unseen = [n for n in self._of_arms(lambda arm: arm.names) if n not in seen]
        std = self._gather([np.asarray(prior.std) for prior in priors])
        return Prior(std, fixed=tuple(unseen), by_data=True)

    def parameter_sizes(self) -> Array:
        sizes = [arm.parameter_sizes() for arm in self.chains]
        return np.asarray(self._gather(sizes))

    @functools.cached_property  # kept, and what it keeps with it
    def _bent(self) -> Self:
        """These chains, each with harmonics of its joints."""
        return self._each(lambda arm: arm._bent)

    def calibrated(self, parameters: ArrayLike) -> Self:
        """The chains whose nominal is this one with ``parameters``."""
        theta = as_parameters(self, parameters)
        both = zip(self.chains, self.members, strict=True)
        arms = [arm.calibrated(theta[at], arm.sensor) for arm, at in both]
        return dataclasses.replace(self, chains=tuple(arms))

    def writable(self) -> Self:
        """All with stiff joints and round gears, as files have them."""
        return self._each(SerialChain.writable)

    def to_dict(self) -> dict[str, Any]:
        arms = [arm.to_dict() for arm in self.chains]
        stands = [list(numbers) for numbers in self.stands]
        return {"kind": "chains", "tips": self.tips, "chains": arms, "stands": stands}

    @classmethod
    def from_dict(
        cls, tips: Sequence[str], chains: Sequence[Any], stands: Sequence[Sequence[int]]
    ) -> Self:
        """The inverse of ``to_dict``."""
        arms = [
            SerialChain.from_dh(**{key: arm[key] for key in arm if key != "kind"})
            for arm in chains
        ]
        return cls(tuple(tips), tuple(arms), tuple(map(tuple, stands)))
