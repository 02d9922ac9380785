"""What can be wrong with a device, as exceptions."""

from __future__ import annotations

__all__ = ["MotionFault", "NotFollowing", "Unreachable"]


class MotionFault(RuntimeError):
    """Something is wrong with the device: stop everything and latch."""


class NotFollowing(MotionFault):
    """A drive turned and the IMU did not see it.

    ``suspects`` are the postures recorded since the axis was last seen to follow: the
    coupling may have slipped before any of them.
    """

    def __init__(self, text: str, suspects: list[str]) -> None:
        self.suspects = suspects
        super().__init__(text)


class Unreachable(RuntimeError):
    """The device is sound but cannot get there: leave this posture out."""
