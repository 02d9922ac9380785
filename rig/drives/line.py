"""What drives are reached over, by several threads; see docs/rig/drives.md."""

from __future__ import annotations

import abc
import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from rig.faults import Fault, Report, unheard

if TYPE_CHECKING:
    from rig.config.settings import BusSettings

QUICK_S = 0.05  # for a reply to a stop in its first round, besides the frames' time


class BusError(Fault):
    """No valid reply: silence, noise, a closed port, or a reply to something else."""

    refused = False  # the drive answered that it does not
    out_of_reach = False  # because it cannot go there
    lost = False  # there is no connection

    def __init__(
        self,
        text: str,
        advice: str = "Check the unit's power, cable and id, and the line's settings",
        lost: bool = False,
    ) -> None:
        self.advice, self.lost = advice, lost
        super().__init__(text)


class Refusal(BusError):
    """The drive answered that it does not."""

    refused = True

    def __init__(self, text: str, out_of_reach: bool = False) -> None:
        self.out_of_reach = out_of_reach
        super().__init__(text, "See its manual, and check the axis's map")


class Line(abc.ABC):
    """One line with any number of units; safe to use from several threads."""

    transports: ClassVar[tuple[str, ...]] = ()  # of [bus] that it can be
    in_turn: bool = False  # its drives move one after another

    def __init__(
        self, settings: BusSettings, silence_s: float = 0.0, emit: Report = unheard
    ) -> None:
        """``silence_s`` between frames; ``emit`` is told of every write."""
        self.settings = settings
        self.silence_s = silence_s
        self.check: Callable[[], None] = lambda: None  # before each exchange; may raise
        self.silent: set[int] = set()  # units that did not answer the last time
        self._emit = emit
        self._untold: list[dict[str, Any]] = []
        self._lock = threading.RLock()
        self._urgent = False
        self._timeout_s = settings.timeout_s

    @property
    def read_tries(self) -> int:
        """Tries of a read: spoilt frames now and then spoil three replies in a row."""
        return 1 + 2 * self.settings.read_retries

    # Of a kind of line

    @abc.abstractmethod
    def connect(self) -> None:
        """Open the port, unless it is open; OSError or BusError where it cannot be."""

    @abc.abstractmethod
    def close(self) -> None:
        """Close the port; opening it again is possible."""

    def alive(self) -> None:
        """The session goes on: told every 50 ms, where another process is to know."""

    def stops_at_once(self, drives: Sequence[Any]) -> bool:
        """Whether one frame stops all of these."""
        return False

    def stop_at_once(self, drives: Sequence[Any]) -> None:
        """Send it, where there is one; each gets its own stop as well."""

    def doubts(self, unit: int) -> bool:
        """Whether what a unit acknowledged last was perhaps not acknowledged."""
        return False

    @property
    def late(self) -> set[int]:
        """Units whose replies came after their time."""
        return set()

    def answers_for_every_unit(self) -> bool:
        """Whether a unit number that no device has is answered too."""
        return False

    # Of all of them

    def open(self) -> Line:
        """Open the port; BusError where it is absent, refused or held by another."""
        with self._lock:
            try:
                self.connect()
            except OSError as error:
                raise BusError(
                    f"cannot open {self.settings.where}: {error.strerror or error}",
                    "Plug it in, or correct [bus]",
                ) from None
        return self

    def __enter__(self) -> Any:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def quick_s(self) -> float:
        """For a reply of a unit that is well."""
        return QUICK_S

    @contextlib.contextmanager
    def urgent(self, timeout_s: float | None = None) -> Iterator[None]:
        """Keep the line for a stop: no other thread's exchange, no ``check``; a reply
        is waited for ``timeout_s``, or as configured where that is shorter."""
        with self._lock:
            before = self._urgent, self._timeout_s
            outermost = not self._urgent
            configured = self.settings.timeout_s
            self._urgent = True
            self._timeout_s = min(timeout_s or configured, configured)
            try:
                yield
            finally:
                self._urgent, self._timeout_s = before
                untold, self._untold = (self._untold, []) if outermost else ([], [])
        for fields in untold if outermost else ():
            self._emit("write", **fields)

    @contextlib.contextmanager
    def exchange(self, unit: int) -> Iterator[float]:
        """Around one request and its reply: seconds in which it is to come. Whatever is
        raised within becomes a BusError, in words."""
        with self._lock:
            if not self._urgent:
                self.check()  # holding the lock: nothing is sent after another's stop
            self.silent.add(unit)
            try:
                self.connect()
                yield self._timeout_s
            except BusError as error:
                if error.refused:
                    self.silent.discard(unit)
                raise
            except Exception as error:
                text = " ".join(f"{type(error).__name__}: {error}".split())
                raise BusError(f"unit {unit}: no valid reply ({text})") from None
            self.silent.discard(unit)

    def tell(self, unit: int, **fields: Any) -> None:
        """Tell of a write. A journal on a disk that hangs must not hold up a stop."""
        fields = {"unit": unit, **fields}
        if self._urgent:
            self._untold.append(fields | {"sent": round(time.time(), 4)})
        else:
            self._emit("write", **fields)
