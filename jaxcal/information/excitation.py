"""Do the commands excite every direction, and if not, which was left out?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["direction_in_words", "require_excited"]

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)


def require_excited(commands: Array, names: tuple[str, ...]) -> None:
    """Refuse commands that leave a direction unexcited, and name it."""
    count, n = commands.shape
    offset = commands - commands.mean(axis=0) if count else commands
    norms = np.linalg.norm(offset, axis=0)
    largest = np.abs(commands).max(axis=0, initial=0.0)
    # Commands are exact to half a unit in the last place of their size: a direction
    # no wider than that is rounding, the same rule as jaxcal.information.regression.log_det_gram.
    resolution = _EPS * max(count, 1)
    flat = norms <= resolution * largest
    safe = np.where(flat, 1.0, norms)
    _, singular, right = np.linalg.svd(np.where(flat, 0.0, offset / safe))
    rounding = float((largest / np.where(flat, np.inf, norms)).max())
    tolerance = resolution * max(8.0, rounding)
    singular = np.concatenate([singular, np.zeros(max(0, n - len(singular)))])
    missing = np.flatnonzero(singular <= tolerance)
    if count >= n + 1 and missing.size == 0:
        return
    # Axes that never moved are named as such, then the rest of the null space.
    null = [np.eye(n)[i] for i in np.flatnonzero(flat)]
    free = right[missing][:, ~flat]
    if free.size:
        basis, size, _ = np.linalg.svd(free.T, full_matrices=False)
        for vector in basis.T[size > 0.5]:
            direction = np.zeros(n)
            direction[~flat] = vector / norms[~flat]
            null.append(direction)
    named = "; ".join(direction_in_words(vector, names) for vector in null)
    plural = "directions" if len(null) > 1 else "direction"
    never = f"the {plural} never excited: {named}" if null else ""
    if count < n + 1:
        raise ValueError(
            f"commands must hold at least {n + 1} postures of positive weight for {n} "
            f"inputs and a bias, got {count}" + (f"; {never}" if never else "")
        )
    raise ValueError(
        f"commands must vary in every direction, but all {count} postures have the "
        f"same component along {never}"
    )


def direction_in_words(vector: Array, names: tuple[str, ...]) -> str:
    """A direction in the named axes, largest component positive, unit length."""
    vector = vector / np.linalg.norm(vector)
    vector = vector * np.sign(vector[np.abs(vector).argmax()])
    vector = np.where(np.abs(vector) < 1e-9, 0.0, vector)
    present = np.flatnonzero(vector)
    if present.size == 1:
        return names[present[0]]
    parts = [f"{vector[i]:+.4g} {names[i]}" for i in present]
    return "(" + " ".join(parts) + ")"
