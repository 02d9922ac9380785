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

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.paper.twin.robot import GRAVITY, RobotConfig
from jaxcal.paper.twin.robot_parts import add_parts, add_view

__all__ = [
    "HOLD_S",
    "load_model",
    "pose",
    "scene",
    "simulate",
    "timestep_of",
    "trajectory",
]

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


def scene(config: RobotConfig, timestep_s: float | None = None) -> Any:
    """The robot as a ``mujoco.MjSpec``, which can still be changed."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "ankle robot"
    spec.compiler.degree = False
    spec.option.timestep = timestep_s or timestep_of(config)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    heavy = config.per_axis("compliance_deg_per_nm").any()
    spec.option.gravity = [0.0, -GRAVITY if heavy else 0.0, 0.0]
    shape = spec.default.geom  # what is seen has no mass and touches nothing
    shape.contype, shape.conaffinity, shape.mass = 0, 0, 0.0
    bodies = [spec.worldbody]
    for letter in config.mechanism_order:
        bodies.append(_add_link(bodies[-1], letter, config))
    bodies[3].ipos, bodies[3].inertia = config.load_offset_m, [4e-3] * 3
    bodies[3].mass = max(config.load_kg, 1e-3)
    bodies[3].add_site(name="phone", quat=_quaternion(config), rgba=[0.0] * 4)
    _add_servos(spec, config)
    add_view(spec)
    add_parts(bodies, config.mechanism_order)
    return spec


def _add_link(parent: Any, letter: str, config: RobotConfig) -> Any:
    """The body behind one axis: a driven hinge and, with play, a loose one."""
    axis = "XYZ".index(letter)
    number = config.mechanism_order.index(letter) + 1
    body = parent.add_body(name=f"link{number}", mass=0.5, inertia=[2e-3] * 3)
    body.explicitinertial = True
    body.add_joint(name=letter, axis=np.eye(3)[axis], armature=_ARMATURE)
    half = np.radians(config.per_axis("backlash_deg")[axis]) / 2.0
    if half > 0.0:
        body.add_joint(
            name=f"{letter}_play",
            axis=np.eye(3)[axis],
            armature=1e-3,
            limited=True,
            range=[-half, half],
            solref_limit=[-20000.0, -200.0],
            solimp_limit=[0.99, 0.9999, 1e-5, 0.5, 2.0],
        )
    return body


def _add_servos(spec: Any, config: RobotConfig) -> None:
    """Motors in the order pitch, yaw, roll: torque = kp (s u + b - q) - kv q'.

    A loose joint is held back by its angle against the link before, damped.
    """
    import mujoco

    compliance = np.radians(config.per_axis("compliance_deg_per_nm"))
    gaps = config.per_axis("backlash_deg")
    for axis, letter in enumerate("XYZ"):
        kp = 1.0 / compliance[axis] if compliance[axis] > 0.0 else STIFFNESS
        kv = 2.0 * np.sqrt(kp * _INERTIA)
        offset = kp * np.radians(config.bias_deg[axis])
        spec.add_actuator(
            name=letter,
            target=letter,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            dyntype=mujoco.mjtDyn.mjDYN_FILTEREXACT,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            dynprm=_padded(_RAMP_S),
            gainprm=_padded(kp * config.scale[axis]),
            biasprm=_padded(offset, -kp, -kv),
        )
        if gaps[axis] > 0.0:
            drag = spec.add_tendon(name=f"{letter}_drag")
            drag.damping[0] = _DRAG
            drag.wrap_joint(letter, 1.0)
            drag.wrap_joint(f"{letter}_play", 1.0)


def _padded(*values: float) -> list[float]:
    """MuJoCo takes ten parameters of an actuator."""
    return [*values, *[0.0] * (10 - len(values))]


def load_model(config: RobotConfig, timestep_s: float | None = None) -> Any:
    """The compiled ``mujoco.MjModel``."""
    return scene(config, timestep_s).compile()


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
        pose(model, data, config.bias_deg)
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
    pose(model, data, config.bias_deg)
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


def pose(model: Any, data: Any, joints_deg: ArrayLike) -> None:
    """Put the robot at rest at joint angles (3,) about x, y and z in degrees."""
    import mujoco

    mujoco.mj_resetData(model, data)
    for letter, angle in zip("XYZ", np.radians(joints_deg), strict=True):
        data.joint(letter).qpos[:] = angle
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
