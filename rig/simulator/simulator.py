"""Drives, mechanism and phone put together behind one configuration."""

from __future__ import annotations

import threading
from typing import Any

from rig.attitude import Array
from rig.config.config import RigConfig
from rig.simulator.drive import SimDrive
from rig.simulator.faults import FaultInjector, FaultSpec
from rig.simulator.phone import Phone
from rig.simulator.plant import Plant, Truth
from rig.simulator.server import ModbusServer


class Simulator:
    """A whole simulated rig. ``start`` returns the configuration that reaches it."""

    def __init__(
        self,
        config: RigConfig,
        truth: Truth | None = None,
        faults: list[FaultSpec] | None = None,
        *,
        transport: str = "tcp",
        rate_hz: float = 100.0,
        speedup: float = 1.0,
        travel_deg: tuple[float, float] | None = None,
    ) -> None:
        self.config = config
        self.truth = truth or Truth(seed=config.session.seed)
        self.faults = FaultInjector(faults)
        self.transport = transport
        self.rate_hz = rate_hz
        jig = Plant.jig_posture(self.truth)
        self.drives: list[SimDrive] = []
        for axis, angle in zip(config.axes, jig, strict=True):
            travel = None
            if travel_deg is not None:
                ends = sorted(axis.to_pulses(end) for end in travel_deg)
                travel = (ends[0], ends[1])
            position = 0.0
            if config.session.zero == "here":
                position = float(axis.to_pulses(float(angle)))
            self.drives.append(
                SimDrive(
                    axis.map, axis.pulses_per_rev, position,
                    speedup=speedup, travel=travel,
                )
            )  # fmt: skip
        for number, drive in enumerate(self.drives):
            drive.stuck = lambda n=number: bool(self.faults.take("stuck_axis", n))  # type: ignore[misc] # a default argument binds the axis
        self.plant = Plant(config, self.truth, self.drives)
        self.plant.slipping = lambda axis: bool(self.faults.take("slipping_axis", axis))
        units = [axis.unit for axis in config.axes]
        self.server = ModbusServer(
            dict(zip(units, self.drives, strict=True)), self.faults, self.truth.seed
        )
        self.phone: Phone | None = None
        self._alarm_lock = threading.Lock()

    def start(self, port: int = 0) -> RigConfig:
        """Serve the drives; the phone starts with ``start_phone``."""
        bus: dict[str, Any] = {"transport": self.transport}
        if self.transport == "rtu":
            bus |= {"device": self.server.serve_pty(), "parity": "N"}
        else:
            port = self.server.serve_tcp(port, rtu=self.transport == "rtu_tcp")
            bus |= {"host": "127.0.0.1", "port": port}
        phone_port = 0
        if self.config.imu.transport == "connect":
            self.start_phone(0)
            assert self.phone is not None
            phone_port = self.phone.port
        imu = {"host": "127.0.0.1", "port": phone_port}
        return self.config.model_copy(
            update={
                "bus": self.config.bus.model_copy(update=bus),
                "imu": self.config.imu.model_copy(update=imu),
            }
        )

    def start_phone(self, port: int) -> None:
        """Begin to send to the port the rig listens on; once only."""
        if self.phone is not None:
            self.phone.port = port
            return
        self.phone = Phone(
            self.config.imu, self._attitude, self.faults, self.rate_hz, self.truth.seed
        )
        self.phone.start(port)

    def enter(self, phase: str) -> None:
        """The session entered a phase: faults that wait for it begin."""
        self.faults.enter(phase)
        self._alarms()

    def _alarms(self) -> None:
        with self._alarm_lock, self.server.lock:
            for axis, drive in enumerate(self.drives):
                if not drive.alarm and self.faults.take("alarm", axis):
                    drive.raise_alarm(0x30)

    def _attitude(self) -> Array:
        self._alarms()
        with self.server.lock:
            return self.plant.attitude()

    def repair(self) -> None:
        """Undo every fault, as a technician would before the run is resumed."""
        self.faults.clear()
        self.plant.tighten()

    def executions(self) -> list[list[int]]:
        """Targets in pulses each drive really ran, pitch, yaw, roll."""
        return [[target for _, target in drive.executions] for drive in self.drives]

    def close(self) -> None:
        """Stop serving and sending."""
        if self.phone is not None:
            self.phone.close()
        self.server.close()

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
