"""The report of a sweep's runs."""

from __future__ import annotations

from typing import Any

from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig

from devrf.errors import DevrfError


class SweepReport(Callback):
    """Hydra callback that compares a sweep's runs once all jobs are done."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the report into the sweep's folder and print it; nothing if no job was scored."""
        # Hydra imports this module with every command; pandas and matplotlib are slow to import.
        from devrf.apps.report.write import write_report

        try:
            written = write_report(instantiate(config.report, runs=config.hydra.sweep.dir))
        except DevrfError:
            return
        # Printed, because Hydra's last job has closed the log.
        print(written.text)
        print(f"report written to {written.path}")
