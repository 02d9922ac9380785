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

``s_i`` are the L = m p singular values of the regression matrix, the roots of S's
eigenvalues. All but I, G and a ratio of two D depend on the unit of the commands.

Sources: Atkinson, Donev and Tobias, Optimum Experimental Designs (D, A, I, E, G);
Nahvi and Hollerbach, The noise amplification index for optimal pose selection in robot
calibration, ICRA 1996 (O1 to O4); Sun and Hollerbach, ICRA 2008 (O5).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxcal.checks import Array
from jaxcal.information.blocks import rank_of_blocks, whiten


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


def criteria(blocks: Array, root: Array, region: Array, times: int) -> Criteria:
    """Every criterion of blocks (N, q, p), not singular, and a prior's root (r, p).
    ``region`` (R, m, p) is where predictions are wanted, ``times`` how often the
    eigenvalues of the information count."""
    p = blocks.shape[2]
    s = np.linalg.svd(np.concatenate([blocks.reshape(-1, p), root]), compute_uv=False)
    white = whiten(blocks[None], np.ones((1, len(blocks)), dtype=np.bool_), root)[0]
    assert white is not None
    variance = (white.of(region) ** 2).sum(axis=-1)
    geometric_mean = float(np.exp(rank_of_blocks(blocks[None], root)[1][0] / (2 * p)))
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
