"""The paper's robot in MuJoCo: inertia, servos, play, gravity; and read at rest.

Three revolute axes in series, pitch about x (to the side), yaw about y (up) and roll
about z (forward), meet in the ankle. A drive takes its joint to ``scale * u + bias``
(Table 1); the phone on the end-effector reads the attitude relative to the base as
three Euler angles. docs/robot.md says what a wrong order, a phone askew, play and a
compliant mechanism do to A and b.

Each axis is a driven hinge with a position servo and, where there is play, a second
hinge between two stops behind it, dragged against friction. Where the joints comply,
the servo's stiffness is the joint's and gravity acts; a robot that does not comply has
a servo of ``STIFFNESS`` and no gravity, because an infinitely stiff joint does not sag.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from jaxcal.checks import numbers, one_of

__all__ = ["HOLD_S", "ORDERS", "RobotConfig", "load_model", "read_out", "simulate"]

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
PerAxis = float | Triple
"""One number for all axes, or pitch, yaw and roll"""
Progress = Callable[[str, int, int], None]

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")  # of turns, the outermost first
HOLD_S = 1.0  # per posture: the paper samples at 1 Hz
GRAVITY = 9.81  # m/s^2, along -y
STIFFNESS = 200.0  # Nm/rad, of the servo of a joint that does not comply
_ARMATURE = 0.02  # kg m^2, of a motor behind its gear
_INERTIA = 0.03  # about what a servo moves, for its damping
_RAMP_S = 0.03  # time constant of a drive on its way to a new command
_DRAG = 8.0  # Nm s/rad, of a loose joint against the link before
_MAX_SLENDERNESS = 0.5  # compliance x weight x arm, rad; far from buckling (1)


@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """What the robot is. The defaults are an ideal one with the paper's Table 1.

    Triples are pitch, yaw, roll, or x, y, z. ``mounting_deg`` is the attitude of the
    phone on the end-effector, unknown to the read-out, turned in the order XYZ. Play is
    the gap between the two stops of a joint, in joint degrees.
    """

    scale: Triple = (0.43, 0.71, 0.87)
    bias_deg: Triple = (3.1, -5.8, 2.41)
    mechanism_order: str = "XYZ"  # axes from the base outwards
    read_out_order: str = "XYZ"  # of the Euler angles that are read
    mounting_deg: Triple = (0.0, 0.0, 0.0)
    backlash_deg: PerAxis = 0.0
    compliance_deg_per_nm: PerAxis = 0.0  # of each joint
    load_kg: float = 1.0  # foot and plate; felt only through compliance
    load_offset_m: Triple = (0.0, -0.03, 0.05)  # from the ankle

    def __post_init__(self) -> None:
        for name in ("mechanism_order", "read_out_order"):
            one_of(name, getattr(self, name), ORDERS)
        for name in ("scale", "bias_deg", "mounting_deg", "load_offset_m"):
            value = getattr(self, name)
            if np.shape(value) != (3,) or not np.isfinite(value).all():
                raise ValueError(f"{name} must be three finite numbers, got {value!r}")
        for name in ("backlash_deg", "compliance_deg_per_nm"):
            value = getattr(self, name)
            good = np.isfinite(value).all() and np.greater_equal(value, 0).all()
            if np.shape(value) not in ((), (3,)) or not good:
                raise ValueError(
                    f"{name} must be one number or three, finite and not negative, got "
                    f"{value!r}"
                )
        if not 0.0 <= self.load_kg < float("inf"):
            raise ValueError(f"load_kg must be finite and >= 0, got {self.load_kg}")
        arm = float(np.linalg.norm(self.load_offset_m))
        slender = self.softness.max() * self.load_kg * GRAVITY * arm
        if slender > _MAX_SLENDERNESS:
            raise ValueError(
                "compliance_deg_per_nm x load_kg x load_offset_m must bend the robot "
                f"by at most {_MAX_SLENDERNESS} rad, got {slender:.3g}: it would buckle"
            )

    @property
    def softness(self) -> Array:
        """(3,) compliance of each joint, rad/Nm."""
        return np.radians(np.broadcast_to(self.compliance_deg_per_nm, 3))

    @property
    def play(self) -> Array:
        """(3,) gap between the stops of each joint, rad."""
        return np.radians(np.broadcast_to(self.backlash_deg, 3))

    @property
    def timestep_s(self) -> float:
        """Seconds of an integration step: play's hard stops want shorter ones."""
        return 0.005 if self.play.any() else 0.01


def read_out(config: RobotConfig, commands_deg: ArrayLike) -> Array:
    """What the phone reads at rest, in closed form; without play and compliance.

    Args:
        config: the robot.
        commands_deg: (..., 3) pitch, yaw, roll in degrees.

    Returns:
        (..., 3) degrees.
    """
    commands = numbers("commands", commands_deg)
    if commands.shape[-1:] != (3,):
        raise ValueError(f"commands must have shape (..., 3), got {commands.shape}")
    joints = commands.reshape(-1, 3) * config.scale + config.bias_deg
    order = config.mechanism_order
    turns = joints[:, ["XYZ".index(axis) for axis in order]]
    turned = Rotation.from_euler(order, turns, degrees=True) * _mounting(config)
    return _seen(config, turned).reshape(commands.shape)


