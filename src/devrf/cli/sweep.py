"""Sweeps: a failed job is recorded, the others go on, and the end names the failed ones."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from devrf.cli import job
from devrf.cli.messages import is_user_error, one_line
from devrf.cli.run_folder import remove_if_only
from devrf.cli.run_lock import PLACE
from devrf.system.files import write_json
from devrf.system.process import forget_peak_memory

log = logging.getLogger(__name__)

# The exit status of a sweep with failed jobs.
JOBS_FAILED = 3
FAILURE = "failure.json"
# What the sweep's folder holds before Hydra starts the first job.
OF_SWEEP = {"multirun.yaml", PLACE}
# How Optuna's error begins when no trial finished.
NOTHING_FINISHED = "No trials are completed"


def run_job(run: Callable[[], float | None], config: DictConfig, folder: Path) -> float | None:
    """Run one job of a sweep; if it fails, write ``failure.json``, so that the next jobs still run.

    Returns:
        The objective; None for a failed job, which a search counts as failed. (A NaN would end the
        search, an exception the basic sweeper.)
    """
    forget_peak_memory()
    try:
        value = run()
        forget_failure(folder)
        return value
    except Exception as error:
        _record(error, config, folder)
        return None
    finally:
        gc.collect()  # so that the next job does not start with the memory of this one


def forget_failure(folder: Path) -> None:
    """Remove an earlier ``failure.json`` from the folder of a run that succeeded."""
    (folder / FAILURE).unlink(missing_ok=True)


def _record(error: Exception, config: DictConfig, folder: Path) -> None:
    """Report why a job failed: in its folder, and in one line on stderr."""
    user_error = is_user_error(error)
    said = one_line(error) if user_error else f"{type(error).__name__}: {one_line(error)}"
    scene = None
    with suppress(OmegaConfBaseException):
        scene = str(config.scene)
    found = {
        "scene": scene,
        "choices": job.choices(),
        "overrides": job.overrides(),
        "seed": config.get("seed"),
        "error": said,
        "mistake": user_error,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_json(folder / FAILURE, found)
    where = ""
    if not user_error:
        _into_run_log(error)
        where = f"; the traceback is in {folder / 'run.log'}"
    print(f"devrf: job {folder.name}: {said}{where}", file=sys.stderr)


def _into_run_log(error: Exception) -> None:
    """Write the traceback to the job's log, not to the terminal."""
    trace = (type(error), error, error.__traceback__)
    record = log.makeRecord(log.name, logging.ERROR, __file__, 0, "the job failed", (), trace)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.handle(record)


class SweepMonitor(Callback):
    """Hydra callback that tells :func:`failures_at_the_end` which jobs failed."""

    started: SweepMonitor | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note what the sweep's folder holds before the first job."""
        self.folder = Path(config.hydra.sweep.dir)
        self.was_there = self.folder.exists()
        self.failures, self.jobs = self._stamps(FAILURE), self._stamps(".hydra/config.yaml")
        SweepMonitor.started = self

    def failed(self) -> list[str]:
        """Folders of failed jobs, relative to the sweep's."""
        now = self._stamps(FAILURE)
        return [str(path.parent) for path in sorted(now) if now[path] != self.failures.get(path)]

    def count(self) -> int:
        """How many jobs have started."""
        now = self._stamps(".hydra/config.yaml")
        return sum(stamp != self.jobs.get(path) for path, stamp in now.items())

    def _stamps(self, name: str) -> dict[Path, int]:
        """When each file of that name was written, in nanoseconds."""
        found = self.folder.rglob(name)
        return {path.relative_to(self.folder): path.stat().st_mtime_ns for path in found}


@contextmanager
def failures_at_the_end() -> Iterator[None]:
    """When a sweep has ended, name the jobs that failed and exit with status 3.

    A sweep that a user error ends before its first job leaves no folder behind.
    """
    SweepMonitor.started = None
    try:
        yield
    except Exception as error:
        sweep = SweepMonitor.started
        if sweep is not None and is_user_error(error) and not sweep.was_there:
            remove_if_only(sweep.folder, OF_SWEEP)
        if not (sweep and sweep.failed()):
            raise
        if NOTHING_FINISHED not in str(error):
            _print_failed(sweep)
            raise
    if SweepMonitor.started is not None and SweepMonitor.started.failed():
        _print_failed(SweepMonitor.started)
        raise SystemExit(JOBS_FAILED)


def _print_failed(sweep: SweepMonitor) -> None:
    failed = sweep.failed()
    print(
        f"devrf: {len(failed)} of {sweep.count()} jobs failed: {', '.join(failed)}; "
        f"{FAILURE} in each folder below {sweep.folder} says why",
        file=sys.stderr,
    )
