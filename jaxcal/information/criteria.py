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

``s_i`` are the L = m p singular values of the regression matrix, the roots of the
eigenvalues of S. D, A, E and O1 to O5 depend on the unit of the commands; I and G do
not, and neither does a ratio of two D.

Sources: Atkinson, Donev and Tobias, Optimum Experimental Designs (D, A, I, E, G);
Nahvi and Hollerbach, The noise amplification index for optimal pose selection in robot
calibration, ICRA 1996 (O1 to O4); Sun and Hollerbach, ICRA 2008 (O5).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.information.blocks import log_det_blocks, whiten
from jaxcal.information.regression import log_det_gram, regressors

__all__ = ["Criteria", "block_criteria", "criteria", "d_efficiency"]

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
    m = z.shape[1] - 1 if num_outputs is None else num_outputs
    if np.isneginf(log_det_gram(z[:, :-1])):
        raise ValueError(
            "commands must not all lie in one plane: the information matrix of these "
            f"{len(z)} postures is singular"
        )
    return block_criteria(z[:, None], np.zeros((0, z.shape[1])), where[:, None], m)


def block_criteria(blocks: Array, root: Array, region: Array, times: int) -> Criteria:
    """Every criterion of information that is not singular.

    Args:
        blocks: (N, q, p) measured.
        root: (r, p) of the prior precision, r = 0 without one.
        region: (R, q, p) where predictions are wanted, for I and G.
        times: m, how often the eigenvalues of the information count.
    """
    p = blocks.shape[2]
    s = np.linalg.svd(np.concatenate([blocks.reshape(-1, p), root]), compute_uv=False)
    white = whiten(blocks[None], np.ones((1, len(blocks)), dtype=np.bool_), root)
    variance = ((region @ white.basis[0]) ** 2).sum(axis=-1)
    geometric_mean = float(np.exp(log_det_blocks(blocks, root) / (2 * p)))
    return Criteria(
        D=geometric_mean**2,
        A=float(times * np.sum(s**-2.0)),
        I=float(variance.mean()),
        E=float(s[-1] ** 2),
        G=float(variance.max()),
        O1=geometric_mean / float(np.sqrt(len(blocks))),
        O2=float(s[-1] / s[0]),
        O3=float(s[-1]),
        O4=float(s[-1] ** 2 / s[0]),
        O5=float(1.0 / (times * np.sum(1.0 / s))),
    )
