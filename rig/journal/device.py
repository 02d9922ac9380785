"""device.json: what was proved of a device, what has voided it, where it was left.

A device is trusted in steps, STATES, that docs/rig.md explains; none stands without
those before it. A session needs all but the last, which it reaches itself.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jaxcal.files import write_text
from rig.faults import Refused

if TYPE_CHECKING:
    from rig.config import RigConfig

IDENTIFIED, HOMED = "IDENTIFIED", "HOMED"
SIGN_CHECKED, STOP_PROVED, ZEROED = "SIGN_CHECKED", "STOP_PROVED", "ZEROED"
STATES = (IDENTIFIED, HOMED, SIGN_CHECKED, STOP_PROVED, ZEROED)
COMMANDS = {
    IDENTIFIED: "check scan",
    HOMED: "setup home",
    SIGN_CHECKED: "setup axes",
    STOP_PROVED: "setup axes",
    ZEROED: "setup zero",
}  # that reach a state


@dataclasses.dataclass
class DeviceRecord:
    """The states of one device. ``reach``, ``void`` and ``left_at`` also save."""

    path: pathlib.Path
    _states: dict[str, Any] = dataclasses.field(default_factory=dict)
    _voided: dict[str, Any] = dataclasses.field(default_factory=dict)
    _left: dict[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def load(cls, path: pathlib.Path) -> DeviceRecord:
        """The record of a file, empty where there is none; Refused: it is no record."""
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            if data["schema"] != 1:
                raise ValueError(f"schema must be 1, got {data['schema']!r}")
            return cls(path, *(dict(data[key]) for key in ("states", "voided", "left")))
        except FileNotFoundError:
            return cls(path)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Refused(
                f"{path}: not a device record ({error!r}). Move the file away and "
                "commission the device again: jaxcal-rig setup"
            ) from None

    def save(self) -> None:
        """Write the file, atomically."""
        data = {
            "schema": 1,
            "states": {n: self._states[n] for n in STATES if n in self._states},
            "voided": self._voided,
            "left": self._left,
        }
        write_text(self.path, json.dumps(data, indent=1) + "\n")

    def state(self, name: str) -> dict[str, Any] | None:
        """The evidence of a state; None where it does not stand."""
        known = self._states.get(name)
        return None if known is None else known["evidence"]

    def reach(self, name: str, config: RigConfig, **evidence: Any) -> None:
        """A state was reached, with JSON values as evidence; Refused: none before it.
        Evidence that is not that of before makes the states after it void."""
        number = STATES.index(name)
        if number and (text := self.missing(config, STATES[number - 1])):
            raise Refused(text)
        if self.state(name) not in (None, evidence):
            self.void(name, f"{name} was passed again, with new evidence")
        self._states[name] = {
            "time": _now(),
            "evidence": evidence,
            "fingerprint": _fingerprint(name, config),
        }
        self._voided.pop(name, None)
        if name == HOMED:
            self._left = {}  # counts of before mean nothing now
        self.save()

    def void(self, name: str, reason: str) -> None:
        """Take away a state and those after it; the operator is told the reason."""
        for lost in STATES[STATES.index(name) :]:
            if self._states.pop(lost, None) is not None:
                self._voided[lost] = {"time": _now(), "reason": reason}
        self.save()

    def missing(self, config: RigConfig, through: str = STOP_PROVED) -> str | None:
        """What keeps the states up to ``through`` from standing, and what to do."""
        needed = STATES[: STATES.index(through) + 1]
        for number, name in enumerate(needed):
            if (reason := self._fault(name, config)) is not None:
                commands = dict.fromkeys(COMMANDS[state] for state in needed[number:])
                words = [f"`jaxcal-rig {command}`" for command in commands]
                return (
                    f"the device is not {name}: {reason}. Run {', then '.join(words)} "
                    f"(`jaxcal-rig setup` does all). Record: {self.path}"
                )
        return None

    def _fault(self, name: str, config: RigConfig) -> str | None:
        from rig.config.config import differences

        state = self._states.get(name)
        if state is None:
            lost = self._voided.get(name)
            return lost["reason"] if lost else "it never was"
        then, now = state["fingerprint"], _fingerprint(name, config)
        if name in (IDENTIFIED, HOMED):  # pulses: no gearing, direction or phone in it
            ends = (".unit", ".map")
            then = {key: then[key] for key in then if key.endswith(ends)}
            now = {key: now[key] for key in now if key.endswith(ends)}
        changed = differences(then, now)
        return f"edited since: {'; '.join(changed)}" if changed else None

    # Where the drives stand between sessions

    def left_at(
        self, positions: Mapping[str, int | None], homed: Sequence[str] = ()
    ) -> None:
        """Where the drives are left, in pulses, None while armed; which say homed."""
        pulses = dict(positions)
        self._left = {"time": _now(), "pulses": pulses, "homed": list(homed)}
        self.save()

    def left(self) -> tuple[dict[str, int | None], list[str]]:
        """What `left_at` kept: pulses of each axis or None, and names of homed axes."""
        return self._left.get("pulses", {}), self._left.get("homed", [])


def _fingerprint(name: str, config: RigConfig) -> dict[str, Any]:
    """What of a configuration may not change while a state stands."""
    stops = config.stop_fingerprint() if name == STOP_PROVED else {}
    return config.device_fingerprint() | stops


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
