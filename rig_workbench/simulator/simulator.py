"""Drives, mechanism and phone put together behind one configuration."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rig.config.config import RigConfig
from rig.readings.geometry import Array, euler_to_matrix
from rig_workbench.model import model_of
from rig_workbench.simulator.drive import SimDrive
from rig_workbench.simulator.faults import FaultInjector, FaultSpec
from rig_workbench.simulator.phone import Phone, SimSensor
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


class Plant:
    """From drive positions to the phone's attitude, with play, noise and drift."""

    def __init__(
        self,
        config: RigConfig,
        truth: Truth,
        drives: list[SimDrive],
        faults: FaultInjector,
    ) -> None:
        self.truth = truth
        self._config = config
        self._drives = drives
        self._faults = faults
        self._start = time.monotonic()
        self._rng = np.random.default_rng(truth.seed)
        self._matrix = np.array(truth.matrix)
        self._bias = np.array(truth.bias)
        # Degrees of each motor: factor and offset.
        self._geared = [(1.0, 0.0)] * len(drives)
        self._drive_deg = self._commanded()
        self._loose = self._drive_deg.copy()  # behind the play
        self.slip = np.zeros(len(drives))
        self._joint = self._drive_deg.copy()  # behind the friction too
        self._sliding = np.zeros(len(drives), dtype=bool)
        self._centre = self._drive_deg + truth.dead_centre_deg
        self._model = model_of(config)
        if self._model is not None:
            nominal = self._model.model.nominal
            self._parameters = np.array(truth.parameters or nominal)
            if config.is_arm:
                self._attitude_of = self._model.attitude_with(self._parameters)
        mounting = config.imu.mounting_deg if config.imu else (0.0, 0.0, 0.0)
        self._mounting = euler_to_matrix(mounting, "ZYX")

    def _commanded(self) -> Array:
        """(n,) degrees by which the motors turn the joints."""
        turned = [
            factor * (drive.position - drive.offset) / drive.pulses_per_deg + offset
            for drive, (factor, offset) in zip(self._drives, self._geared, strict=True)
        ]
        return (np.array(turned) * self.truth.signs)[list(self.truth.swapped)]

    def regear(self, axis: int, factor: float) -> None:
        """Fault: from here on a joint turns so many times as far as before."""
        drive, (before, offset) = self._drives[axis], self._geared[axis]
        at = (drive.position - drive.offset) / drive.pulses_per_deg
        self._geared[axis] = before * factor, offset + before * (1.0 - factor) * at

    def joints(self) -> Array:
        """(n,) joint angles in degrees now, or (m,) of an affine device's numbers:
        ``A u + b`` behind the play, the friction (a joint at rest stays until its drive
        is ``breakaway_deg`` away, then follows until it stands) and the dead zone."""
        for drive in self._drives:
            drive.advance()
        for axis in range(len(self._drives)):
            if fault := self._faults.take("regeared", axis):
                fault.count = 0
                self.regear(axis, fault.factor or 2.0)
        if fault := self._faults.take("phone_turned"):
            fault.count = 0  # it is turned on its holder, about its own vertical axis
            self._mounting = self._mounting @ euler_to_matrix([10.0, 0.0, 0.0], "ZYX")
        now = self._commanded()
        for axis in range(len(self._drives)):
            if self._faults.take("slipping_axis", axis):
                self.slip[axis] += now[axis] - self._drive_deg[axis]
        self._drive_deg = now
        turned = now - self.slip
        half = self.truth.backlash_deg / 2.0
        loose = np.clip(self._loose, turned - half, turned + half)
        self._sliding &= loose != self._loose
        self._loose = loose
        self._sliding |= np.abs(loose - self._joint) > self.truth.breakaway_deg
        self._joint = np.where(self._sliding, loose, self._joint)
        off = self._joint - self._centre
        zone = self.truth.dead_zone_deg / 2.0
        past = np.sign(off) * np.maximum(np.abs(off) - zone, 0.0)
        return self._matrix @ (self._centre + past) + self._bias

    def numbers(self) -> Array:
        """(m,) of what a sensor measures now."""
        values = self.joints()
        if self._model is not None:
            values = self._model.model.predict(values[None], self._parameters)[0]
        return values + self._rng.normal(0.0, self.truth.noise_deg, len(values))

    def attitude(self) -> Array:
        """(3, 3) attitude of the phone in its world, as its sensors see it."""
        joints = self.joints()
        config = self._config
        if config.is_arm:
            turned = self._attitude_of(joints)
        else:
            of_letter = dict(zip(config.letters, joints, strict=True))
            order = config.mechanism.order
            sequence = [of_letter.get(letter, 0.0) for letter in order]
            turned = euler_to_matrix(sequence, order)
        minutes = (time.monotonic() - self._start) / 60.0
        heading = self.truth.heading_deg + self.truth.drift_deg_per_min * minutes
        attitude = euler_to_matrix([heading, 0.0, 0.0], "ZYX") @ turned @ self._mounting
        if self.truth.noise_deg:
            noise = self._rng.normal(0.0, self.truth.noise_deg, 3)
            attitude = attitude @ euler_to_matrix(noise, "XYZ")
        return attitude
