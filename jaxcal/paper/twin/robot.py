"""The robot's twin in closed form: from three commands to what the phone reads.

Three revolute axes in series, pitch about x (to the side), yaw about y (up) and roll
about z (forward), meet in the ankle. A drive takes its joint to ``scale * u + bias``
(Table 1); play and the load's weight move it away from there; the phone on the
end-effector reads the attitude relative to the base as three Euler angles.

With the phone straight and read in the order in which the axes stand, the reading *is*
the joint angles and the robot is exactly ``y = A u + b`` with A diagonal. Another
order, a misaligned phone, play or a compliant mechanism are what a real device adds;
each is one field of ``RobotConfig``. docs/robot.md says what each does to A and b.

``jaxcal.paper.twin.robot_model`` is the same robot in MuJoCo, with its dynamics.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, one_of

__all__ = ["ORDERS", "RobotConfig", "joint_angles", "measure", "play", "read_out"]

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
PerAxis = float | Triple
"""One number for all axes, or pitch, yaw and roll"""

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")  # of turns, the outermost first
GRAVITY = 9.81  # m/s^2, along -y
_NEWTON_STEPS = 6  # of the sag; it converges quadratically
_PER_AXIS = (
    *("backlash_deg", "compliance_deg_per_nm"),
    *("noise_std_deg", "drift_std_deg"),
)
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
    noise_std_deg: PerAxis = 0.0  # white, of each angle read
    drift_std_deg: PerAxis = 0.0  # step of the bias from a session to the next
    drift_seed: int = 0  # of that random walk

    def __post_init__(self) -> None:
        for name in ("mechanism_order", "read_out_order"):
            one_of(name, getattr(self, name), ORDERS)
        for name in ("scale", "bias_deg", "mounting_deg", "load_offset_m"):
            value = getattr(self, name)
            if np.shape(value) != (3,) or not np.isfinite(value).all():
                raise ValueError(f"{name} must be three finite numbers, got {value!r}")
            object.__setattr__(self, name, tuple(float(v) for v in value))
        for name in _PER_AXIS:
            value = getattr(self, name)
            if (
                np.shape(value) not in ((), (3,))
                or not np.greater_equal(value, 0).all()
            ):
                raise ValueError(
                    f"{name} must be one number or three, none negative, got {value!r}"
                )
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite, got {value!r}")
            plain = tuple(map(float, value)) if np.ndim(value) else float(value)
            object.__setattr__(self, name, plain)
        if not 0.0 <= self.load_kg < float("inf"):
            raise ValueError(f"load_kg must be finite and >= 0, got {self.load_kg}")
        arm = float(np.linalg.norm(self.load_offset_m))
        slender = np.radians(self.per_axis("compliance_deg_per_nm").max())
        slender *= self.load_kg * GRAVITY * arm
        if slender > _MAX_SLENDERNESS:
            raise ValueError(
                "compliance_deg_per_nm x load_kg x load_offset_m must bend the robot "
                f"by at most {_MAX_SLENDERNESS} rad, got {slender:.3g}: it would buckle"
            )

    def per_axis(self, name: str) -> Array:
        """(3,) a field that is one number for all axes, or three."""
        return np.broadcast_to(np.float64(getattr(self, name)), (3,))


def read_out(config: RobotConfig, commands_deg: ArrayLike | jax.Array) -> Any:
    """What the phone reads at rest, without play, drift and noise.

    Given JAX arrays it is differentiable and works under ``jit`` and ``vmap``.

    Args:
        config: the robot.
        commands_deg: (..., 3) pitch, yaw, roll in degrees.

    Returns:
        (..., 3) degrees: a JAX array of the same precision for a JAX array, float64 of
        numpy for anything else.
    """
    return _in_its_precision(functools.partial(_read_out, config), commands_deg)


def joint_angles(config: RobotConfig, commands_deg: ArrayLike | jax.Array) -> Any:
    """(..., 3) where the joints settle, in degrees, without play and drift."""
    return _in_its_precision(functools.partial(_joint_angles, config), commands_deg)


def measure(
    config: RobotConfig,
    commands_deg: ArrayLike | jax.Array,
    key: jax.Array,
    session: int | Sequence[int] | NDArray[np.int64] = 0,
) -> Any:
    """What a session records: play, compliance, drift and noise included.

    The rows are visited in their order, from the command (0, 0, 0); leading axes are
    sessions of their own that all begin there.

    Args:
        config: the robot.
        commands_deg: (..., N, 3) pitch, yaw, roll in degrees.
        key: of the noise.
        session: number(s) of the session, 0 or later: the bias has taken so many steps
            of ``drift_std_deg``. Any shape that broadcasts to (..., N), so drift can
            also run from posture to posture.

    Returns:
        (..., N, 3) degrees; a JAX array or numpy, as ``read_out``.
    """
    shape = np.shape(commands_deg)
    if len(shape) < 2:
        raise ValueError(f"commands must have shape (..., N, 3), got {shape}")
    drift = np.broadcast_to(bias_drift(config, session), shape)

    def record(commands: jax.Array) -> jax.Array:
        noise = jax.random.normal(key, shape, commands.dtype)
        return _measure(config, commands, jnp.asarray(drift, commands.dtype), noise)

    return _in_its_precision(record, commands_deg)


def bias_drift(
    config: RobotConfig, session: int | Sequence[int] | NDArray[np.int64]
) -> Array:
    """(..., 3) degrees by which the bias has drifted at the start of a session.

    A random walk from zero in session 0; the same for the same ``drift_seed``.
    """
    number = np.asarray(session)
    if number.dtype.kind not in "iu" or (number < 0).any():
        raise ValueError(f"session must be whole and not negative, got {session!r}")
    rng = np.random.default_rng(config.drift_seed)
    steps = rng.standard_normal((int(number.max(initial=0)), 3))
    walk = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return walk[number] * config.per_axis("drift_std_deg")


def play(joints_deg: jax.Array, gap_deg: jax.Array, start_deg: jax.Array) -> jax.Array:
    """Where loose joints end up that are dragged along a sequence.

    The play operator: a joint rests until one of its two stops, ``gap`` apart, reaches
    it, and then goes along.

    Args:
        joints_deg: (N, 3) of the drives, in the order they are visited.
        gap_deg: (3,) between the stops.
        start_deg: (3,) of the loose joints before the first posture.

    Returns:
        (N, 3) of the loose joints.
    """
    half = gap_deg / 2.0

    def drag(loose: jax.Array, driven: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = jnp.clip(loose, driven - half, driven + half)
        return moved, moved

    return jax.lax.scan(drag, start_deg, joints_deg)[1]


# -- rotations -------------------------------------------------------------------------
# A matrix R is (3, 3) and takes vectors of the body to the fixed frame. An order such
# as "YXZ" is intrinsic: R = Ry(a) Rx(b) Rz(c). Angles are kept by axis, whatever the
# order of the turns; so an order never changes which number is pitch.


def _rotation_of(angles_deg: jax.Array, order: str) -> jax.Array:
    """Rotation of three angles.

    Args:
        angles_deg: (3,) degrees about x, y and z.
        order: one of ``ORDERS``, outermost turn first.

    Returns:
        (3, 3).
    """
    first, second, third = (_about(axis, angles_deg[axis]) for axis in _axes(order))
    return first @ second @ third


def _angles_of(matrix: jax.Array, order: str) -> jax.Array:
    """Angles of a rotation: the inverse of ``_rotation_of`` for a middle angle < 90.

    Args:
        matrix: (3, 3).
        order: one of ``ORDERS``, outermost turn first.

    Returns:
        (3,) degrees about x, y and z; that of the middle turn lies in [-90, 90].
    """
    i, j, k = _axes(order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    outer = jnp.arctan2(-sign * matrix[j, k], matrix[k, k])
    middle = jnp.arcsin(jnp.clip(sign * matrix[i, k], -1.0, 1.0))
    inner = jnp.arctan2(-sign * matrix[i, j], matrix[i, i])
    turns = {i: outer, j: middle, k: inner}
    return jnp.rad2deg(jnp.stack([turns[axis] for axis in range(3)]))


def _axes(order: str) -> tuple[int, int, int]:
    i, j, k = ("XYZ".index(letter) for letter in order)
    return i, j, k


def _about(axis: int, angle_deg: jax.Array) -> jax.Array:
    angle = jnp.deg2rad(angle_deg)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    rows = [[jnp.zeros_like(angle)] * 3 for _ in range(3)]
    rows[axis][axis] = jnp.ones_like(angle)
    rows[j][j] = rows[k][k] = cos
    rows[k][j], rows[j][k] = sin, -sin
    return jnp.stack([jnp.stack(row) for row in rows])


# -- one posture -----------------------------------------------------------------------


def _driven(config: RobotConfig, command: jax.Array) -> jax.Array:
    scale = jnp.asarray(config.scale, command.dtype)
    return scale * command + jnp.asarray(config.bias_deg, command.dtype)


def _bent(config: RobotConfig, target_deg: jax.Array) -> jax.Array:
    """(3,) joints under the load's weight: ``q = target + compliance * torque(q)``."""
    compliance = np.radians(config.per_axis("compliance_deg_per_nm"))
    if not compliance.any():
        return target_deg
    dtype = target_deg.dtype
    softness = jnp.asarray(compliance, dtype)
    offset = jnp.asarray(config.load_offset_m, dtype)

    def potential(joints: jax.Array) -> jax.Array:
        turned = _rotation_of(jnp.rad2deg(joints), config.mechanism_order)
        return config.load_kg * GRAVITY * (turned[1] @ offset)

    target = jnp.deg2rad(target_deg)

    def newton(_: int, joints: jax.Array) -> jax.Array:
        excess = joints - target + softness * jax.grad(potential)(joints)
        curvature = jax.hessian(potential)(joints)
        slope = jnp.eye(3, dtype=dtype) + softness[:, None] * curvature
        return joints - jnp.linalg.solve(slope, excess)

    return jnp.rad2deg(jax.lax.fori_loop(0, _NEWTON_STEPS, newton, target))


