"""Other makers of D-optimal designs, each asked for k of the M candidates.

Each function takes candidates (M, 3) and k and returns (k,) indices. What the packages
may do differs: jaxcal, AlgDesign and brute force choose distinct candidates; pyoptex
and pydoe may repeat one, so they are judged against the optimum with repeats.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import pathlib
import shutil
import subprocess
import tempfile

import numpy as np
from numpy.typing import NDArray

Candidates = NDArray[np.float64]
Indices = NDArray[np.int64]


def brute_force(candidates: Candidates, k: int, chunk: int = 50_000) -> Indices:
    """Every subset of k = 4, their 4 x 4 determinants by NumPy in chunks."""
    rows = _rows(candidates)
    best, found = -np.inf, np.zeros(k, np.int64)
    subsets = itertools.combinations(range(len(rows)), k)
    while True:
        flat = np.fromiter(
            itertools.chain.from_iterable(itertools.islice(subsets, chunk)), np.int64
        )
        if not len(flat):
            return found
        block = flat.reshape(-1, k)
        z = rows[block]
        gram = z if k == rows.shape[1] else np.matrix_transpose(z) @ z
        values = np.abs(np.linalg.det(gram))
        top = int(values.argmax())
        if values[top] > best:
            best, found = float(values[top]), block[top]


def num_subsets(m: int, k: int) -> int:
    """How many subsets brute force looks at."""
    return math.comb(m, k)


def by_pyoptex(candidates: Candidates, k: int, tries: int = 10) -> Indices:
    """pyoptex's exchange over one factor whose M levels are the candidates."""
    from pyoptex.doe.fixed_structure import (
        Factor,
        create_fixed_structure_design,
        create_parameters,
        default_fn,
    )
    from pyoptex.doe.fixed_structure.metric import Dopt

    m = len(candidates)
    rows = np.ascontiguousarray(_rows(candidates))
    factor = Factor("posture", type="cont", min=0, max=m - 1, levels=list(range(m)))

    def model(y: NDArray[np.float64]) -> NDArray[np.float64]:
        index = np.rint(y[:, 0] * factor.scale + factor.mean).astype(np.int64)
        return rows[index]

    with contextlib.redirect_stderr(io.StringIO()):  # its progress bar
        parameters = create_parameters([factor], default_fn([factor], Dopt(), model), k)
        design, _ = create_fixed_structure_design(parameters, n_tries=tries)
    return np.rint(design["posture"].to_numpy()).astype(np.int64)


def by_pydoe(
    candidates: Candidates, k: int, method: str = "modified_fedorov"
) -> Indices:
    """pydoe's ``optimal_design`` of degree 1."""
    from pydoe import optimal

    design, _ = optimal.optimal_design(
        candidates, k, degree=1, criterion="D", method=method
    )
    square = ((design[:, None, :] - candidates[None]) ** 2).sum(-1)
    return square.argmin(1)


_R_CODE = """
suppressMessages(library(AlgDesign))
a <- commandArgs(trailingOnly = TRUE)
sets <- as.matrix(read.csv(a[1], header = FALSE))
m <- as.integer(a[2]); k <- as.integer(a[3]); repeats <- as.integer(a[4])
set.seed(1)
invisible(optFederov(~., data.frame(sets[1:m, ]), nTrials = k))
for (b in seq_len(nrow(sets) / m)) {
  data <- data.frame(sets[(b - 1) * m + seq_len(m), ])
  t <- proc.time()[["elapsed"]]
  begun <- Sys.time()
  found <- optFederov(~., data, nTrials = k, nRepeats = repeats)
  took <- as.numeric(difftime(Sys.time(), begun, units = "secs"))
  cat(c(found$rows - 1, took), sep = ","); cat("\\n")
}
"""


def has_algdesign() -> bool:
    """Whether R and its package AlgDesign are installed."""
    if shutil.which("Rscript") is None:
        return False
    done = subprocess.run(
        ["Rscript", "-e", "library(AlgDesign)"], capture_output=True, check=False
    )
    return done.returncode == 0


def by_algdesign(
    sets: NDArray[np.float64], k: int, repeats: int = 5
) -> tuple[Indices, list[float]]:
    """R's ``optFederov`` on (B, M, 3) sets: (B, k) indices and R's own seconds each."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "sets.csv"
        np.savetxt(file, sets.reshape(-1, sets.shape[-1]), delimiter=",")
        done = subprocess.run(
            ["Rscript", "-e", _R_CODE]
            + [str(a) for a in (file, sets.shape[1], k, repeats)],
            capture_output=True,
            text=True,
            check=True,
        )
    table = np.array([line.split(",") for line in done.stdout.split()], float)
    return table[:, :-1].astype(np.int64), list(table[:, -1])


def _rows(candidates: Candidates) -> NDArray[np.float64]:
    return np.hstack([np.ones((len(candidates), 1)), candidates])
