"""The robot in MuJoCo: the same mechanism with inertia, servos, play and gravity.

Each axis is a driven hinge with a position servo that settles at ``scale * u + bias``
and, where there is play, a second hinge between two stops behind it, dragged against
friction. Where the joints comply, the servo's stiffness is the joint's and gravity
acts; a robot that does not comply has a servo of ``STIFFNESS`` and no gravity, because
an infinitely stiff joint does not sag. What the phone reads is computed from the
attitude MuJoCo gives, by scipy: nothing is shared with ``jaxcal.paper.twin.robot`` but
its configuration, so each is a test of the other.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from jaxcal.checks import numbers
from jaxcal.paper.twin.robot import GRAVITY, RobotConfig

__all__ = ["HOLD_S", "load_model", "simulate", "timestep_of"]

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

HOLD_S = 1.0  # per posture: the paper samples at 1 Hz
STIFFNESS = 200.0  # Nm/rad, of the servo of a joint that does not comply
_ARMATURE = 0.02  # kg m^2, of a motor behind its gear
_INERTIA = 0.03  # about what a servo moves, for its damping
_RAMP_S = 0.03  # time constant of a drive on its way to a new command
_DRAG = 8.0  # Nm s/rad, of a loose joint against the link before


def timestep_of(config: RobotConfig) -> float:
    """Seconds of an integration step: play's hard stops want shorter ones."""
    return 0.005 if config.per_axis("backlash_deg").any() else 0.01


def load_model(config: RobotConfig, timestep_s: float | None = None) -> Any:
    """The compiled ``mujoco.MjModel``."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(pathlib.Path(__file__).with_name("scene.xml")))
    spec.option.timestep = timestep_s or timestep_of(config)
    heavy = config.per_axis("compliance_deg_per_nm").any()
    spec.option.gravity = [0.0, -GRAVITY if heavy else 0.0, 0.0]
    bodies = [spec.worldbody, *(spec.body(f"link{i}") for i in (1, 2, 3))]
    for body, letter in zip(bodies[1:], config.mechanism_order, strict=True):
        _add_axis(spec, body, letter, config)
    bodies[3].ipos, bodies[3].mass = config.load_offset_m, max(config.load_kg, 1e-3)
    spec.site("phone").quat = _mounting(config).as_quat()[[3, 0, 1, 2]]
    for axis, letter in enumerate("XYZ"):
        _add_servo(spec, axis, letter, config)
    return spec.compile()


def _add_axis(spec: Any, body: Any, letter: str, config: RobotConfig) -> None:
    """The hinges of a link: a driven one and, with play, a loose one.

    A loose joint is held back by its angle against the link before, damped.
    """
    number = "XYZ".index(letter)
    axis = np.eye(3)[number]
    body.add_joint(name=letter, axis=axis, armature=_ARMATURE)
    half = np.radians(config.per_axis("backlash_deg")[number]) / 2.0
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

    compliance = np.radians(config.per_axis("compliance_deg_per_nm"))[axis]
    kp = 1.0 / compliance if compliance > 0.0 else STIFFNESS
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


def simulate(
    config: RobotConfig,
    commands_deg: ArrayLike,
    *,
    hold_s: float = HOLD_S,
    timestep_s: float | None = None,
    progress: Progress | None = None,
) -> Array:
    """Drive groups of postures open loop and read the phone at the end of each hold.

    Every group begins at rest where the command (0, 0, 0) leaves the drives, with loose
    joints in the middle of their play. Noise and drift are not simulated here.

    Args:
        config: the robot.
        commands_deg: (..., N, 3) pitch, yaw, roll in degrees; leading axes are groups.
        hold_s: seconds a command is held; the phone is read in the last instant.
        timestep_s: of the integration; as ``timestep_of`` says when not given.
        progress: told how many postures of how many are done.

    Returns:
        (..., N, 3) degrees.
    """
    import mujoco

    commands = numbers("commands", commands_deg)
    if commands.ndim < 2 or commands.shape[-1] != 3:
        raise ValueError(f"commands must have shape (..., N, 3), got {commands.shape}")
    steps, model, data = _at_rest(config, hold_s, timestep_s)
    site = model.site("phone").id
    groups = np.radians(commands).reshape(-1, *commands.shape[-2:])
    attitude = np.empty((*groups.shape[:2], 9))
    for number, group in enumerate(groups):
        if progress is not None:
            progress("simulate the robot", number * len(group), groups[..., 0].size)
        pose(model, data, config.bias_deg)
        for row, command in enumerate(group):
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=steps)
            mujoco.mj_kinematics(model, data)
            attitude[number, row] = data.site_xmat[site]
    turned = Rotation.from_matrix(attitude.reshape(-1, 3, 3))  # R0 M
    order = config.read_out_order
    read = (_mounting(config).inv() * turned).as_euler(order, degrees=True)
    return read[:, [order.index(a) for a in "XYZ"]].reshape(commands.shape)


def _at_rest(
    config: RobotConfig, seconds: float, timestep_s: float | None
) -> tuple[int, Any, Any]:
    """Steps of so many seconds, the model, and its state at the command (0, 0, 0)."""
    import mujoco

    timestep_s = timestep_of(config) if timestep_s is None else timestep_s
    if not seconds >= timestep_s > 0.0:
        raise ValueError(
            f"a step must be above 0 s and no longer than what is simulated at once "
            f"({seconds:g} s), got {timestep_s:g}"
        )
    model = load_model(config, timestep_s)
    data = mujoco.MjData(model)
    pose(model, data, config.bias_deg)
    return round(seconds / timestep_s), model, data


def pose(model: Any, data: Any, joints_deg: ArrayLike) -> None:
    """Put the robot at rest at joint angles (3,) about x, y and z in degrees."""
    import mujoco

    mujoco.mj_resetData(model, data)
    for letter, angle in zip("XYZ", np.radians(joints_deg), strict=True):
        data.joint(letter).qpos[:] = angle
    mujoco.mj_forward(model, data)


def _mounting(config: RobotConfig) -> Rotation:
    """The phone on the end-effector."""
    return Rotation.from_euler("XYZ", config.mounting_deg, degrees=True)
