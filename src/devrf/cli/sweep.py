"""Many runs: a sweep's failed jobs are recorded while the others go on; a report compares runs."""

from __future__ import annotations

import gc
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, Any

from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import choices, overrides, scene_name
from devrf.cli.messages import is_user_error, one_line, report_user_errors
from devrf.cli.run_folder import FAILURE, refuse_links
from devrf.errors import DevrfError
from devrf.system.files import remove_if_only, write_json
from devrf.system.folder_lock import PLACE, lock_folder, release_folder
from devrf.system.process import forget_peak_memory

if TYPE_CHECKING:
    from devrf.cli.context import RunContext

log = logging.getLogger(__name__)
# Its handler is the file of the log alone.
faults = logging.getLogger("devrf.cli.failures")

# The exit status of a sweep with failed jobs.
JOBS_FAILED = 3
# What the sweep's folder holds before Hydra starts the first job.
OF_SWEEP = {"multirun.yaml", PLACE}


def report(run: RunContext) -> None:
    """``stage=report``: tables and plots of the runs below ``report.runs``; needs no scene."""
    # Hydra imports this module with every command; pandas and matplotlib are slow to import.
    from devrf.apps.report.write import write_report

    log.info("%s", write_report(instantiate(run.config.report)))


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
        message = one_line(error)
        where = ""
        scene = None
        if not is_user_error(error):
            message = f"{type(error).__name__}: {message}"
            where = f"; the traceback is in {folder / 'run.log'}"
            faults.error("the job failed", exc_info=error)
        with suppress(OmegaConfBaseException):
            scene = scene_name(config)
        failure = {
            "scene": scene,
            "choices": choices(),
            "overrides": overrides(),
            "seed": config.get("seed"),
            "error": message,
            "mistake": is_user_error(error),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        write_json(folder / FAILURE, failure)
        print(f"devrf: job {folder.name}: {message}{where}", file=sys.stderr)
    finally:
        gc.collect()  # so that the next job does not start with the memory of this one


class SweepMonitor(Callback):
    """Hydra callback that has a sweep's folder to itself."""

    started: SweepMonitor | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the sweep's folder; each job locks its own. Refuse SLURM where there is none."""
        self.folder = Path(config.hydra.sweep.dir)
        self.began = time.time()
        with report_user_errors():
            missing = [name for name in ("srun", "sbatch") if which(name) is None]
            if config.hydra.launcher._target_.endswith(".SlurmLauncher") and missing:
                raise DevrfError(
                    f"hydra/launcher: no {' and no '.join(missing)} here; type the command where "
                    "SLURM takes jobs, or leave hydra/launcher out"
                )
            for folder in (self.folder, *self.folder.glob("*/")):
                refuse_links(folder)
            lock_folder(self.folder, "hydra.sweep.dir")
        SweepMonitor.started = self

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Release the folder."""
        release_folder(self.folder)


@contextmanager
def naming_failures() -> Iterator[None]:
    """Name the failed jobs at the end of a sweep; remove its folder if an error left it unused.

    Raises:
        SystemExit: with status 3: jobs failed. A search ends by an error if all of them did.
    """
    SweepMonitor.started = None
    problem: Exception | None = None
    try:
        yield
    except Exception as error:
        problem = error
    if (sweep := SweepMonitor.started) is not None:
        if problem is not None and is_user_error(problem):
            remove_if_only(sweep.folder, OF_SWEEP)
        records = [f for f in sweep.folder.rglob(FAILURE) if f.stat().st_mtime >= sweep.began]
        if failed := sorted(str(file.parent.relative_to(sweep.folder)) for file in records):
            why = f"{FAILURE} in each folder below {sweep.folder} says why"
            print(f"devrf: jobs failed: {', '.join(failed)}; {why}", file=sys.stderr)
            if problem is None or "No trials are completed" in str(problem):
                raise SystemExit(JOBS_FAILED)
    if problem is not None:
        raise problem


class SweepReport(Callback):
    """Hydra callback that compares a sweep's runs once all jobs are done."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the report into the sweep's folder and print it; nothing if no job was scored."""
        from devrf.apps.report.write import write_report

        with suppress(DevrfError):
            # Printed, because Hydra's last job has closed the log.
            print(write_report(instantiate(config.report, runs=config.hydra.sweep.dir)))
