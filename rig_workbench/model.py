"""The model of a device that is not ``y = A u + b``: what rig.toml names, loaded.

What a session of such a device comes to, parameters and verdict, it says too.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rig.config import ConfigError, RigConfig
from rig.drives import named
from rig.identification.conclusion import fit_quietly, spread
from rig.journal.run_folder import Record
from rig.readings.geometry import RADIAN, geometry_of

if TYPE_CHECKING:
    from jaxcal.models.model import Model
    from jaxcal.models.uncertainty import Prior

Array = NDArray[np.float64]
# A phone tells where up is as a direction: it has neither scale nor bias.
OF_A_DIRECTION = ("gravity scale", "bias x", "bias y", "bias z")
WIDE = 1.96  # standard errors, of 95 %


@dataclasses.dataclass(frozen=True)
class DeviceModel:
    """A ``jaxcal`` model of a device, and what is known of it before measuring."""

    model: Model
    prior: Prior | None = None  # None: the model's own
    # (N, n) commands to (N, 3, 3) attitudes of the tip, of an arm as its file has it.
    rotations: Callable[[Array], Array] | None = None

    def predict(self, command: Array) -> Array:
        """(m,) that is measured at a command (n,) by the device as designed."""
        return np.asarray(self.model.predict(command[None]), dtype=np.float64)[0]

    def drawn(self, seed: int) -> Array:
        """(p,) parameters of such a device, drawn from what is known before."""
        known = (self.prior or self.model.default_prior()).resolve(self.model)
        deviation = np.random.default_rng(seed).normal(size=len(known.mean))
        with np.errstate(divide="ignore"):
            std = known.precisions**-0.5
        std = np.where(np.isfinite(std), std, 0.05 * np.maximum(1.0, abs(known.mean)))
        return known.mean + np.where(known.free, std * deviation, 0.0)

    def attitude_with(self, parameters: Array) -> Callable[[Array], Array]:
        """Command (n,) to attitude (3, 3) of the tip of an arm with parameters (p,)."""
        model: Any = self.model
        arm = model.calibrated(parameters)
        return lambda command: arm.rotations(command[None], np.zeros((1, 3)))[0]

    def axes_at(self, command: Array) -> Array:
        """(3, n) axes about which the joints of an arm turn, in the tip's frame."""
        assert self.rotations is not None
        steps = np.vstack([0 * command, np.eye(len(command))])
        here, *turned = self.rotations(command + steps)
        turns = Rotation.from_matrix([here.T @ each for each in turned])
        return turns.as_rotvec(degrees=True).T

    def outputs(self, config: RigConfig, records: list[Record]) -> tuple[Array, Array]:
        """(N, n) commands and (N, m) of what it predicts, of N posture records."""
        geometry = geometry_of(config)
        commands = np.array([r["commanded_deg"] for r in records], dtype=np.float64)
        values = [
            geometry.outputs(np.array(r["attitude"]), np.array(r["measured_deg"]))
            for r in records
        ]
        return commands, np.array(values)

    def identify(self, config: RigConfig, records: list[Record]) -> Any:
        """The parameters from chosen postures: a ``jaxcal.Calibration``."""
        limit = config.session.verify_limit_deg
        judged = self.model.fitting.accuracy_units(config.output_unit)
        return fit_quietly(
            config,
            *self.outputs(config, records),
            model=self.model,
            prior=self.prior,
            accuracy=limit if judged else None,
        )

    def held_out_errors(
        self, config: RigConfig, calibration: Any, records: list[Record]
    ) -> Record:
        """Errors of the predictions at held-out postures: of the device as designed,
        and of the calibration; nothing where there are none."""
        if not records:
            return {}
        commands, measured = self.outputs(config, records)
        of = {"before": self.model, "prediction": calibration}
        return {key: spread(measured - of[key].predict(commands)) for key in of}

    def conclude(
        self, config: RigConfig, postures: dict[str, Record]
    ) -> tuple[Any, Record]:
        """The calibration, and what the summary has of it."""
        chosen, held = (
            [record for record in postures.values() if record["role"] == role]
            for role in ("select", "held")
        )
        calibration = self.identify(config, chosen)
        verdict, noise = calibration.verdict, calibration.noise_std
        return calibration, self.held_out_errors(config, calibration, held) | {
            "model": calibration.model.title,
            "parameters": parameters(calibration),
            "noise_std_deg": None if noise is None else np.ravel(noise).tolist(),
            "fit": {"good": bool(verdict.good), "reasons": list(verdict.reasons)},
        }


def parameters(calibration: Any) -> dict[str, Record]:
    """What was fitted, by its name: designed, found, half-width of its interval."""
    errors = calibration.standard_errors
    return {
        name: {
            "designed": float(calibration.model.nominal[i]),
            "value": float(calibration.parameters[i]),
            "half_width": None if errors is None else WIDE * float(errors[i]),
        }
        for i, name in enumerate(calibration.names)
        if errors is None or errors[i] != 0.0
    }


def model_of(config: RigConfig) -> DeviceModel | None:
    """``rig.parts.model_of``."""
    if config.model is None:
        return None
    key = "model.urdf" if config.is_arm else "model.factory"
    try:
        made = _arm(config) if config.is_arm else _made(config)
        commands, outputs = len(config.axes), len(config.output_names)
        takes = made.model.num_inputs
        gives = len(made.predict(np.zeros(takes)))  # a function says it by its answer
        if (takes, gives) != (commands, outputs):
            raise ValueError(
                f"the model has {takes} commands and {gives} readings; the device has "
                f"{commands} axes and measures {outputs}"
            )
    except Exception as error:  # whatever a file of Python raises
        where = config.model.urdf or config.model.factory
        raise ConfigError(key, [f"{where}: {error}"]) from None
    return made


def _arm(config: RigConfig) -> DeviceModel:
    from jaxcal.arms import SerialChain
    from jaxcal.arms.sensors import Gravity, Position
    from jaxcal.models.uncertainty import Prior

    assert config.model is not None and config.model_path is not None
    by_phone, size = config.imu is not None, config.model.magnitude
    sensor: Any = Gravity(magnitude=RADIAN if by_phone else size)
    if config.model.sensor == "position":
        sensor = Position()
    arm = SerialChain.from_urdf(
        config.model_path,
        base=config.model.base or None,
        tip=config.model.tip or None,
        sensor=sensor,
    )
    names = _in_small_letters(arm.joint_names)
    if tuple(names) != config.axis_names:
        raise ValueError(
            f"its joints from the base outwards are {', '.join(names)}; the axes must "
            f"be the same in this order, got {', '.join(config.axis_names)}"
        )
    prior = arm.default_prior()
    if by_phone:
        fixed = (*prior.fixed, *OF_A_DIRECTION)
        prior = Prior(prior.std, prior.mean, fixed, prior.by_data)
    return DeviceModel(
        arm, prior, lambda commands: arm.rotations(commands, 0.0 * commands[:, :3])
    )


def _in_small_letters(names: Sequence[str]) -> list[str]:
    return [re.sub("[^a-z0-9]+", "_", name.lower()) for name in names]


def joint_names(urdf: str) -> list[str]:
    """Names of the axes of an arm, from the base outwards; ValueError, OSError."""
    from jaxcal.arms import SerialChain

    return _in_small_letters(SerialChain.from_urdf(urdf).joint_names)


def _made(config: RigConfig) -> DeviceModel:
    from jaxcal.models.model import as_model

    assert config.model is not None
    made = named(config.model.factory, config.folder)
    if not hasattr(made, "predict") and callable(made):
        made = made()
    return DeviceModel(as_model(made))
