"""What a fit, a choice or a check asks of an arm, and of several chains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.arms.arm import Arm
from jaxcal.arms.sensors.sensor import facts_of
from jaxcal.checks import Array
from jaxcal.late import late
from jaxcal.models.model import ErrorGroups, Fitting, Model, as_parameters


class ArmFitting(Fitting):
    """What is asked of an arm with its sensor."""

    model: Arm

    result_type = late("jaxcal.arms.written:ArmCalibration")
    # Functions of the model, in modules that know it.
    anew = late("jaxcal.arms.plausible:anew", of="model")
    apart = late("jaxcal.arms.plausible:apart", of="model")
    prepared = late("jaxcal.arms.plausible:prepared", of="model")
    require_commands = late("jaxcal.arms.plausible:require_commands", of="model")
    improved = late("jaxcal.arms.effects:improved", of="model")
    error_groups = late("jaxcal.arms.effects:error_groups", of="model")
    unexplained = late("jaxcal.arms.effects:unexplained", of="model")
    verdict = late("jaxcal.arms.verdict:verdict", of="model")

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        sensor, joints = model.sensor, enumerate(model.joints, 1)
        # What harmonics leave of the misfit, which a choice counts as noise.
        self.misfit_std = sensor.misfit * model.length
        self.fits_misfit, self.relative = not sensor.local, sensor.relative
        self.sensed = slice(model.num_joints, model.num_inputs)
        self.placed = sensor.names
        self.slips = tuple(f"{'theta' if x == 'R' else 'd'}{i}" for i, x in joints)

    def misfit_model(self) -> Model:
        chain: Any = self.model
        bent: Model = chain._bent
        return bent

    def distinct(self, commands: Array, measured: Array) -> NDArray[np.intp]:
        kept = [np.zeros(0, dtype=np.intp)]
        columns = commands[:, self.model.num_joints :]
        for _, one, rows, _ in self.model.sensor.parts(columns):
            if one.zeros and not measured[rows].any():
                rows = rows[np.unique(commands[rows], axis=0, return_index=True)[1]]
            kept.append(rows)
        return np.sort(np.concatenate(kept))

    def accuracy_units(self, measured_unit: str) -> tuple[str, ...]:
        arm = self.model
        of_each = [arm._quantities_of(s, measured_unit) for s in arm.sensor.members]
        return tuple(
            dict.fromkeys(q.unit for quantities in of_each for q in quantities)
        )

    def wrapped(self, off: Array, commands: Array) -> Array:
        columns = commands[:, self.model.num_joints :]
        return self.model.sensor.wrapped(off, columns, self.model.length)

    def facts(self, parameters: ArrayLike | None = None) -> tuple[Array, Array]:
        members = enumerate(self.model.sensor.members)
        at = [(sensor, self.model._own(i)) for i, sensor in members]
        return facts_of(at, as_parameters(self.model, parameters))

    def log_size(self, commands: Array, parameters: Array) -> Array | None:
        """Logarithm of how far the joints move the tip (N,).

        Of contacts of turning joints, which touch as well with an arm of any size: the
        root of the sum of squares, of all postures, of how far the tip is from each
        axis. By turns it is held. The way of a slide that moves shows the size: None.
        """
        if not self.model._grows(commands):
            return None
        _, square = self.model._levers(commands, parameters)
        return 0.5 * np.log(square)

    def log_size_jacobian(self, commands: Array, parameters: Array) -> Array:
        arm = self.model
        if not arm._grows(commands):
            return np.zeros((len(commands), len(parameters)))
        levers, square = arm._levers(commands, parameters)
        axes = arm._chain(commands, parameters)[1]
        # A shift moves the tip away from the axes before it.
        shifts, at, joints = arm._shifts
        before = np.concatenate([np.zeros((1, *levers[0].shape)), levers.cumsum(0)])
        slopes = np.zeros(len(parameters))
        slopes[shifts] = np.einsum("skn,skn->s", before[joints], axes[at]) / square[0]
        return np.broadcast_to(slopes, (len(commands), len(slopes)))

    def targets(
        self, desired: Array, start: Array | None
    ) -> Callable[[Array, NDArray[np.intp]], Array]:
        """What to reach; of a pose its turns from the nominal orientation there."""
        if not self.relative:
            return super().targets(desired, start)
        if start is None:
            raise ValueError(
                "start is missing: for an arm's pose give joints, at whose nominal "
                "orientation desired is a turn, as in rotation_vectors(start, R)"
            )
        turned = self.model.rotations(start, desired[:, 3:])

        def goal(commands: Array, rows: NDArray[np.intp]) -> Array:
            turns = self.model.rotation_vectors(commands, turned[rows])
            return np.hstack([desired[rows, :3], turns])

        return goal


class ChainsFitting(Fitting):
    """What is asked of several chains: of each, in its rows."""

    result_type = late("jaxcal.arms.written:ArmCalibration")
    misfit_model = ArmFitting.misfit_model
    prepared = late("jaxcal.arms.plausible:prepared_chains", of="model")
    verdict = late("jaxcal.arms.verdict:verdict_of_chains", of="model")

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        fits = [arm.fitting for arm in model.chains]
        least = [float(model._scale(k).min()) for k in range(len(fits))]
        self.misfit_std = max(
            fit.misfit_std / std for fit, std in zip(fits, least, strict=True)
        )
        self.fits_misfit = all(fit.fits_misfit for fit in fits)
        self.placed = model._of_arms(lambda arm: arm.fitting.placed)
        self.slips = model._of_arms(lambda arm: arm.fitting.slips)

    def require_commands(self, commands: Array) -> None:
        for k, arm, _, arm_commands in self.model._parts(commands):
            with self.model._naming(k):
                arm.fitting.require_commands(arm_commands)

    def distinct(self, commands: Array, measured: Array) -> NDArray[np.intp]:
        counting = [
            rows[arm.fitting.distinct(arm_commands, measured[rows])]
            for _, arm, rows, arm_commands in self.model._parts(commands)
        ]
        return np.sort(np.concatenate(counting))

    def accuracy_units(self, measured_unit: str) -> tuple[str, ...]:
        arms = self.model.chains
        units = (unit for arm in arms for unit in arm.fitting.accuracy_units(""))
        return tuple(dict.fromkeys(units))

    def wrapped(self, off: Array, commands: Array) -> Array:
        off = off.copy()
        for k, arm, rows, arm_commands in self.model._parts(commands):
            scale, q = self.model._scale(k), arm.num_outputs
            its = off[..., rows, :q] * scale
            off[..., rows, :q] = arm.fitting.wrapped(its, arm_commands) / scale
        return off

    def log_size(self, commands: Array, parameters: Array) -> Array | None:
        sizes, grow = np.zeros(len(commands)), False
        for k, arm, rows, arm_commands in self.model._parts(commands):
            size = arm.fitting.log_size(arm_commands, parameters[self.model.members[k]])
            if size is not None:
                sizes[rows], grow = size, True
        return sizes if grow else None

    def log_size_jacobian(self, commands: Array, parameters: Array) -> Array:
        slopes = np.zeros((len(commands), len(parameters)))
        for k, arm, rows, arm_commands in self.model._parts(commands):
            at = self.model.members[k]
            of_arm = arm.fitting.log_size_jacobian(arm_commands, parameters[at])
            slopes[np.ix_(rows, at)] = of_arm
        return slopes

    def facts(self, parameters: ArrayLike | None = None) -> tuple[Array, Array]:
        at = []
        for (k, i), *_ in self.model._members:  # a distance is known once
            arm = self.model.chains[k]
            at.append((arm.sensor.members[i], self.model.members[k][arm._own(i)]))
        return facts_of(at, as_parameters(self.model, parameters))

    def error_groups(self) -> ErrorGroups:
        """Groups as of an arm of each chain, of harmonics one for all, last; what
        chains share is in the first one's."""
        groups = [arm.fitting.error_groups() for arm in self.model.chains]
        count, members = len(groups[0].medians) - 1, []
        for k, (of_arm, _, _) in enumerate(groups):
            numbered = np.where(of_arm < 0, -1, of_arm + count * k)
            members.append(np.where(of_arm == count, count * len(groups), numbered))
        medians, spreads = (
            np.append(np.tile(one[:-1], len(groups)), one[-1]) for one in groups[0][1:]
        )
        return ErrorGroups(self.model._gather(members), medians, spreads)
