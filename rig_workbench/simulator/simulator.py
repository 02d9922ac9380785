"""Drives, mechanism and phone put together behind one configuration."""

from __future__ import annotations

from typing import Any

from rig.config.config import RigConfig
from rig.readings.geometry import Array
from rig_workbench.simulator.drive import SimDrive
from rig_workbench.simulator.faults import FaultInjector, FaultSpec
from rig_workbench.simulator.phone import Phone, SimSensor
from rig_workbench.simulator.plant import Plant
from rig_workbench.simulator.server import ModbusServer
from rig_workbench.simulator.truth import Truth


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
    ) -> None:
        self.config = config
        self.truth = truth or Truth.of(config, seed=config.session.seed)
        self.faults = FaultInjector(faults)
        self.transport = transport
        self.drives: list[SimDrive] = []
        here = config.session.zero == "here"
        for number, axis in enumerate(config.axes):
            at_deg = float(self.truth.jig_deg[number]) if here else 0.0
            drive = SimDrive(axis, number, self.truth, self.faults, speedup, at_deg)
            drive.power_cycle(self.truth.lost_origin_deg[number])
            self.drives.append(drive)
        self.plant = Plant(config, self.truth, self.drives, self.faults)
        units = dict(zip((a.unit for a in config.axes), self.drives, strict=True))
        seed = self.truth.seed
        self.server = ModbusServer(units, self.faults, seed, self.truth.latency_s)
        self.phone: Phone | SimSensor
        if config.imu:
            self.phone = Phone(config.imu, self._attitude, self.faults, rate_hz, seed)
        else:
            assert config.readings is not None
            self.phone = SimSensor(config.readings, self._numbers, self.faults, rate_hz)

    def start(self, port: int = 0) -> RigConfig:
        """Serve the drives; the phone starts with ``start_phone``."""
        bus: dict[str, Any] = {"transport": self.transport}
        if self.transport == "rtu":
            bus |= {"device": self.server.serve_pty(), "parity": "N"}
        else:
            port = self.server.serve_tcp(port, rtu=self.transport == "rtu_tcp")
            bus |= {"host": "127.0.0.1", "port": port}
        phone_port = 0
        if self.config.source.transport in ("connect", "tcp"):
            phone_port = self.start_phone(0)
        source: dict[str, Any] = {"host": "127.0.0.1", "port": phone_port}
        which = "readings"
        if self.config.imu:
            source["allow"], which = ("127.0.0.1",), "imu"
        return self.config.model_copy(
            update={
                "bus": self.config.bus.model_copy(update=bus),
                which: self.config.source.model_copy(update=source),
            }
        )

    def start_phone(self, port: int) -> int:
        """Send to the port the rig listens on, or listen; returns the port."""
        return self.phone.start(port)

    def hear(self, record: dict[str, Any]) -> None:
        """Listen to the events of a session."""
        self.answer(record)
        if record["event"] == "phase":
            self.enter(record["phase"])

    def answer(self, record: dict[str, Any]) -> None:
        """Start the phone once a session listens to it."""
        if record["event"] == "listening":
            self.start_phone(record["port"])

    def enter(self, phase: str) -> None:
        """The session entered a phase: faults that wait for it begin."""
        self.faults.enter(phase)
        self._alarms()

    def _alarms(self) -> None:
        with self.server.lock:
            for axis, drive in enumerate(self.drives):
                if not drive.alarm and self.faults.take("alarm", axis):
                    drive.raise_alarm(0x30)
                if drive.travels and self.faults.take("halted", axis):
                    drive.halt()
                if drive.travels and (fault := self.faults.take("sto", axis)):
                    drive.cut(1.05 if fault.seconds is None else fault.seconds)

    def _numbers(self) -> Array:
        self._alarms()
        with self.server.lock:
            return self.plant.numbers()

    def _attitude(self) -> Array:
        self._alarms()
        with self.server.lock:
            return self.plant.attitude()

    def close(self) -> None:
        self.phone.close()
        self.server.close()

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
