"""Do the commands excite every direction, and if not, which was left out?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.blocks import null_directions

__all__ = ["direction_in_words", "directions_in_words", "require_excited"]

Array = NDArray[np.float64]


def require_excited(
    commands: Array,
    names: tuple[str, ...],
    argument: str = "commands",
    which: str = "postures",
    coarse: float = 1.0,
) -> None:
    """Refuse commands (N, n) that leave a direction unexcited, and name it.

    Args:
        commands: (N, n).
        names: n names of the axes.
        argument, which: what the message calls the commands: "candidates must vary in
            every direction, but the 5 available ones lie in one plane ...".
        coarse: how many times coarser than float64 the numbers are.
    """
    count, n = commands.shape
    offset = commands - commands.mean(axis=0) if count else commands
    largest = np.abs(commands).max(axis=0, initial=0.0)
    null = null_directions(offset, coarse * largest)
    if count >= n + 1 and not null:
        return
    never = directions_in_words("the direction{} never excited: ", null, names)
    if count < n + 1:
        raise ValueError(
            f"{argument} must hold at least {n + 1} postures of positive weight for "
            f"{n} inputs and a bias, got {count}" + (f"; {never}" if never else "")
        )
    place = {1: "at one point", 2: "on one line"}.get(n, "in one plane")
    raise ValueError(
        f"{argument} must vary in every direction, but the {count} {which} lie "
        f"{place}; {never}"
    )


def directions_in_words(text: str, null: list[Array], names: tuple[str, ...]) -> str:
    """``text`` with its plural at {}, then every direction; empty if there is none."""
    if not null:
        return ""
    named = "; ".join(direction_in_words(vector, names) for vector in null)
    return text.format("s" if len(null) > 1 else "") + named


def direction_in_words(vector: Array, names: tuple[str, ...]) -> str:
    """A direction in the named axes, largest component positive, unit length."""
    vector = vector / np.linalg.norm(vector)
    size = np.abs(vector)
    vector = vector * np.sign(vector[(size > (1.0 - 1e-9) * size.max()).argmax()])
    vector = np.where(np.abs(vector) < 1e-9, 0.0, vector)
    present = np.flatnonzero(vector)
    if present.size == 1:
        return names[present[0]]
    parts = [f"{vector[i]:+.4g} {names[i]}" for i in present]
    return "(" + " ".join(parts) + ")"
