"""The robot in MuJoCo: the same mechanism with inertia, servos, play and gravity.

Each axis is a driven hinge with a position servo that settles at ``scale * u + bias``
and, where there is play, a second hinge between two stops behind it, dragged against
friction. Where the joints comply, the servo's stiffness is the joint's and gravity
acts; a robot that does not comply has a servo of ``STIFFNESS`` and no gravity, because
an infinitely stiff joint does not sag. What the phone reads is computed from the
attitude MuJoCo gives, by scipy: nothing is shared with ``jaxcal.paper.twin.robot`` but its
configuration, so each is a test of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.paper.twin.robot import GRAVITY, RobotConfig
from jaxcal.paper.twin.robot_parts import EYE_M, FIELD_DEG, Part, parts_of, view_axes

__all__ = [
    "HOLD_S",
    "load_model",
    "model_xml",
    "simulate",
    "timestep_of",
    "trajectory",
]

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

HOLD_S = 1.0  # a posture: the paper samples at 1 Hz
STIFFNESS = 200.0  # Nm/rad, of the servo of a joint that does not comply
_ARMATURE = 0.02  # kg m^2, of a motor behind its gear
_INERTIA = 0.03  # about what a servo moves, for its damping
_LINK = '<inertial pos="0 0 0" mass="0.5" diaginertia="2e-3 2e-3 2e-3"/>'
_RAMP_S = 0.03  # time constant of a drive on its way to a new command
_DRAG = 8.0  # Nm s/rad, of a loose joint against the link before


def timestep_of(config: RobotConfig) -> float:
    """Seconds of an integration step: play's hard stops want shorter ones."""
    return 0.005 if config.per_axis("backlash_deg").any() else 0.01


def model_xml(config: RobotConfig, timestep_s: float | None = None) -> str:
    """The robot as an MJCF document."""
    timestep_s = timestep_s or timestep_of(config)
    bodies, closing = "", ""
    parts = parts_of(config.mechanism_order)
    gaps = config.per_axis("backlash_deg")
    for link, letter in enumerate(config.mechanism_order, start=1):
        axis = "XYZ".index(letter)
        vector = " ".join("1" if i == axis else "0" for i in range(3))
        bodies += (
            f'<body name="link{link}">{_load(config) if link == 3 else _LINK}'
            f'<joint name="{letter}" axis="{vector}" armature="{_ARMATURE}"/>'
        )
        if gaps[axis] > 0.0:
            half = np.radians(gaps[axis]) / 2.0
            bodies += (
                f'<joint name="{letter}_play" axis="{vector}" armature="1e-3" '
                f'limited="true" range="{-half:.17g} {half:.17g}" '
                'solreflimit="-20000 -200" solimplimit="0.99 0.9999 1e-5"/>'
            )
        bodies += _geometry(parts, link)
        closing += "</body>"
    phone = " ".join(f"{value:.17g}" for value in _quaternion(config))
    return f"""<mujoco model="ankle robot">
<compiler angle="radian" autolimits="false"/>
<option timestep="{timestep_s}" integrator="implicitfast"
 gravity="0 {-GRAVITY if config.per_axis("compliance_deg_per_nm").any() else 0.0} 0"/>
<visual><headlight ambient="0.4 0.4 0.4" diffuse="0.3 0.3 0.3"/>
<global offwidth="1280" offheight="960"/>
<quality offsamples="4" shadowsize="2048"/></visual>
<asset><texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1"
 width="32" height="32"/></asset>
<default><geom contype="0" conaffinity="0" mass="0"/></default>
<worldbody>{_camera()}<light pos="0.6 1.5 0.9" dir="-0.4 -1 -0.6"
 diffuse="0.5 0.5 0.5"/>{_geometry(parts, 0)}
{bodies}<site name="phone" quat="{phone}"/>{closing}</worldbody>
<tendon>{_drags(gaps)}</tendon>
<actuator>{_servos(config)}</actuator>
</mujoco>"""


def load_model(config: RobotConfig, timestep_s: float | None = None) -> Any:
    """The compiled ``mujoco.MjModel``."""
    import mujoco

    return mujoco.MjModel.from_xml_string(model_xml(config, timestep_s))


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
    timestep_s = timestep_of(config) if timestep_s is None else timestep_s
    steps = _steps(hold_s, timestep_s)
    model = load_model(config, timestep_s)
    data = mujoco.MjData(model)
    site = model.site("phone").id
    groups = np.radians(commands).reshape(-1, *commands.shape[-2:])
    attitude = np.empty((*groups.shape[:2], 9))
    for number, group in enumerate(groups):
        if progress is not None:
            progress("simulate the robot", number * len(group), groups[..., 0].size)
        _rest(model, data, config)
        for row, command in enumerate(group):
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=steps)
            mujoco.mj_kinematics(model, data)
            attitude[number, row] = data.site_xmat[site]
    return _angles(config, attitude.reshape(-1, 3, 3)).reshape(commands.shape)


