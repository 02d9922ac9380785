"""Which of the six Euler orders the measured attitudes fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.config import RigConfig
from rig.core.attitude import ORDERS, Frame
from rig.core.identify import pairs
from rig.journal import Record


def order_residuals(
    config: RigConfig, frame: Frame, records: list[Record]
) -> dict[str, Any]:
    """Residual of the linear fit under each of the six mechanism orders.

    The right order leaves noise; a wrong one leaves degrees. Needs more than four
    postures; with four every order fits exactly.

    Returns:
        rms (order to degrees), configured, best, warning (empty where all is well).
    """
    configured = config.mechanism.order
    if len(records) < 6:
        return {"rms": {}, "configured": configured, "warning": ""}
    design = np.column_stack([pairs(records)[0], np.ones(len(records))])
    across = np.eye(len(records)) - design @ np.linalg.pinv(design)
    attitudes = np.array([r["attitude"] for r in records])
    rms: dict[str, float] = {}
    for order in ORDERS:
        left = across @ frame.angles(attitudes, order)
        rms[order] = float(np.sqrt((left**2).sum() / (3 * (len(records) - 4))))
    best = min(rms, key=lambda order: rms[order])
    noise = float(np.mean([r["std_deg"] for r in records]))
    warning = ""
    if rms[configured] > max(2.0 * rms[best], 0.02):
        warning = (
            f"the order {best} leaves {rms[best]:.3f} deg where the configured "
            f"{configured} leaves {rms[configured]:.3f}: check mechanism.order and the "
            "phone's order"
        )
    elif rms[configured] > max(10.0 * noise, 0.1):
        warning = (
            f"the fit leaves {rms[configured]:.3f} deg under the configured order "
            f"{configured}, far above the readings' scatter of {noise:.3f}: check the "
            "phone's order and signs ([imu] order), its mounting, and play"
        )
    return {"rms": rms, "configured": configured, "best": best, "warning": warning}