def _seen(config: RobotConfig, phone: Rotation) -> Array:
    """(N, 3) degrees that are read where the phone has turned to (N,) attitudes."""
    order = config.read_out_order
    read = (_mounting(config).inv() * phone).as_euler(order, degrees=True)
    return read[:, [order.index(axis) for axis in "XYZ"]]


def _mounting(config: RobotConfig) -> Rotation:
    """The phone on the end-effector."""
    return Rotation.from_euler("XYZ", config.mounting_deg, degrees=True)


def simulate(
    config: RobotConfig,
    commands_deg: ArrayLike,
    *,
    hold_s: float = HOLD_S,
    progress: Progress | None = None,
) -> Array:
    """Drive groups of postures open loop and read the phone at the end of each hold.

    Every group begins at rest where the command (0, 0, 0) leaves the drives, with loose
    joints in the middle of their play. Noise is not simulated.

    Args:
        config: the robot.
        commands_deg: (..., N, 3) pitch, yaw, roll in degrees; leading axes are groups.
        hold_s: seconds a command is held; the phone is read in the last instant.
        progress: told how many postures of how many are done.

    Returns:
        (..., N, 3) degrees.
    """
    import mujoco

    commands = numbers("commands", commands_deg)
    if commands.ndim < 2 or commands.shape[-1] != 3:
        raise ValueError(f"commands must have shape (..., N, 3), got {commands.shape}")
    model = load_model(config)
    data = mujoco.MjData(model)
    site = model.site("phone").id
    groups = np.radians(commands).reshape(-1, *commands.shape[-2:])
    attitude = np.empty((*groups.shape[:2], 9))
    for number, group in enumerate(groups):
        if progress is not None:
            progress("simulate the robot", number * len(group), groups[..., 0].size)
        mujoco.mj_resetData(model, data)
        for letter, angle in zip("XYZ", np.radians(config.bias_deg), strict=True):
            data.joint(letter).qpos[:] = angle
        mujoco.mj_forward(model, data)
        for row, command in enumerate(group):
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=round(hold_s / config.timestep_s))
            mujoco.mj_kinematics(model, data)
            attitude[number, row] = data.site_xmat[site]
    phone = Rotation.from_matrix(attitude.reshape(-1, 3, 3))
    return _seen(config, phone).reshape(commands.shape)


def load_model(config: RobotConfig) -> Any:
    """The compiled ``mujoco.MjModel``."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(pathlib.Path(__file__).with_name("scene.xml")))
    spec.option.timestep = config.timestep_s
    spec.option.gravity = [0.0, -GRAVITY if config.softness.any() else 0.0, 0.0]
    bodies = [spec.body(f"link{i}") for i in (1, 2, 3)]
    for body, letter in zip(bodies, config.mechanism_order, strict=True):
        _add_axis(spec, body, letter, config.play["XYZ".index(letter)] / 2.0)
    bodies[2].ipos, bodies[2].mass = config.load_offset_m, max(config.load_kg, 1e-3)
    spec.site("phone").quat = _mounting(config).as_quat()[[3, 0, 1, 2]]
    for axis, letter in enumerate("XYZ"):
        _add_servo(spec, axis, letter, config)
    return spec.compile()


def _add_axis(spec: Any, body: Any, letter: str, half: float) -> None:
    """The hinges of a link: a driven one and, with play, one loose by ``half`` rad.

    A loose joint is held back by its angle against the link before, damped.
    """
    axis = np.eye(3)["XYZ".index(letter)]
    body.add_joint(name=letter, axis=axis, armature=_ARMATURE)
    if half > 0.0:
        play, stops = f"{letter}_play", {"limited": True, "range": [-half, half]}
        stops |= {"solref_limit": [-20000.0, -200.0]}
        stops |= {"solimp_limit": [0.99, 0.9999, 1e-5, 0.5, 2.0]}
        body.add_joint(name=play, axis=axis, armature=1e-3, **stops)
        drag = spec.add_tendon(name=f"{letter}_drag")
        drag.damping[0] = _DRAG
        drag.wrap_joint(letter, 1.0)
        drag.wrap_joint(play, 1.0)


def _add_servo(spec: Any, axis: int, letter: str, config: RobotConfig) -> None:
    """A motor: torque = kp (s u + b - q) - kv q'."""
    import mujoco

    softness = config.softness[axis]
    kp = 1.0 / softness if softness > 0.0 else STIFFNESS
    kv = 2.0 * np.sqrt(kp * _INERTIA)
    offset = kp * np.radians(config.bias_deg[axis])
    unused = [0.0] * 7  # MuJoCo takes ten parameters
    spec.add_actuator(
        name=letter,
        target=letter,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        dyntype=mujoco.mjtDyn.mjDYN_FILTEREXACT,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        dynprm=[_RAMP_S, 0.0, 0.0, *unused],
        gainprm=[kp * config.scale[axis], 0.0, 0.0, *unused],
        biasprm=[offset, -kp, -kv, *unused],
    )
