"""Training curves as a CSV table that a run, however often interrupted, goes on with."""

from __future__ import annotations

import csv
import io
import logging
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from devrf.system.files import atomic_write

log = logging.getLogger(__name__)


class ResumableCSVLogger(Logger):
    """Writes a row of ``metrics.csv`` for every step that is logged, at once.

    A table that is there already is continued: :meth:`go_on` says from where. Where the disk is
    full the rows wait in memory, and are written when there is room.
    """

    def __init__(self, save_dir: str | Path, name: str = "logs", version: str = "run") -> None:
        """Say where the table is: ``<save_dir>/<name>/<version>/metrics.csv``.

        Args:
            save_dir: the run's folder.
            name: a folder in it.
            version: a folder in that.
        """
        super().__init__()
        self._save_dir = Path(save_dir)
        self._name = name
        self._version = version
        self._rows: list[dict[str, str]] | None = None
        self._columns: list[str] = []
        self._whole = False
        self._failing = False

    @property
    def name(self) -> str:
        """The folder of all tables."""
        return self._name

    @property
    def version(self) -> str:
        """The folder of this one."""
        return self._version

    @property
    def save_dir(self) -> str:
        """The run's folder."""
        return str(self._save_dir)

    @property
    def path(self) -> Path:
        """The table."""
        return self._save_dir / self._name / self._version / "metrics.csv"

    @property
    @rank_zero_experiment
    def experiment(self) -> ResumableCSVLogger:
        """The logger itself: there is nothing behind it."""
        return self

    @rank_zero_only
    def go_on(self, capture: str, iteration: int) -> None:
        """Forget the rows of ``capture`` (``static``, ``dynamic``) beyond ``iteration``.

        They were written after what the run goes on from, and will be written again.
        """
        kept = [
            row
            for row in self._table()
            if not any(key.startswith(f"{capture}/") for key in row)
            or float(row.get("step", 0)) <= iteration
        ]
        if len(kept) < len(self._table()):
            self._rows, self._whole = kept, False
            self._write([])

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Add a row: what was measured at ``step``."""
        row = {key: repr(float(value)) for key, value in metrics.items()}
        if step is not None:
            row["step"] = str(step)
        table = self._table()
        table.append(row)
        if not set(row) <= set(self._columns):
            self._columns = sorted({*self._columns, *row})
            self._whole = False
        self._write([row])

    @rank_zero_only
    def log_hyperparams(
        self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any
    ) -> None:
        """Nothing: the composed config lies in the run's folder."""

    def _table(self) -> list[dict[str, str]]:
        """All rows; those on the disk are read once. A last line that was cut off is no row."""
        if self._rows is None:
            text = self.path.read_text() if self.path.is_file() else ""
            reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]))
            self._columns = list(reader.fieldnames or [])
            self._rows = [{key: cell for key, cell in row.items() if cell} for row in reader]
        return self._rows

    def _write(self, new: list[dict[str, str]]) -> None:
        """Append ``new`` rows if the table on the disk is as it should be, else write all anew."""
        try:
            if self._whole:
                with self.path.open("a", newline="") as file:
                    file.write(self._lines(new))
            else:
                with atomic_write(self.path) as partial:
                    header = ",".join(self._columns) + "\r\n" if self._columns else ""
                    partial.write_text(header + self._lines(self._table()), newline="")
        except OSError as error:
            self._whole = False
            if not self._failing:
                log.warning("%s: %s; its rows wait in memory", self.path, error.strerror)
            self._failing = True
        else:
            self._whole, self._failing = True, False

    def _lines(self, rows: list[dict[str, str]]) -> str:
        text = io.StringIO()
        csv.DictWriter(text, self._columns).writerows(rows)
        return text.getvalue()