def trajectory(
    config: RobotConfig,
    commands_deg: ArrayLike,
    *,
    hold_s: float = HOLD_S,
    frames_per_s: float = 20.0,
    timestep_s: float | None = None,
) -> Array:
    """How the links turn while postures are held one after the other.

    Args:
        config: the robot.
        commands_deg: (N, 3) degrees.
        hold_s: seconds a command is held.
        frames_per_s: of what is returned.
        timestep_s: of the integration; as ``timestep_of`` says when not given.

    Returns:
        (frames, 3) angles of the links about x, y and z in degrees, play included; the
        first is where the command (0, 0, 0) leaves them.
    """
    import mujoco

    commands = numbers("commands", commands_deg)
    timestep_s = timestep_of(config) if timestep_s is None else timestep_s
    steps = _steps(1.0 / frames_per_s, timestep_s)
    model = load_model(config, timestep_s)
    data = mujoco.MjData(model)
    _rest(model, data, config)
    loose = config.per_axis("backlash_deg")
    frames = [_links(data, loose)]
    for command in np.radians(commands.reshape(-1, 3)):
        data.ctrl[:] = command
        for _ in range(max(1, round(hold_s * frames_per_s))):
            mujoco.mj_step(model, data, nstep=steps)
            frames.append(_links(data, loose))
    return np.degrees(np.array(frames))


def _steps(seconds: float, timestep_s: float) -> int:
    if not seconds >= timestep_s > 0.0:
        raise ValueError(
            f"a step must be above 0 s and no longer than what is simulated at once "
            f"({seconds:g} s), got {timestep_s:g}"
        )
    return round(seconds / timestep_s)


def _rest(model: Any, data: Any, config: RobotConfig) -> None:
    import mujoco

    mujoco.mj_resetData(model, data)
    for axis, letter in enumerate("XYZ"):
        data.joint(letter).qpos[:] = np.radians(config.bias_deg[axis])
    mujoco.mj_forward(model, data)


def _links(data: Any, loose: Array) -> Array:
    angles = np.zeros(3)
    for axis, letter in enumerate("XYZ"):
        angles[axis] = data.joint(letter).qpos[0]
        if loose[axis] > 0.0:
            angles[axis] += data.joint(f"{letter}_play").qpos[0]
    return angles


def _angles(config: RobotConfig, attitude: Array) -> Array:
    """(N, 3) degrees that a phone reads whose attitude in the base is (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    zero = Rotation.from_euler("XYZ", config.mounting_deg, degrees=True)
    turned = zero.inv() * Rotation.from_matrix(attitude)  # R0^T R
    order = config.read_out_order
    sequence = turned.as_euler(order, degrees=True)
    return sequence[:, [order.index(letter) for letter in "XYZ"]]


def _quaternion(config: RobotConfig) -> Array:
    """(4,) w, x, y, z of the phone on the end-effector."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("XYZ", config.mounting_deg, degrees=True)
    return turn.as_quat()[[3, 0, 1, 2]]


def _load(config: RobotConfig) -> str:
    """Foot and plate: a mass with its own inertia, away from where the axes meet."""
    place = " ".join(f"{value:.17g}" for value in config.load_offset_m)
    mass = max(config.load_kg, 1e-3)
    return f'<inertial pos="{place}" mass="{mass:.17g}" diaginertia="4e-3 4e-3 4e-3"/>'


def _servos(config: RobotConfig) -> str:
    """Motors in the order pitch, yaw, roll: torque = kp (s u + b - q) - kv q'."""
    lines = ""
    compliance = np.radians(config.per_axis("compliance_deg_per_nm"))
    for axis, letter in enumerate("XYZ"):
        kp = 1.0 / compliance[axis] if compliance[axis] > 0.0 else STIFFNESS
        kv = 2.0 * np.sqrt(kp * _INERTIA)
        gain = kp * config.scale[axis]
        offset = kp * np.radians(config.bias_deg[axis])
        lines += (
            f'<general name="{letter}" joint="{letter}" dyntype="filterexact" '
            f'dynprm="{_RAMP_S}" biastype="affine" '
            f'gainprm="{gain:.17g}" biasprm="{offset:.17g} {-kp:.17g} {-kv:.17g}"/>'
        )
    return lines


def _drags(gaps: Array) -> str:
    """What holds a loose joint back: its angle against the link before, damped."""
    return "".join(
        f'<fixed name="{letter}_drag" damping="{_DRAG}"><joint joint="{letter}" '
        f'coef="1"/><joint joint="{letter}_play" coef="1"/></fixed>'
        for letter, gap in zip("XYZ", gaps, strict=True)
        if gap > 0.0
    )


def _camera() -> str:
    right, up, _ = view_axes()
    place = " ".join(f"{value:g}" for value in EYE_M)
    axes = " ".join(f"{value:.9g}" for value in (*right, *up))
    return f'<camera name="view" pos="{place}" xyaxes="{axes}" fovy="{FIELD_DEG:g}"/>'


def _geometry(parts: list[Part], link: int) -> str:
    """What is seen of a link; it has no mass and touches nothing."""
    lines = ""
    for part in parts:
        if part.link != link:
            continue
        rgba = " ".join(f"{value:g}" for value in (*part.colour, 1.0))
        start, end = np.array(part.start), np.array(part.end)
        if part.kind == "rod":
            ends = " ".join(f"{value:g}" for value in (*start, *end))
            shape = f'type="capsule" size="{part.radius:g}" fromto="{ends}"'
        else:
            middle = " ".join(f"{value:g}" for value in (start + end) / 2)
            size = " ".join(f"{value:g}" for value in np.abs(end - start) / 2)
            shape = f'type="box" pos="{middle}" size="{size}"'
        lines += f'<geom {shape} rgba="{rgba}"/>'
    return lines
