"""metrics.csv and TensorBoard events of a run: a row for each update."""

from __future__ import annotations

import csv
import os
import pathlib
from collections.abc import Sequence

from jaxcal.files import write_text

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

    def __init__(
        self, root: pathlib.Path, done: int, columns: Sequence[str] = COLUMNS
    ) -> None:
        from tensorboardX import SummaryWriter  # 0.2 s; loads PyTorch where installed

        path = root / "metrics.csv"
        lines = [",".join(columns), *_rows_until(path, done, len(columns))]
        write_text(path, "\n".join(lines) + "\n")
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, columns, extrasaction="ignore")
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


def _rows_until(path: pathlib.Path, done: int, width: int) -> list[str]:
    """Whole rows of a metrics file up to an update; later ones were never saved."""
    lines = path.read_text().splitlines()[1:] if path.exists() else []
    whole = [line for line in lines if line.count(",") == width - 1]
    numbers = [line.partition(",")[0] for line in whole]
    return [
        line
        for line, number in zip(whole, numbers, strict=True)
        if number.isdigit() and int(number) <= done
    ]
