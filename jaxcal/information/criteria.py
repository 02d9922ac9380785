"""What a set of postures is worth: D, A, I, E, G and the observability indices.

All come from the small Gram matrix ``G = Z.T @ Z`` (p x p, p = n + 1) and are those of
the full information matrix ``S = I_m (x) G``, whose eigenvalues are G's, each m times.

========  =============================================================  ==========
name      definition, noise of unit variance on every output             better
========  =============================================================  ==========
``D``     det(S)^(1 / (m p)), the geometric mean eigenvalue of S          larger
``A``     trace(S^-1), the sum of the parameter variances                 smaller
``I``     mean over the region of z.T G^-1 z, the variance of a predicted  smaller
          output (also known as V or IV)
``E``     smallest eigenvalue of S                                        larger
``G``     largest z.T G^-1 z over the region                              smaller
``O1``    (s_1 ... s_L)^(1/L) / sqrt(N), N postures                       larger
``O2``    s_min / s_max                                                   larger
``O3``    s_min                                                           larger
``O4``    s_min^2 / s_max, the noise amplification index                  larger
``O5``    1 / (1/s_1 + ... + 1/s_L)                                       larger
========  =============================================================  ==========

``s_i`` are the L = m p singular values of the regression matrix. D, A, E and O1 to O5
depend on the unit of the commands; I and G do not, and neither does a ratio of two D.

Sources: Atkinson, Donev and Tobias, Optimum Experimental Designs (D, A, I, E, G);
Nahvi and Hollerbach, The noise amplification index for optimal pose selection in robot
calibration, ICRA 1996 (O1 to O4); Sun and Hollerbach, ICRA 2008 (O5).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.information.regression import log_det_gram, regressors

__all__ = ["Criteria", "criteria", "d_efficiency"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Criteria:
    """The criteria of one set of postures; the table at the top defines each."""

    D: float
    A: float
    I: float  # noqa: E741 - the criterion's own name in the literature
    E: float
    G: float
    O1: float
    O2: float
    O3: float
    O4: float
    O5: float

    def as_dict(self) -> dict[str, float]:
        """Name to value, in the order of the table."""
        return dataclasses.asdict(self)


def d_efficiency(log_det: float, log_det_best: float, num_parameters: int) -> float:
    """D-efficiency ``(det S / det S*)^(1 / num_parameters)``.

    Args:
        log_det: natural log det S of the set judged.
        log_det_best: that of the optimum, or an upper bound on it.
        num_parameters: m (n + 1), 12 for three inputs and three outputs.
    """
    return float(np.exp((log_det - log_det_best) / num_parameters))


def criteria(
    commands: ArrayLike,
    region: ArrayLike | None = None,
    num_outputs: int | None = None,
) -> Criteria:
    """Every criterion of one set of postures.

    Args:
        commands: (N, n) the postures measured, in any unit.
        region: (R, n) the postures at which predictions are wanted, for I and G; the
            measured ones themselves when not given.
        num_outputs: m; as many as inputs when not given.

    Raises:
        ValueError: the postures lie in one plane, so S has no inverse.
    """
    z = regressors(commands)
    where = z if region is None else regressors(region)
    if z.ndim != 2 or where.ndim != 2 or z.shape[1] != where.shape[1]:
        raise ValueError(
            "commands must be (N, n) and region (R, n) with the same n, got "
            f"{z[..., :-1].shape} and {where[..., :-1].shape}"
        )
    log_det = float(log_det_gram(z[:, :-1]))
    if np.isneginf(log_det):
        raise ValueError(
            "commands must not all lie in one plane: the information matrix of these "
            f"{len(z)} postures is singular"
        )
    num_postures, p = z.shape
    m = p - 1 if num_outputs is None else num_outputs
    s = np.linalg.svd(z, compute_uv=False)
    geometric_mean = float(np.exp(log_det / (2 * p)))
    variance = _prediction_variance(z[:, :-1], where[:, :-1])
    return Criteria(
        D=geometric_mean**2,
        A=float(m * np.sum(s**-2.0)),
        I=float(variance.mean()),
        E=float(s[-1] ** 2),
        G=float(variance.max()),
        O1=geometric_mean / float(np.sqrt(num_postures)),
        O2=float(s[-1] / s[0]),
        O3=float(s[-1]),
        O4=float(s[-1] ** 2 / s[0]),
        O5=float(1.0 / (m * np.sum(1.0 / s))),
    )


def _prediction_variance(commands: Array, region: Array) -> Array:
    """(R,) ``z.T G^-1 z``, about the centroid to keep the digits of far commands."""
    centre = commands.mean(axis=0)
    offset = commands - centre
    scale = np.abs(offset).max(axis=0)
    r = np.linalg.qr(offset / scale)[1]
    t = np.linalg.solve(r.T, ((region - centre) / scale).T)
    return 1.0 / len(commands) + np.sum(t**2, axis=0)
