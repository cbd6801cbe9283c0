"""A report where a sweep ends: of the sweep's own runs."""

from __future__ import annotations

from typing import Any

from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig

from devrf.errors import DevrfError
from devrf.reporting.markdown import plain
from devrf.reporting.write import write_report


class SweepReport(Callback):
    """Compares the runs of a sweep once all its jobs are done, here and not where jobs ran."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the report into the sweep's folder and print it; nothing if no job was scored."""
        try:
            written = write_report(instantiate(config.report, runs=config.hydra.sweep.dir))
        except DevrfError:
            return
        # Printed: Hydra's last job took the log with it.
        print(plain(written.table, written.remarks))
        print(f"report written to {written.path}")
