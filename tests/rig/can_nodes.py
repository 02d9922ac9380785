"""Nodes of CiA 402 on python-can's virtual bus, by python-canopen's own server.

As drives do, a node enables its power stage in NMT state "operational" alone, and what
a halt does depends on its mode: one without a mode obeys none. Objects that the
standards call optional may be absent (``without``).
"""

import math
import threading
import time

import canopen

STEP_S = 0.002
TYPES = {  # of objects: CANopen's data types
    0x6040: 6, 0x6041: 6, 0x603F: 6, 0x605D: 3, 0x6060: 2, 0x6061: 2, 0x6064: 4,
    0x607A: 4, 0x6081: 7, 0x6083: 7, 0x6084: 7, 0x1017: 6,
}  # fmt: skip


class Node:
    """One drive: its state machine, and a ramp to its target."""

    def __init__(self, network, unit, without=()):
        od = canopen.ObjectDictionary()
        for index, kind in TYPES.items():
            if index in without:
                continue
            entry = canopen.objectdictionary.ODVariable(f"o{index:x}", index)
            entry.data_type, entry.access_type, entry.default = kind, "rw", 0
            od.add_object(entry)
        record = canopen.objectdictionary.ODRecord("identity", 0x1018)
        for sub in {1, 2, 4} - set(without):
            entry = canopen.objectdictionary.ODVariable(f"s{sub}", 0x1018, sub)
            entry.data_type, entry.access_type, entry.default = 7, "ro", unit * 10 + sub
            record.add_member(entry)
        od.add_object(record)
        self.node = canopen.LocalNode(unit, od)
        network.add_node(self.node)
        self.node.add_write_callback(self._written)
        self.node.add_read_callback(self._read)
        self.position = self.velocity = 0.0
        self.target, self.state, self.word, self.mode = 0, 0x40, 0, 0
        self.reached, self.taken, self.halted = True, False, False
        self.fault, self.faults, self.speed = 0, set(), 1.0
        self.values = {}
        self._lock, self._now = threading.RLock(), time.monotonic()
        self.node.nmt.state = "PRE-OPERATIONAL"

    def advance(self):
        now = time.monotonic()
        while self._now < now:
            dt = min(STEP_S, now - self._now)
            self._now += dt
            self._step(dt)

    def _step(self, dt):
        if self.reached and not self.velocity:
            return
        accel = self.values.get(0x6083, 1000) * max(self.speed, 1.0) ** 2
        error = self.target - self.position
        most = self.values.get(0x6081, 100) * self.speed
        wanted = math.copysign(min(most, math.sqrt(2 * accel * abs(error))), error)
        if self.halted or self.state != 0x27:
            wanted = 0.0
        change = accel * dt
        self.velocity += max(-change, min(change, wanted - self.velocity))
        if self.halted and abs(self.velocity) <= change:
            self.velocity, self.reached = 0.0, True
            return
        if not self.halted and abs(error) <= max(abs(self.velocity) * dt, 0.5):
            self.position, self.velocity, self.reached = float(self.target), 0.0, True
        else:
            self.position += self.velocity * dt

    def halt(self):
        """Another controller halts it."""
        with self._lock:
            self.advance()
            self.halted = True

    def _read(self, *, index, subindex, od):
        with self._lock:
            self.advance()
            if index == 0x6064:
                return round(self.position)
            if index == 0x607A:
                return self.target
            if index == 0x603F:
                return self.fault
            if index == 0x6061:
                return self.mode
            if index == 0x6041:
                word = 0x08 if self.fault else self.state
                return word | self.reached << 10 | self.taken << 12
        return None

    def _written(self, *, index, subindex, od, data):
        with self._lock:
            self.advance()
            value = int.from_bytes(data, "little", signed=index == 0x607A)
            self.values[index] = value
            if index == 0x607A:
                self.next = value
            if index == 0x6060:
                self.mode = value
            if index == 0x6040:
                self._control(value)

    def _control(self, word):
        rose, self.word = word & ~self.word, word
        if rose & 0x80:
            self.fault, self.state = 0, 0x40
        steps = {0x06: (0x40, 0x21), 0x07: (0x21, 0x23), 0x0F: (0x23, 0x27)}
        before, after = steps.get(word & 0x0F, (None, None))
        operational = self.node.nmt.state == "OPERATIONAL"
        if self.state == before and not self.fault and operational:
            self.state = after
        obeys = "deaf" not in self.faults and self.mode
        if obeys or not word & 0x100:
            self.halted = bool(word & 0x100)
        if (
            not self.halted
            and self.state == 0x27
            and round(self.position) != self.target
        ):
            self.reached = False  # a halt that ends goes on to the old target
        if rose & 0x10 and self.state == 0x27:
            self.target, self.reached, self.taken = self.next, False, True
        if not word & 0x10:
            self.taken = False


class Nodes:
    """Two of them on a channel."""

    def __init__(self, channel, units=(1, 2), without=()):
        self._network, self._channel, self._units = canopen.Network(), channel, units
        self._without = without

    def __enter__(self):
        self._network.connect(interface="virtual", channel=self._channel)
        self.nodes = [Node(self._network, unit, self._without) for unit in self._units]
        return self

    def __exit__(self, *_):
        self._network.disconnect()

    def places(self):
        """Millimetres, of 1,000 counts each."""
        for node in self.nodes:
            with node._lock:
                node.advance()
        return [node.position / 1000.0 for node in self.nodes]
