"""A GCode controller on a pseudo-terminal, from the text of GRBL 1.1 and Marlin 2.

It shares no code with what it tests. Moves are run one after another with ramps. As
with the boards that run these, whoever opens the port and finds the control line low
resets the board: it counts from 0 then, answers nothing for BOOT_S, and greets.
"""

import contextlib
import math
import os
import re
import select
import termios
import threading
import time
import tty

STEP_S = 0.002
BOOT_S = 0.4
LEAST_FEED = 1 / 60  # mm/s: a slower one is raised to it
CFLAG = 2  # of termios' attributes


class Controller:
    """Axes by their letters, in millimetres; ``faults`` is what is wrong with it."""

    def __init__(self, dialect="grbl", letters="XY", steps=80, accel=2000.0):
        self.dialect, self.letters, self.steps = dialect, letters, steps
        self.accel = accel
        self.at = dict.fromkeys(letters, 0.0)
        self.queue, self.velocity = [], 0.0  # (letter, target, feed mm/s, is a jog)
        self.alarm = self.holding = self.cancelling = False
        self.faults = set()
        self.speed = 1.0  # times that it moves as fast as it is told
        self.stops = self.executions = self.resets = 0
        self.lost = 0  # replies that it does not send
        self._lock, self._closing = threading.RLock(), threading.Event()
        self._now = self._boots = time.monotonic()
        self._high = self._greets = False

    def __enter__(self):
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        self.device = os.ttyname(slave)
        self.hang_up()
        os.close(slave)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def hang_up(self):
        """The control line falls once the port is closed, as it does for most."""
        flags = termios.tcgetattr(self._master)
        flags[CFLAG] |= termios.HUPCL
        termios.tcsetattr(self._master, termios.TCSANOW, flags)

    def __exit__(self, *_):
        self._closing.set()
        self._thread.join(2.0)
        os.close(self._master)

    def places(self):
        with self._lock:
            self.advance()
            return [self.at[letter] for letter in self.letters]

    @property
    def state(self):
        if self.alarm:
            return "Alarm"
        if self.holding:
            return "Hold:1" if self.velocity else "Hold:0"
        if self.queue:
            return "Jog" if self.queue[0][3] else "Run"
        return "Idle"

    def advance(self):
        now = time.monotonic()
        while self._now < now:
            dt = min(STEP_S, now - self._now)
            self._now += dt
            self._step(dt)

    def _step(self, dt):
        if not self.queue:
            self.velocity, self.cancelling = 0.0, False
            return
        letter, target, feed, _ = self.queue[0]
        error = target - self.at[letter]
        feed = max(feed, LEAST_FEED)
        wanted = min(feed * self.speed, math.sqrt(2 * self.accel * abs(error)))
        if self.holding or self.cancelling:
            wanted = 0.0
        change = self.accel * max(self.speed, 1.0) ** 2 * dt
        self.velocity += max(-change, min(change, wanted - self.velocity))
        if self.cancelling and self.velocity <= 0.0:
            self.queue, self.velocity = [], 0.0
            return
        way = self.velocity * dt
        if way and abs(error) <= max(way, 1e-4):
            self.at[letter], self.velocity = target, 0.0
            self.queue.pop(0)
        else:
            self.at[letter] += math.copysign(way, error)

    def halt(self):
        """Another controller ends what is queued."""
        with self._lock:
            self.advance()
            self.cancelling = bool(self.queue)

    def run(self, letter, target, feed):
        """Another program's move, which is no jog."""
        with self._lock:
            self.advance()
            self.queue.append((letter, target, feed, False))

    def _reset(self):
        """By its control line."""
        self.resets += 1
        self.at = dict.fromkeys(self.letters, 0.0)
        self._clear()
        self._boots, self._greets = time.monotonic() + BOOT_S, True

    def _clear(self):
        self.queue, self.velocity = [], 0.0
        self.holding = self.cancelling = False

    def _serve(self):
        buffer, poll = b"", select.poll()
        poll.register(self._master, select.POLLIN | select.POLLHUP)
        while not self._closing.is_set():
            events = poll.poll(2)
            closed = bool(events and events[0][1] & select.POLLHUP)
            with self._lock:
                self.advance()
                if closed:
                    flags = termios.tcgetattr(self._master)
                    self._high &= not flags[CFLAG] & termios.HUPCL
                    time.sleep(0.002)
                elif not self._high:
                    self._high = True
                    if "no_reset" not in self.faults:
                        self._reset()
            boots = time.monotonic() < self._boots
            if self._greets and not boots:
                self._greets = False
                self._greet()
            if events and events[0][1] & select.POLLIN:
                with contextlib.suppress(OSError):
                    data = os.read(self._master, 4096)
                    with self._lock:
                        buffer = b"" if boots else self._take(buffer + data)

    def _greet(self):
        grbl = "\r\nGrbl 1.1h ['$' for help]"
        self._say(grbl if self.dialect == "grbl" else "start\r\necho:Marlin 2.1.2")

    def _take(self, buffer):
        if self.dialect == "grbl":
            for byte in (b"!", b"\x85", b"~", b"\x18", b"?"):
                while byte in buffer:
                    buffer = buffer.replace(byte, b"", 1)
                    buffer = self._realtime(byte, buffer)
        # While it holds it takes no line: they wait, and are run once it goes on.
        while b"\n" in buffer and not self.holding:
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

    def _realtime(self, byte, waiting):
        deaf, moves = "deaf" in self.faults, bool(self.queue)
        if byte == b"?":
            places = ",".join(f"{value:.3f}" for value in self.at.values())
            self._say(f"<{self.state}|MPos:{places}|FS:0,0>")
        elif byte == b"\x85":  # ignored unless it jogs
            self.stops += 1
            self.cancelling |= self.state == "Jog" and not deaf
        elif byte == b"!" and not (self.alarm or deaf):
            self.cancelling |= self.state == "Jog"  # any hold cancels a jog,
            self.holding |= self.state in ("Run", "Idle")  # and is kept at rest
        elif byte == b"~":
            self.holding &= self.state == "Hold:1"
        elif byte == b"\x18":
            self.alarm |= moves and self.state != "Hold:0"  # its place may be lost
            self._clear()
            self._greet()
            return b""
        return waiting

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
                self.cancelling = bool(self.queue)
        if move := re.search(r"(\$J=.*|G1) ([A-Z])(-?[\d.]+) F([\d.]+)", line):
            letter, target, feed = move[2], float(move[3]), float(move[4]) / 60
            if abs(target) > 100:
                return "error:15"
            self.queue.append((letter, target, feed, move[1] != "G1"))
            self.executions += 1
        return "ok"
