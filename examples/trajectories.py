"""Which five trajectories of a simulator to run on the real arm, and what they tell.

python examples/trajectories.py           # 3 arms
python examples/trajectories.py --full    # 50
"""

from __future__ import annotations

import functools
import sys

import common
import numpy as np

import jaxcal
from jaxcal.models import FromFunction

ARM = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/>
      <inertial pos="0 0 -0.15" mass="1.2" diaginertia="0.01 0.01 0.001"/>
      <body name="fore" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0"/>
        <inertial pos="0 0 -0.1" mass="0.6" diaginertia="0.004 0.004 0.001"/>
        <body name="payload" pos="0 0 -0.25">
          <inertial pos="0 0 -0.05" mass="1" diaginertia="0.001 0.001 0.001"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder"/>
    <motor joint="elbow"/>
  </actuator>
</mujoco>
"""
NAMES = ("mass", "centre", "inertia", "rotor", "damping 1", "damping 2", "friction")
# kg; m below the flange; kg m² of the upper arm and of the shoulder's rotor; N m s; N m
DESIGNED = np.array([0.5, 0.05, 0.010, 0.020, 0.05, 0.03, 0.10])
# A parameter is the logarithm of what it is by what was designed: .1 is 10 % more.
SPREAD = np.array([0.1, 0.2, 0.1, 0.15, 0.2, 0.2, 0.2])
SECONDS, EVERY = 1.0, 0.02  # of a trajectory, and between readings
NOISE = 1e-3  # rad, of an encoder's reading
READINGS = round(SECONDS / EVERY)
SIGNALS = ("torque 1", "torque 2", "hertz 1", "hertz 2", "phase")


@functools.cache
def simulator():
    """MuJoCo, its model and data of the arm, once in each process."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARM)
    return mujoco, model, mujoco.MjData(model)


def trajectory(u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(100,) angles of shoulder and elbow in rad while torques in sines drive the arm.

    Args:
        u: (5,) amplitudes in N m, frequencies in Hz, and a phase in rad.
        theta: (7,) logarithms of the parameters, see ``NAMES``.
    """
    mujoco, model, data = simulator()
    given = DESIGNED * np.exp(theta)
    mass, centre, inertia, rotor, damping_1, damping_2, friction = given
    payload, upper = model.body("payload").id, model.body("upper").id
    model.body_mass[payload] = mass
    model.body_ipos[payload, 2] = -centre
    model.body_inertia[upper, :2] = inertia
    model.dof_armature[:] = rotor, 0.005
    model.dof_damping[:] = damping_1, damping_2
    model.dof_frictionloss[:] = friction, 0.0
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    steps = round(EVERY / model.opt.timestep)
    angles = np.empty((READINGS, 2))
    for i in range(READINGS):
        turn = 2.0 * np.pi * u[2:4] * (i * EVERY)
        data.ctrl[:] = u[:2] * np.sin(turn + np.array([0.0, u[4]]))
        mujoco.mj_step(model, data, nstep=steps)
        angles[i] = data.qpos
    return angles.T.ravel()


def candidates(count: int = 60) -> np.ndarray:
    """(60, 5) signals."""
    rng = np.random.default_rng(0)
    low, high = [0.5, 0.2, 0.3, 0.3, 0.0], [4.0, 2.0, 3.0, 3.0, 2.0 * np.pi]
    return rng.uniform(low, high, (count, 5))


def machine(**options: object) -> FromFunction:
    """The arm as designed."""
    return FromFunction(
        trajectory, np.zeros(7), SPREAD, NAMES, inputs=SIGNALS,
        noise=jaxcal.Noise(std=NOISE), **options,
    )  # fmt: skip


# The rotor's inertia and the upper arm's turn about the same axis: one of them is held.
PRIOR = jaxcal.Prior(dict(zip(NAMES, SPREAD, strict=True)), fixed=["inertia"])


def study(full: bool) -> dict[str, np.ndarray]:
    """Rule to (arms, 7): errors of the parameters, and of the nominal ones."""
    model, signals = machine(), candidates()
    print(jaxcal.identifiability(model, signals))
    print(model.differences(signals))
    chosen = jaxcal.select(signals, 5, model=model, prior=PRIOR, criterion="D")
    print(chosen)
    free = np.array(NAMES) != "inertia"
    found: dict[str, list[np.ndarray]] = {"nominal": [], "random": [], "chosen": []}
    for seed in range(50 if full else 3):
        rng = np.random.default_rng(seed)
        truth = SPREAD * rng.normal(size=7) * free
        drawn = rng.permutation(len(signals))[:5]
        found["nominal"].append(-truth)
        for rule, rows in (("random", drawn), ("chosen", chosen.indices)):
            exact = model.predict(signals[rows], truth)
            read = exact + rng.normal(0.0, NOISE, exact.shape)
            fit = jaxcal.identify(
                signals[rows], read, model=model, prior=PRIOR, loss="gaussian",
                noise=jaxcal.Noise(std=NOISE),
            )  # fmt: skip
            found[rule].append(fit.parameters - truth)
    return {rule: np.array(errors) for rule, errors in found.items()}


def rows(found: dict[str, np.ndarray]) -> common.Rows:
    """Root mean square errors by parameter, percent."""
    return [
        {"parameter": name}
        | {rule: f"{100 * common.rms(e[:, i]):.2g}" for rule, e in found.items()}
        for i, name in enumerate(NAMES)
        if name != "inertia"
    ]


def draw(axes, rows: common.Rows) -> None:
    """Errors by parameter."""
    from jaxcal.reports.plots import COLOURS

    at = np.arange(len(rows))
    for i, rule in enumerate(("random", "chosen")):
        errors = [float(row[rule]) for row in rows]
        axes.bar(
            at + 0.4 * i - 0.2, errors, 0.4, color=COLOURS[i], label=f"five {rule}"
        )
    axes.set_xticks(at, [row["parameter"] for row in rows], rotation=20)
    axes.set_ylabel("error, %")
    axes.legend(frameon=False)


if __name__ == "__main__":
    common.main(sys.modules[__name__])
