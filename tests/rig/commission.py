"""A simulated device to commission over the real protocol, and its files."""

import contextlib

import numpy as np
from harness import SPEEDUP, Simulator, fast_config, free_port
from scipy.spatial.transform import Rotation

from rig.__main__ import main
from rig.config import AXIS_NAMES
from rig.prove.scan import parse_bus
from rig.prove.steps import set_values
from rig_workbench.commission.setup import setting
from rig_workbench.simulator import Truth

QUICK = (  # of the new rig.toml: short windows, quick axes
    "settle.window_s=0.04", "settle.min_samples=5", "settle.samples=5",
    "settle.slope_deg_s=0.5", "motion.poll_s=0.005", "imu.stale_s=1.0",
    "motion.max_speed_deg_s=400", "session.method=exact", "session.verify_postures=1",
    *(f"axes.{name}.{key}" for name in AXIS_NAMES
      for key in ("speed_deg_s=400", "accel_deg_s2=8000", "reduction=10")),
)  # fmt: skip


@contextlib.contextmanager
def device(truth=None, transport="tcp", config=None, **options):
    """A simulated device, the bus as the command line names it, and a phone's port."""
    config = config or fast_config()
    options.setdefault("speedup", SPEEDUP)
    with Simulator(
        config, truth or Truth(noise_deg=0.005), transport=transport, rate_hz=250.0,
        **options,
    ) as sim:  # fmt: skip
        bus = sim.start().bus
        port = free_port()
        sim.start_phone(port)
        where = f"{transport}:{bus.host}:{bus.port}"
        if transport == "rtu":
            where = f"rtu:{bus.device},115200,N,8,1"
        yield sim, where, port


def set_up(bus: str, port: int, *more: str, values=QUICK) -> int:
    given = [word for value in values for word in ("--set", value)]
    common = ["--yes", "--bus", bus, "--imu", f"hyperimu:{port}", "--units", "4"]
    return main(["setup", *common, *given, *more])


def quick_text(bus, port):
    from rig_workbench.commission.setup import new_text

    axes = [
        {"name": name, "kind": letter, "unit": unit, "family": "leadshine_pr",
         "pulses": 10000}
        for unit, (name, letter) in enumerate(zip(AXIS_NAMES, "XZY", strict=True), 1)
    ]  # fmt: skip
    text = new_text(parse_bus(bus), axes, "hyperimu", port)
    values = dict(setting(value) for value in QUICK)
    return set_values(text, values | {"axes.yaw.direction": -1})


def turns(sim, config):
    """Turns of the phone for a degree of each axis, by the mechanism's own formula."""
    matrix, bias = np.array(sim.truth.matrix), np.array(sim.truth.bias)
    at = np.array([(d.position - d.offset) / d.pulses_per_deg for d in sim.drives])

    def attitude(motors):
        joints = matrix @ motors + bias
        order = config.mechanism.order
        sequence = [joints[config.letters.index(letter)] for letter in order]
        return Rotation.from_euler(order, sequence, degrees=True)

    columns = [
        (attitude(at).inv() * attitude(at + step)).as_rotvec(degrees=True)
        for step in np.eye(3)
    ]
    pulses = [drive.position for drive in sim.drives]
    return {"pulses": pulses, "deg": np.transpose(columns).tolist()}
