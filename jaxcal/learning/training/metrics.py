"""metrics.csv and TensorBoard events of a run: a row for each update."""

from __future__ import annotations

import csv
import os
import pathlib

from jaxcal.files import atomic_write

__all__ = ["COLUMNS", "MetricsTable"]

COLUMNS = (
    "update",
    "episodes",
    "seconds",
    "reward_mean",
    "reward_std",
    "log_det_mean",
    "ratio_to_exact",
    "hit_rate",
    "entropy",
    "policy_loss",
    "value_loss",
    "kl",
    "learning_rate",
)


class MetricsTable:
    """Rows are flushed as they come; after a resume they go on where the state does."""

    def __init__(self, root: pathlib.Path, done: int) -> None:
        from tensorboardX import SummaryWriter  # 0.2 s; loads PyTorch where installed

        path = root / "metrics.csv"
        kept = _rows_until(path, done) if done else []
        with atomic_write(path) as file:
            lines = [",".join(COLUMNS), *kept]
            file.write(("\n".join(lines) + "\n").encode())
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, COLUMNS, extrasaction="ignore")
        self._events = SummaryWriter(str(root), flush_secs=30)

    def add(self, row: dict[str, float]) -> None:
        """Write the row of update ``row["update"]``; what is not measured is empty."""
        self._writer.writerow(row)
        self._file.flush()
        for name, value in row.items():
            if name not in ("update", "episodes"):
                self._events.add_scalar(name, value, row["update"])

    def close(self) -> None:
        """Bring everything to the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._events.close()


def _rows_until(path: pathlib.Path, done: int) -> list[str]:
    """Whole rows of a metrics file up to an update; later ones were never saved."""
    if not path.exists():
        return []
    kept = []
    for line in path.read_text().splitlines()[1:]:
        cells = line.split(",")
        if len(cells) == len(COLUMNS) and cells[0].isdigit() and int(cells[0]) <= done:
            kept.append(line)
    return kept
