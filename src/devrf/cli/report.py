"""The step that compares finished runs: ``stage=report``."""

from __future__ import annotations

import logging

from hydra.utils import instantiate

from devrf.cli.context import RunContext

log = logging.getLogger(__name__)


def report(run: RunContext) -> None:
    """Write tables and plots of the runs below ``report.runs``; needs no scene."""
    # Slow to import: pandas and matplotlib.
    from devrf.apps.report.write import write_report

    written = write_report(instantiate(run.config.report))
    log.info("%s", written.text)
    log.info("report written to %s", written.path)
