"""Pulses and degrees: ``theta = 360 p / (omega kappa)``, pure arithmetic."""

from __future__ import annotations

import dataclasses

__all__ = ["Scale"]


@dataclasses.dataclass(frozen=True)
class Scale:
    """One axis between its motor's pulses and its joint's degrees."""

    pulses_per_rev: int  # omega: pulses for one turn of the motor
    reduction: float  # kappa: motor turns for one turn of the joint
    direction: int = 1  # +1 or -1: sign of pulses for a positive angle

    @property
    def pulses_per_deg(self) -> float:
        """Signed pulses for one degree of the joint."""
        return self.direction * self.pulses_per_rev * self.reduction / 360.0

    def to_pulses(self, angle_deg: float) -> int:
        """Nearest whole pulse; the angle that counts is ``to_deg`` of it."""
        return round(angle_deg * self.pulses_per_deg)

    def to_deg(self, pulses: float) -> float:
        """Joint angle in degrees of a pulse count."""
        return pulses / self.pulses_per_deg

    def rounded_deg(self, angle_deg: float) -> float:
        """The angle a drive can really be sent to: that of the rounded pulses."""
        return self.to_deg(self.to_pulses(angle_deg))

    def rev_per_s(self, speed_deg_s: float) -> float:
        """Motor turns a second for a joint speed in degrees a second."""
        return speed_deg_s * self.reduction / 360.0
