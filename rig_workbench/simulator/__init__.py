"""The rig without a rig: drives, mechanism and phone, on loopback, with faults.

Real Modbus frames and real phone lines go over real sockets and pseudo-terminals; the
server is written from the protocol's text and shares no code with the client's library.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rig.config import RigConfig
from rig_workbench.simulator.faults import KINDS, parse_fault
from rig_workbench.simulator.simulator import Simulator
from rig_workbench.simulator.truth import Truth, truth_of

__all__ = ["KINDS", "Simulator", "Truth", "parse_fault", "simulated", "truth_of"]


def simulated(
    config: RigConfig, options: dict[str, Any], faults: Sequence[str]
) -> Simulator:
    """A simulated rig as the options of a command line describe it."""
    return Simulator(
        config,
        truth_of(options, config),
        [parse_fault(text, config.axis_names) for text in faults],
        transport=options["transport"],
        rate_hz=options["rate"],
        speedup=options["speedup"],
    )
