"""Many runs: a sweep's failed jobs are recorded while the others go on; a report compares runs."""

from __future__ import annotations

import gc
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig

from devrf.cli.config import SWEEP_RECORD, choices, overrides, scene_name
from devrf.cli.config_check import sets_only
from devrf.cli.messages import one_line
from devrf.cli.run_folder import FAILURE, FolderLock
from devrf.errors import DevrfError
from devrf.system.files import holds_at_most, remove_if_only, walk, write_json
from devrf.system.folder_lock import PLACE, release_folder
from devrf.system.printed import shown
from devrf.system.process import forget_peak_memory

log = logging.getLogger(__name__)

# The exit status of a sweep with failed jobs.
JOBS_FAILED = 3
# What Optuna says of a study without an objective, kept in memory or in a storage.
EMPTY = ("No trials are completed yet.", "Record does not exist.")
# Content of the sweep's folder before Hydra starts the first job.
OF_SWEEP = {SWEEP_RECORD, PLACE}


@contextmanager
def record_failure(config: DictConfig, folder: Path) -> Iterator[None]:
    """If a sweep's job, the block, fails, write ``failure.json``, so that the next jobs still run.

    Its objective is then None: a search counts it as failed. (A NaN would end the search, an
    exception the basic sweeper.)
    """
    forget_peak_memory()
    try:
        yield
    except Exception as error:
        mistake = one_line(error)
        message = mistake or shown(f"{type(error).__name__}: {' '.join(str(error).split())}")
        if mistake is None:
            log.error("the job failed", exc_info=error)
        failure = {
            "scene": scene_name(config),
            "choices": choices(),
            "overrides": overrides(),
            "seed": config.get("seed"),
            "error": message,
            "mistake": mistake is not None,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        write_json(folder / FAILURE, failure)
        print(f"devrf: job {folder.name}: {message}", file=sys.stderr)
    finally:
        gc.collect()  # so that the next job does not start with the memory of this one


@contextmanager
def naming_failures() -> Iterator[None]:
    """Name the failed jobs at the end of a sweep; release its folder, or remove an unused one.

    Raises:
        SystemExit: with status 3: jobs failed. A search ends by an error if all of them did.
        DevrfError: there is no job, or none of a search has its objective.
    """
    began = time.time()
    problem: Exception | None = None
    empty = False  # a search none of whose jobs has an objective
    FolderLock.sweep, FolderLock.jobs = None, 0
    try:
        yield
        # A launcher may have jobs in other processes, which leave their folders.
        if (sweep := FolderLock.sweep) and not FolderLock.jobs and holds_at_most(sweep, OF_SWEEP):
            raise DevrfError("the sweep has no jobs: what is typed as glob(…) or range(…) is empty")
    except Exception as error:
        problem = error
        empty = str(error) in EMPTY
    if (sweep := FolderLock.sweep) is not None:
        release_folder(sweep)
        if problem is not None:
            remove_if_only(sweep, OF_SWEEP)
        jobs = [folder for folder, _, names in walk(sweep) if FAILURE in names]
        failing = (job for job in jobs if (job / FAILURE).stat().st_mtime >= began)
        if failed := sorted(str(job.relative_to(sweep)) for job in failing):
            why = f"{FAILURE} in each folder below {sweep} says why"
            print(f"devrf: jobs failed: {', '.join(failed)}; {why}", file=sys.stderr)
            if problem is None or empty:
                raise SystemExit(JOBS_FAILED)
    if empty:
        raise DevrfError("objective: null in every job of the search; choose another number")
    if problem is not None:
        raise problem


def compares_runs(config: DictConfig, typed: Sequence[Override]) -> bool:
    """Whether a command asks for a report, and sets nothing that a whole check alone knows."""
    return config.stage == "report" and sets_only(typed, "report", "stage", "outputs")


def compare_runs(config: DictConfig) -> None:
    """``stage=report``: tables and plots of the runs below ``report.runs``; needs no scene.

    Raises:
        DevrfError: there are no runs.
    """
    # pandas and matplotlib are slow to import.
    from devrf.apps.report.write import write_report

    log.info("%s", write_report(instantiate(config.report)))


class SweepReport(Callback):
    """Hydra callback that compares a sweep's runs once all jobs are done."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the report into the sweep's folder and print it; nothing if no job was scored."""
        from devrf.apps.report.write import write_report

        with suppress(DevrfError):
            # Printed, because Hydra's last job has closed the log.
            print(write_report(instantiate(config.report, runs=config.hydra.sweep.dir)))
