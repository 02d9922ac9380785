"""How long after SIGTERM, or `stop`, the last drive that still listens hears its stop.

    python benchmarks/stop_latency.py [--repeats 20] [--transport rtu] [--dead]

Simulated Leadshine drives with bus.timeout_s = 0.3 and two tries more of each read, as
in the examples. Healthy, and with the first unit dead from up to two time-outs before
the signal. ``session``: from the signal to a motion loop under way to the arrival of
the last stop at the simulator. ``stop``: the command, from its first frame, and from
the start of its process. Milliseconds: median and worst.
"""

from __future__ import annotations

import argparse
import pathlib
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from types import SimpleNamespace
from typing import Any

from rig.config import RigConfig, parse_config
from rig.config.config import EXAMPLES
from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.faults import Fault, Signals, StopRequested
from rig_workbench.simulator import Simulator, Truth, parse_fault

SLOW = {
    "timeout_s = 0.5": "timeout_s = 0.3",
    "poll_s = 0.01": "poll_s = 0.05",
    "speed_deg_s = 120": "speed_deg_s = 3",
}
DEAD = "dead_drive,axis=pitch"


def slow_text(**changes: str) -> str:
    """The shipped example with slow axes and the time-out of the other examples."""
    text = (EXAMPLES / "simulate.toml").read_text()
    for old, new in (SLOW | changes).items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def last_stop(simulator: Simulator, dead: bool, since: float) -> float:
    """Milliseconds from ``since`` to the first stop that the last drive heard."""
    drives = simulator.drives[1:] if dead else simulator.drives
    return 1e3 * max(
        min(at for at in drive.stops if at >= since) - since for drive in drives
    )


def session(transport: str, dead: bool, rng: random.Random) -> float:
    """One stop of a motion loop under way, by SIGTERM."""
    config = parse_config(slow_text())
    sent: list[float] = []
    with Simulator(config, Truth(noise_deg=0.0), transport=transport) as simulator:
        served = simulator.start()
        run: Any = SimpleNamespace(
            config=served,
            emit=lambda event, **fields: None,
            journal=SimpleNamespace(records=[]),
        )
        checked: Any = SimpleNamespace(missing=lambda *_: None, state=lambda _: None)
        with Signals() as signals:
            device = Device(served, run, checked, signals)
            with device.imu as imu, device.line:
                simulator.start_phone(imu.port)
                imu.wait_for_stream(10)
                device.arm()
                signals.armed = True
                main = threading.main_thread().ident
                assert main is not None

                def spoil() -> None:
                    if dead:
                        simulator.faults.add(parse_fault(DEAD))
                        time.sleep(rng.uniform(0.0, 2 * served.bus.timeout_s))
                    sent.append(time.monotonic())
                    signal.pthread_kill(main, signal.SIGTERM)

                threading.Timer(rng.uniform(0.1, 0.4), spoil).start()
                try:
                    move(device, Posture("far", config.to_pulses([15, 15, 15])))
                except (StopRequested, Fault):
                    device.stopper.stop("benchmark")
                device.close()
        return last_stop(simulator, dead, sent[0])


def command(transport: str, dead: bool, folder: pathlib.Path) -> tuple[float, float]:
    """One `stop`: from its first frame, and from the start of its process."""
    config: RigConfig = parse_config(slow_text())
    first: list[float] = []
    with Simulator(config, Truth(noise_deg=0.0), transport=transport) as simulator:
        bus = simulator.start().bus
        where = f'device = "{bus.device}"' if transport == "rtu" else "port = 5020"
        path = folder / "rig.toml"
        path.write_text(slow_text(**{
            'transport = "tcp"': f'transport = "{transport}"',
            "port = 5020": where.replace("5020", str(bus.port)),
        }))  # fmt: skip
        answer = simulator.server._answer

        def noted(unit: int, pdu: bytes) -> tuple[bytes, bytes, bool] | None:
            first.append(time.monotonic())
            return answer(unit, pdu)

        simulator.server._answer = noted  # type: ignore[method-assign]  # a probe
        if dead:
            simulator.faults.add(parse_fault(DEAD))
        begun = time.monotonic()
        subprocess.run(
            [sys.executable, "-m", "rig", "stop", "--config", str(path)],
            capture_output=True, check=False,
        )  # fmt: skip
        return last_stop(simulator, dead, first[0]), last_stop(simulator, dead, begun)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--transport", choices=("tcp", "rtu"), help="only this")
    parser.add_argument("--dead", action="store_true", help="only with a dead unit")
    args = parser.parse_args()
    repeats, rng = args.repeats, random.Random(0)
    print(f"{'':<34}{'median':>9}{'worst':>9}  ms")
    with tempfile.TemporaryDirectory() as scratch:
        folder = pathlib.Path(scratch)
        for transport in [args.transport] if args.transport else ["tcp", "rtu"]:
            for dead in [True] if args.dead else [False, True]:
                name = f"{transport}, {'unit 1 dead' if dead else 'healthy'}"
                found = [session(transport, dead, rng) for _ in range(repeats)]
                commands = [command(transport, dead, folder) for _ in range(repeats)]
                from_frame, from_start = zip(*commands, strict=True)
                for what, times in (
                    ("session", found),
                    ("stop, from its first frame", from_frame),
                    ("stop, from its start", from_start),
                ):
                    median, worst = statistics.median(times), max(times)
                    print(f"{name}: {what:<34}{median:9.1f}{worst:9.1f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
