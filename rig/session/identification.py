"""From recorded postures to a calibration, its uncertainty and its checks."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.attitude import ORDERS, Array, Frame
from rig.config import AXIS_NAMES, RigConfig
from rig.outputs.journal import Record


def pairs(records: list[Record]) -> tuple[Array, Array]:
    """(N, 3) commands and (N, 3) measurements in degrees of posture records."""
    commands = np.array([r["commanded_deg"] for r in records]).reshape(-1, 3)
    return commands, np.array([r["measured_deg"] for r in records]).reshape(-1, 3)


def mean_variance(record: Record) -> Array:
    """(3,) degrees squared, of the mean of a posture's or the zero's readings."""
    return np.array(record["std_deg"]) ** 2 / record["samples"]


def fit(
    records: list[Record],
    noise_std: float | None = None,
    notes: Record | None = None,
    zero_std: float = 0.0,
) -> Any:
    """``jaxcal.identify`` on posture records.

    Args:
        records: chosen postures.
        noise_std: degrees, of one recorded mean; from the scatter of its readings when
            not given.
        notes: stored in the calibration's file.
        zero_std: degrees, of the zero reference. It shifts every output equally, so it
            adds to the variance of the outputs' mean.
    """
    import jaxcal

    if noise_std is None:
        noise_std = np.sqrt(np.mean([mean_variance(r) for r in records]))
    noise_std = max(1e-9, float(noise_std))
    fitted: Any = jaxcal.identify(
        *pairs(records),
        noise_std=noise_std,
        input_names=AXIS_NAMES,
        output_names=AXIS_NAMES,
        command_unit="deg",
        measured_unit="deg",
        notes=notes,
    )
    total = 1.0 / (1.0 / fitted.total_weight + (zero_std / noise_std) ** 2)
    return dataclasses.replace(fitted, total_weight=total)


def uncertainty(
    calibration: Any, chosen: list[Record], held_out: list[Record], zero: Record
) -> dict[str, Any]:
    """Noise of one recorded mean and 95 % half-widths of A and b.

    ``ci95`` holds all twelve parameters at once in 95 % of sessions (Bonferroni),
    ``ci95_each`` each by itself, so that one or two of twelve may well miss.

    Four postures leave no residual, so the noise is taken from what they did not fit:
    the prediction errors at held-out postures (which also hold play and drift), each
    made smaller by the share its own prediction variance has in it, pooled with the
    residuals of the chosen where there are more than four. Without held-out postures
    only the scatter of single readings is known, which is too optimistic; ``basis``
    says which it was. The noise of the zero reference shifts all postures equally and
    leaves no trace in them, so it is added to the bias from the zero's own scatter.

    Returns:
        noise_std (3,), dof, basis, and (3, 4) half-widths of [A | b] in degrees.
    """
    from scipy import stats

    inverse = calibration.unit_covariance  # of (slopes, bias), for noise of 1 degree
    commands, measured = pairs(chosen)
    squares = ((measured - calibration.predict(commands)) ** 2).sum()
    dof = 3 * (len(chosen) - 4)
    basis = ["residuals of the chosen postures"] if dof else []
    if held_out:
        u, y = pairs(held_out)
        rows = np.column_stack([u, np.ones(len(u))])
        # Prediction errors share the fitted parameters: whiten them by their joint
        # covariance, I + Z (Z_s' Z_s)^-1 Z', up to the noise variance looked for.
        covariance = np.eye(len(u)) + rows @ inverse @ rows.T
        off = y - calibration.predict(u)
        squares += (np.linalg.solve(np.linalg.cholesky(covariance), off) ** 2).sum()
        dof += 3 * len(u)
        basis.append("held-out predictions")
    if dof:
        # One sensor measures the three axes; pooling triples the degrees of freedom.
        variance, law = np.full(3, squares / dof), stats.t(dof)
    else:
        variance = np.mean([mean_variance(r) for r in chosen], axis=0)
        law = stats.norm()
        basis = ["scatter of single readings only"]
    spread = np.outer(variance, np.diag(inverse))
    spread[:, 3] += mean_variance(zero)
    one, all_twelve = law.ppf([1 - 0.05 / 2, 1 - 0.05 / 2 / spread.size])
    return {
        "noise_std_deg": np.sqrt(variance).tolist(),
        "dof": dof,
        "basis": " and ".join(basis),
        "ci95": (all_twelve * np.sqrt(spread)).tolist(),
        "ci95_each": (one * np.sqrt(spread)).tolist(),
    }


def errors(records: list[Record], desired: Array) -> dict[str, Any]:
    """Statistics of measured minus desired, degrees, an axis and overall."""
    difference = pairs(records)[1] - desired
    return {
        "rms_axis": np.sqrt((difference**2).mean(axis=0)).tolist(),
        "rms": float(np.sqrt((difference**2).mean())),
        "max": float(np.abs(difference).max()),
        "each": difference.tolist(),
    }


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
