"""Training curves as a CSV table that a resumed run continues."""

from __future__ import annotations

import csv
import io
import logging
import math
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities import rank_zero_only

from devrf.errors import DevrfError
from devrf.system.files import atomic_write, read_record

log = logging.getLogger(__name__)

# Bytes of a table at most, and its rows, of which each takes some hundred in memory.
LARGEST = 2**26
MOST_ROWS = 2**20


class ResumableCSVLogger(CSVLogger):
    """Writes a row of ``<save_dir>/<name>/<version>/metrics.csv`` for every step, at once.

    An existing table is continued, where Lightning's logger would delete it. On a full disk the
    rows wait in memory until there is room.

    Attributes:
        path: the table.
    """

    def __init__(self, save_dir: str | Path, name: str = "logs", version: str = "run") -> None:
        """Read the table if there is one, without a last line that was cut off.

        Raises:
            DevrfError: it is damaged.
        """
        super().__init__(save_dir, name, version)
        self.path = Path(self.log_dir) / "metrics.csv"
        try:
            text = read_record(self.path, LARGEST).decode() if self.path.is_file() else ""
            rows = csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))
            self._columns = next(rows, [])
            if text.count("\n") > MOST_ROWS:
                raise ValueError("too many rows")
            pairs = (zip(self._columns, row, strict=True) for row in rows if row)
            self._rows = [{key: cell for key, cell in row if cell} for row in pairs]
            if any(math.isnan(float(row.get("step", 0))) for row in self._rows):
                raise ValueError("cells of no step")
        except (ValueError, csv.Error):
            raise DevrfError(f"{self.path}: damaged; remove it, and curves begin anew") from None
        # Rows in the file; None: it has to be written anew.
        self._written: int | None = None
        self._failing = False

    @property
    @rank_zero_experiment
    def experiment(self) -> ResumableCSVLogger:
        """The logger itself."""
        return self

    @rank_zero_only
    def drop_rows_beyond(self, capture: str, iteration: int) -> None:
        """Drop the rows of ``capture`` beyond ``iteration``: a resumed run writes them again."""
        rows = [
            row
            for row in self._rows
            if not any(key.startswith(f"{capture}/") for key in row)
            or float(row.get("step", 0)) <= iteration
        ]
        if len(rows) < len(self._rows):
            self._rows = rows
            self._written = None
            self.save()

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:  # type: ignore[override]
        """Add the row of ``step``."""
        row = {key: repr(float(value)) for key, value in metrics.items()}
        if step is not None:
            row["step"] = str(step)
        self._rows.append(row)
        if not set(row) <= set(self._columns):
            self._columns = sorted({*self._columns, *row})
            self._written = None
        self.save()

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace | None = None) -> None:
        """Do nothing: Hydra has written the config."""

    @rank_zero_only
    def save(self) -> None:
        """Write the rows that the file lacks."""
        if self._written == len(self._rows):
            return
        try:
            if self._written is None:
                with atomic_write(self.path) as partial, partial.open("w", newline="") as file:
                    table = csv.DictWriter(file, self._columns)
                    table.writeheader()
                    table.writerows(self._rows)
            else:
                with self.path.open("a", newline="") as file:
                    csv.DictWriter(file, self._columns).writerows(self._rows[self._written :])
        except OSError as error:
            if not self._failing:
                log.warning("%s: %s; its rows wait in memory", self.path, error.strerror)
            self._written = None
            self._failing = True
        else:
            self._written = len(self._rows)
            self._failing = False
