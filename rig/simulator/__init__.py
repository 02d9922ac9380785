"""The rig without a rig: drives, mechanism and phone, on loopback, with faults.

Real Modbus frames and real phone lines go over real sockets and pseudo-terminals; the
server is written from the protocol's text and shares no code with the client's library.
"""

from __future__ import annotations

from rig.simulator.faults import parse_fault
from rig.simulator.simulator import Simulator
from rig.simulator.truth import Truth, truth_of

__all__ = ["Simulator", "Truth", "parse_fault", "truth_of"]