def _seen(config: RobotConfig, joints_deg: jax.Array) -> jax.Array:
    """(3,) angles that the phone reads at joints (3,)."""
    turned = _rotation_of(joints_deg, config.mechanism_order)
    if any(config.mounting_deg):
        phone = _rotation_of(jnp.asarray(config.mounting_deg, joints_deg.dtype), "XYZ")
        turned = phone.T @ turned @ phone
    return _angles_of(turned, config.read_out_order)


# -- many ------------------------------------------------------------------------------


def _each(function: Any, rows: jax.Array) -> jax.Array:
    """Apply a function of (3,) to (..., 3)."""
    return jnp.vectorize(function, signature="(k)->(k)")(rows)


def _joint_angles(config: RobotConfig, commands: jax.Array) -> jax.Array:
    return _each(lambda u: _bent(config, _driven(config, u)), commands)


@functools.partial(jax.jit, static_argnums=0)
def _read_out(config: RobotConfig, commands: jax.Array) -> jax.Array:
    return _each(lambda q: _seen(config, q), _joint_angles(config, commands))


@functools.partial(jax.jit, static_argnums=0)
def _measure(
    config: RobotConfig, commands: jax.Array, drift: jax.Array, noise: jax.Array
) -> jax.Array:
    gap, start, level = (
        jnp.asarray(values, commands.dtype)
        for values in (
            config.per_axis("backlash_deg"),
            config.bias_deg,
            config.per_axis("noise_std_deg"),
        )
    )
    drag = jnp.vectorize(lambda q: play(q, gap, start), signature="(n,k)->(n,k)")
    loose = drag(_each(lambda u: _driven(config, u), commands))
    read = _each(lambda q: _seen(config, _bent(config, q)), loose + drift)
    return read + jnp.broadcast_to(level, noise.shape) * noise


def _in_its_precision(function: Any, commands_deg: ArrayLike | jax.Array) -> Any:
    """JAX arrays as they are; everything else in float64, and back to numpy."""
    shape = np.shape(commands_deg)
    if shape[-1:] != (3,):
        raise ValueError(f"commands must have shape (..., 3), got {shape}")
    if isinstance(commands_deg, jax.Array):
        if not jnp.issubdtype(commands_deg.dtype, jnp.floating):
            commands_deg = commands_deg.astype(jnp.float32)
        return function(commands_deg)
    commands = numbers("commands", commands_deg)
    with jax.enable_x64(True):
        return np.array(function(jnp.asarray(commands)), dtype=np.float64)
