"""Transmission error of unknown frequency: ``amplitude sin(2 pi frequency u + phase)``.

The period of a gear's error is known only if the numbers of teeth are; that of a bent
shaft or a loose belt is not. Postures far apart determine the frequency finely, but
only once it is known well enough to count the periods between them: the information of
a posture depends on the belief.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks.registry import Entry

__all__ = ["ENTRY", "transmission_error"]


def transmission_error(
    frequencies: tuple[float, float] = (0.5, 6.0),
    *,
    cells: int = 48,
    amplitudes: tuple[float, ...] = (0.5, 1.0),
    phases: int = 16,
    sigma: float = 0.3,
    num_postures: int = 49,
    num_bins: int = 24,
    measure_s: float = 1.0,
    travel_s: float = 2.0,
    measurements: int = 20,
    seconds: float | tuple[float, float] = np.inf,
) -> GridTask:
    """The task: theta = (frequency, amplitude, phase), design = (posture,) in [0, 1].

    Args:
        frequencies: lowest and highest, in periods over the range of the axis; cells
            are equal between them.
        cells: of the frequency.
        amplitudes: the possible ones, in the reading's unit.
        phases: evenly spaced over a turn.
        sigma: noise of a reading.
        num_postures: evenly spaced over the range.
        num_bins: outcomes, from below the lowest to above the highest reading.
        measure_s: seconds of a reading.
        travel_s: seconds over the full range.
        measurements: that end a session.
        seconds: budget of a session, or (least, most) to draw it from.
    """
    low, high = frequencies
    if not 0.0 < low < high:
        raise ValueError(f"frequencies must be 0 < low < high, got {frequencies}")
    step = (high - low) / cells
    theta = np.stack(
        np.meshgrid(
            low + step * (np.arange(cells) + 0.5),
            np.asarray(amplitudes, np.float64),
            2.0 * np.pi * np.arange(phases) / phases,
            indexing="ij",
        ),
        axis=-1,
    ).reshape(-1, 3)
    at = np.linspace(0.0, 1.0, num_postures)
    frequency, amplitude, phase = theta.T[:, None]
    mean = amplitude * np.sin(2.0 * np.pi * frequency * at[:, None] + phase)
    highest = float(np.max(amplitudes)) + 2.0 * sigma
    edges = np.linspace(-highest, highest, num_bins + 1)[1:-1]
    below = special.ndtr((edges[None, :, None] - mean[:, None]) / sigma)
    here = np.append(at, 0.0)
    return GridTask.make(
        theta,
        at,
        np.diff(below, axis=1, prepend=0.0, append=1.0),
        travel=measure_s + travel_s * np.abs(here[:, None] - at),
        uses=1,
        num_uses=measurements,
        horizon=measurements,
        seconds=seconds,
        theta_names=["frequency", "amplitude", "phase"],
    )


ENTRY = Entry(transmission_error, about="a transmission error of unknown frequency")
