"""A device whose drives are of another kind than Modbus, with a sensor of lines."""

import contextlib

import numpy as np
from harness import SESSION, fast_text

from rig.config import parse_config
from rig.journal.device import DeviceRecord
from rig.prove import steps
from rig.prove.steps import Operator
from rig_workbench.simulator.faults import FaultInjector
from rig_workbench.simulator.phone import SimSensor

AXIS = """
[[axes]]
name = "{name}"
kind = "translation"
unit = {unit}
map = "{family}"
pulses_per_rev = {counts}
lead_mm = 1
min_mm = -20
max_mm = 20
speed_mm_s = {speed}
accel_mm_s2 = 1000
"""
READINGS = """
[readings]
names = ["x", "y"]
unit = "mm"
transport = "tcp"
port = {port}
scale = 1.0
stale_s = 1.0

"""
MATRIX, BIAS = np.array([[0.95, 0.02], [-0.01, 1.05]]), np.array([1.0, -2.0])


def stage_text(bus, family, port, counts=1000, speed=100, session=SESSION):
    """rig.toml of two translations, measured by lines of two numbers."""
    text = fast_text(session=session)
    axes = "".join(
        AXIS.format(name=n, unit=u, family=family, counts=counts, speed=speed)
        for u, n in enumerate("xy", 1)
    )
    head = f'output = "runs"\n\n[bus]\n{bus}\ntimeout_s = 0.6\n'
    return head + axes + READINGS.format(port=port) + text[text.index("[motion]") :]


@contextlib.contextmanager
def sensed(places, noise=0.002):
    """A sensor of what `places()` in millimetres comes to; the port it serves."""
    rng, gain = np.random.default_rng(0), [1.0, 1.0]

    def numbers():
        return MATRIX @ (np.array(places()) * gain) + BIAS + rng.normal(0, noise, 2)

    config = parse_config(
        stage_text('transport = "rtu"\ndevice = "x"', "leadshine_pr", 0)
    )
    sensor = SimSensor(config.readings, numbers, FaultInjector(), 200.0)
    try:
        yield sensor.start(0), gain
    finally:
        sensor.close()


def place_of(config, folder, said):
    """Where the steps of commissioning are run, at full speed."""
    record = DeviceRecord.load(folder / "device.json")
    config = config.model_copy(update={"output": str(folder)})
    operator = Operator(yes=True, say=said.append)
    return steps.Site(config, record, operator, full_speed=True)
