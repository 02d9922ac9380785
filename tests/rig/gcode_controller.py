"""A GCode controller on a pseudo-terminal, from the text of GRBL 1.1 and Marlin 2.

It shares no code with what it tests. Moves are run one after another with ramps.
"""

import contextlib
import math
import os
import re
import select
import threading
import time
import tty

STEP_S = 0.002


class Controller:
    """Axes by their letters, in millimetres; ``faults`` is what is wrong with it."""

    def __init__(self, dialect="grbl", letters="XY", steps=80, accel=2000.0):
        self.dialect, self.letters, self.steps, self.accel = (
            dialect,
            letters,
            steps,
            accel,
        )
        self.at = dict.fromkeys(letters, 0.0)
        self.queue, self.velocity = [], 0.0  # (letter, target, feed mm/s)
        self.alarm = self.held = False
        self.faults = set()
        self.speed = 1.0  # times that it moves as fast as it is told
        self.stops = self.executions = 0
        self.lost = 0  # replies that it does not send
        self._lock, self._closing = threading.RLock(), threading.Event()
        self._now = time.monotonic()

    def __enter__(self):
        self._master, self._slave = os.openpty()
        for fd in (self._master, self._slave):
            tty.setraw(fd)
        self.device = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._closing.set()
        self._thread.join(2.0)
        os.close(self._master)
        os.close(self._slave)

    def places(self):
        with self._lock:
            self.advance()
            return [self.at[letter] for letter in self.letters]

    def advance(self):
        now = time.monotonic()
        while self._now < now:
            dt = min(STEP_S, now - self._now)
            self._now += dt
            self._step(dt)

    def _step(self, dt):
        if not self.queue:
            self.velocity = 0.0
            return
        letter, target, feed = self.queue[0]
        error = target - self.at[letter]
        wanted = min(feed * self.speed, math.sqrt(2 * self.accel * abs(error)))
        if self.held:
            wanted = 0.0
        change = self.accel * max(self.speed, 1.0) ** 2 * dt
        self.velocity += max(-change, min(change, wanted - self.velocity))
        if self.held and self.velocity <= 0.0:
            self.queue, self.held, self.velocity = [], False, 0.0
            return
        way = self.velocity * dt
        if abs(error) <= max(way, 1e-4):
            self.at[letter], self.velocity = target, 0.0
            self.queue.pop(0)
        else:
            self.at[letter] += math.copysign(way, error)

    def halt(self):
        """Another controller ends what is queued."""
        with self._lock:
            self.advance()
            self.held = bool(self.queue)

    def _serve(self):
        buffer = b""
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                if not select.select([self._master], [], [], 0.02)[0]:
                    continue
                buffer += os.read(self._master, 4096)
                with self._lock:
                    self.advance()
                    buffer = self._take(buffer)

    def _take(self, buffer):
        if self.dialect == "grbl":
            for byte in (b"!", b"\x85", b"?"):
                while byte in buffer:
                    buffer = buffer.replace(byte, b"", 1)
                    self._realtime(byte)
        while b"\n" in buffer:
            line, buffer = buffer.split(b"\n", 1)
            if reply := self._line(line.decode().strip()):
                time.sleep(0.03 * ("late" in self.faults))
                self._say(reply)
        return buffer

    def _say(self, text):
        if self.lost:
            self.lost -= 1
        else:
            os.write(self._master, text.encode() + b"\r\n")

    def _realtime(self, byte):
        if byte == b"?":
            state = "Alarm" if self.alarm else "Jog" if self.queue else "Idle"
            places = ",".join(f"{value:.3f}" for value in self.at.values())
            return self._say(f"<{state}|MPos:{places}|FS:0,0>")
        self.stops += byte == b"!"
        if "deaf" not in self.faults:
            self.held = bool(self.queue)

    def _line(self, line):
        if self.alarm and line not in ("$X", "M999"):
            return "error:9" if self.dialect == "grbl" else "Error:Printer halted"
        if line in ("$X", "M999"):
            self.alarm = False
        if line == "$I":
            return "[VER:1.1h.20190825:]\r\n[OPT:V,15,128]\r\nok"
        if line == "M115":
            return "FIRMWARE_NAME:Marlin 2.1.2 MACHINE_TYPE:gimbal\r\nok"
        if line == "M114":
            exact = " ".join(f"{k}:{v:.2f}" for k, v in self.at.items())
            count = " ".join(f"{k}:{round(v * self.steps)}" for k, v in self.at.items())
            told = f"{exact} E:0.00 Count {count}"
            return f"ok {told}" if "one_line" in self.faults else f"{told}\r\nok"
        if line == "M410":
            self.stops += 1
            if "deaf" not in self.faults:
                self.held = bool(self.queue)
        if move := re.search(r"(?:\$J=.*|G1) ([A-Z])(-?[\d.]+) F([\d.]+)", line):
            letter, target, feed = move[1], float(move[2]), float(move[3]) / 60
            if abs(target) > 100:
                return "error:15"
            self.queue.append((letter, target, feed))
            self.executions += 1
        return "ok"
