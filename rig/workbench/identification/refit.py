"""A recorded calibration identified anew: same readings, other orders or mounting.

The phone's angles are what was recorded, whatever was made of them: the attitude of a
reading is taken apart under the order and signs of then and put together under those of
now.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import RigConfig
from rig.config.settings import ImuSettings
from rig.core.attitude import (
    DIGITS,
    Array,
    Frame,
    attitudes,
    euler_to_matrix,
    frame_at,
    matrix_to_euler,
    mean_rotation,
)
from rig.core.faults import Refused
from rig.journal import Record, measured_postures
from rig.workbench.identification.conclusion import Evidence


def require_angles(imu: ImuSettings, changes: dict[str, Any]) -> None:
    """Refused where the phone sent quaternions, which have neither order nor signs."""
    for name in changes.keys() & {"imu.order", "imu.signs"}:
        if _quaternions(imu):
            raise Refused(
                f"{name} cannot be changed to {changes[name]}: this phone sent "
                "quaternions, which have neither order nor signs. Look at "
                "mechanism.order and imu.mounting_deg"
            )


def _quaternions(imu: ImuSettings) -> bool:
    return imu.format == "sensorlogger" or imu.quaternion_columns is not None


def reread(
    records: list[Record], then: RigConfig, now: RigConfig
) -> tuple[list[Record], Evidence]:
    """Zero, postures and held-out pairs as another configuration reads them.

    Args:
        records: of the journal of a calibration, of any version.
        then: its configuration.
        now: the same but for orders, signs and mounting.

    Returns:
        The records for a new journal, and the evidence to conclude from.

    Raises:
        Refused: not enough was measured to identify from.
    """
    kept = {"zero": [], "held_out": []}  # type: dict[str, list[Record]]
    for record in records:
        kept.get(record["event"], []).append(record)
    postures = measured_postures(records)
    chosen = [r for r in postures.values() if r.get("role") == "select"]
    if not kept["zero"] or len(chosen) < then.session.k:
        raise Refused(
            f"the run holds {len(chosen)} of the {then.session.k} chosen postures that "
            "a calibration takes. Resume it first"
        )
    zero = kept["zero"][-1]
    old = frame_at(then, np.array(zero["attitude"]))
    turned = _turned(attitudes(zero, old), then.imu, now.imu)
    new = frame_at(now, mean_rotation(turned))
    zero = _remeasured(zero, turned, new)
    zero["measured_deg"] = [0.0, 0.0, 0.0]
    read = {
        name: _remeasured(r, _turned(attitudes(r, old), then.imu, now.imu), new)
        for name, r in postures.items()
    }
    of_role: dict[str, list[Record]] = {}
    for record in read.values():
        of_role.setdefault(record.get("role", ""), []).append(record)
    held = kept["held_out"][-1:]
    evidence = Evidence(
        zero=zero,
        chosen=of_role["select"],
        held=held[0]["pairs"] if held else [],
        held_out=of_role.get("before", []) + of_role.get("after", []),
        references=sorted(of_role.get("reference", []), key=lambda r: r["time"]),
    )
    return [zero, *held, *read.values()], evidence


def _turned(matrices: Array, then: ImuSettings, now: ImuSettings) -> Array:
    """(N, 3, 3) attitudes from the same phone angles under other order and signs."""
    if (then.order, then.signs) == (now.order, now.signs) or _quaternions(then):
        return matrices
    sent = matrix_to_euler(matrices, str(then.order)) * np.array(then.signs)
    return euler_to_matrix(sent * np.array(now.signs), str(now.order))


def _remeasured(record: Record, matrices: Array, frame: Frame) -> Record:
    attitude = mean_rotation(matrices)
    spread = frame.angles(matrices)
    std = spread.std(axis=0, ddof=1) if len(spread) > 1 else np.zeros(3)
    quaternions = Rotation.from_matrix(matrices).as_quat(canonical=True)
    kept = {key: value for key, value in record.items() if key != "raw_deg"}
    return kept | {
        "measured_deg": frame.angles(attitude).round(9).tolist(),
        "std_deg": std.round(6).tolist(),
        "attitude": attitude.round(12).tolist(),
        "quaternions": quaternions.round(DIGITS).tolist(),
    }
