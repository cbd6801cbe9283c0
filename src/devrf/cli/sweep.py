"""Sweeps: a job that fails is recorded, the others go on, and the end says which failed."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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

# The exit status of a sweep of which jobs failed.
JOBS_FAILED = 3
FAILURE = "failure.json"
# What is in the sweep's folder before Hydra looks at the jobs.
OF_SWEEP = {"multirun.yaml", PLACE}
# How Optuna ends when it asks for the best of no finished trial.
NOTHING_FINISHED = "No trials are completed"


def run_job(run: Callable[[], float | None], config: DictConfig, folder: Path) -> float | None:
    """Run a job of a sweep so that the others go on whatever becomes of it.

    Args:
        run: does the job and returns its objective.
        config: the job's config.
        folder: the job's folder; ``failure.json`` in it says why the job failed, if it did.

    Returns:
        The objective; None for a job that failed, which a search counts as just that. (It would
        stop at a nan, and the basic sweeper at an exception.)
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
        gc.collect()  # a job shall not be charged with the memory of the one before it


def forget_failure(folder: Path) -> None:
    """Remove the record of an earlier failure in the folder of a run that succeeded."""
    (folder / FAILURE).unlink(missing_ok=True)


def _record(error: Exception, config: DictConfig, folder: Path) -> None:
    """Write down that and why a job failed, in its folder and in a line on stderr."""
    mistake = is_user_error(error)
    said = one_line(error) if mistake else f"{type(error).__name__}: {one_line(error)}"
    write_json(
        folder / FAILURE,
        {
            "scene": _scene(config),
            "choices": job.choices(),
            "overrides": job.overrides(),
            "seed": config.get("seed"),
            "error": said,
            "mistake": mistake,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    )
    where = "" if mistake else f"; the traceback is in {folder / 'run.log'}"
    if not mistake:
        _into_run_log(error)
    print(f"devrf: job {folder.name}: {said}{where}", file=sys.stderr)


def _scene(config: DictConfig) -> str | None:
    try:
        return str(config.scene)
    except OmegaConfBaseException:
        return None


def _into_run_log(error: Exception) -> None:
    """Write the traceback to the job's log, not to the terminal between the other jobs' lines."""
    trace = (type(error), error, error.__traceback__)
    record = log.makeRecord(log.name, logging.ERROR, __file__, 0, "the job failed", (), trace)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.handle(record)


class SweepMonitor(Callback):
    """Hydra's callback that tells :func:`failures_at_the_end` of a sweep and its folder."""

    started: SweepMonitor | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note what the sweep's folder holds before the first job."""
        self.folder = Path(config.hydra.sweep.dir)
        self.was_there = self.folder.exists()
        self.failures, self.jobs = self._stamps(FAILURE), self._stamps(".hydra/config.yaml")
        SweepMonitor.started = self

    def failed(self) -> list[str]:
        """The folders of this sweep's failed jobs, relative to the sweep's."""
        now = self._stamps(FAILURE)
        return [str(path.parent) for path in sorted(now) if now[path] != self.failures.get(path)]

    def count(self) -> int:
        """How many jobs this sweep has begun."""
        now = self._stamps(".hydra/config.yaml")
        return sum(stamp != self.jobs.get(path) for path, stamp in now.items())

    def _stamps(self, name: str) -> dict[Path, int]:
        """When each file of that name below the sweep's folder was written."""
        found = self.folder.rglob(name)
        return {path.relative_to(self.folder): path.stat().st_mtime_ns for path in found}


@contextmanager
def failures_at_the_end() -> Iterator[None]:
    """When a sweep has ended, say which of its jobs failed and exit with status 3.

    A sweep that ends in a mistake before its first job leaves no folder behind.
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
            _say(sweep)
            raise
    if SweepMonitor.started is not None and SweepMonitor.started.failed():
        _say(SweepMonitor.started)
        raise SystemExit(JOBS_FAILED)


def _say(sweep: SweepMonitor) -> None:
    failed = sweep.failed()
    print(
        f"devrf: {len(failed)} of {sweep.count()} jobs failed: {', '.join(failed)}; "
        f"{FAILURE} in each folder below {sweep.folder} says why",
        file=sys.stderr,
    )
