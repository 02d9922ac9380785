"""Which criterion of which parameters, and what it becomes in whitened coordinates."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import one_of
from jaxcal.information.blocks import Whitened
from jaxcal.information.criterion import CRITERIA, Criterion

__all__ = ["Wanted", "wanted_criterion"]

Array = NDArray[np.float64]


class Wanted(NamedTuple):
    """What the criterion is about, in the caller's numbers."""

    name: str
    positions: list[int] | None = None  # of the parameters of interest, for Ds and As
    region: Array | None = None  # (R, q, p) for I; the available candidates if None
    times: int = 1  # how often log det and trace count

    def whitened(self, white: Whitened, b: int, readings: int) -> Criterion:
        """In the coordinates of set b, whose available candidates give ``readings``."""
        basis = white.basis[b]
        p = len(basis)
        if self.name == "D":
            return Criterion("D", _identity(p), self.times, float(white.log_scale[b]))
        if self.name == "I":
            if self.region is None:
                mean = (np.eye(p) - white.prior[b]) / readings
            else:
                rows = (self.region @ basis).reshape(-1, p)
                mean = rows.T @ rows / len(rows)
            size, vectors = np.linalg.eigh(mean)
            keep = size > 1e-14 * size[-1]
            return Criterion("I", np.sqrt(size[keep])[:, None] * vectors.T[keep])
        root = basis if self.positions is None else basis[self.positions]
        return Criterion(self.name, root, 1 if self.name == "E" else self.times)


@functools.cache
def _identity(p: int) -> Array:
    identity = np.eye(p)
    identity.flags.writeable = False
    return identity


def wanted_criterion(
    name: str | None,
    parameters: Sequence[str | int] | None,
    names: tuple[str, ...],
    default: str,
    region: object = None,
) -> Wanted:
    """The criterion asked for, checked.

    Args:
        name: one of ``CRITERIA``; ``default`` for None.
        parameters: names or indices of those of interest: for Ds and As, no others.
        names: (p,) of all free parameters.
        default: the criterion where none is asked for.
        region: as given by the caller, refused unless the criterion is I.
    """
    name = default if name is None else one_of("criterion", name, CRITERIA)
    if region is not None and name != "I":
        raise ValueError(
            "region, where predictions are wanted, must come with criterion I, "
            f"got criterion {name}"
        )
    if (name in ("Ds", "As")) != (parameters is not None):
        raise ValueError(
            "parameters, those of interest, must be given with criterion Ds or As, "
            f"and with no other, got {parameters!r} with {name!r}"
        )
    if parameters is None:
        return Wanted(name)
    given = [parameters] if isinstance(parameters, str) else list(parameters)
    found = [names.index(x) if x in names else x for x in given]
    for at, asked in zip(found, given, strict=True):
        whole = isinstance(at, int | np.integer) and not isinstance(at, bool)
        if not whole or not 0 <= int(at) < len(names):
            raise ValueError(
                "parameters must be indices or names of free parameters "
                f"({', '.join(names)}), got {asked!r}"
            )
    if len(set(found)) < len(found) or not found:
        raise ValueError(f"parameters must name some once each, got {given!r}")
    return Wanted(name, [int(at) for at in found])
