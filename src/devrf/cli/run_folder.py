"""A run's folder: one process at a time, nothing left of a mistaken run, earlier results kept."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

from devrf.checkpoints.file_metadata import latest_checkpoint
from devrf.cli.config import OF_A_CHECKPOINT, SWEEP_RECORD, in_sweep
from devrf.cli.messages import one_line, report_user_errors
from devrf.cli.stored_study import draw_others
from devrf.errors import DevrfError
from devrf.evaluation.objective import check_objective
from devrf.system.files import (
    PARTIAL,
    close_logs,
    holds_at_most,
    refuse_links,
    remove,
    remove_if_only,
    walk,
)
from devrf.system.folder_lock import PLACE, lock_folder, release_folder
from devrf.system.override import to_type

log = logging.getLogger(__name__)

# Made in the folder before the config is checked.
AT_FIRST = {".hydra", PLACE}
# Folders in a run's in which a killed process may have left what it had begun.
BEGUN = (PLACE, "checkpoints", "images", "videos", "logs", "export", "paths")
# What was written in these last seconds may be a viewer's, which works in the folder beside others.
WRITING = 60.0
# Why a sweep's job failed.
FAILURE = "failure.json"
# Stages that leave .hydra alone: they look at other runs, or are none.
UNRECORDED = ("report", "fetch", "view")
# Environment variables in which torchrun and SLURM number the processes that they start.
RANKS = ("RANK", "SLURM_PROCID")


class FolderLock(Callback):
    """Hydra callback that locks the folder of a run or a sweep before anything is written there.

    Hydra writes before it calls the program, which then uses this lock. Hydra ignores what a
    callback raises, except an exit: errors are reported here.

    Attributes:
        sweep: the folder of the sweep that has begun, if one has.
        jobs: how many have begun in this process.
    """

    sweep: Path | None = None
    jobs = 0

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Count a job."""
        FolderLock.jobs += 1

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a run; :func:`working_in` releases it."""
        try:
            HydraConfig.instance().set_config(config)  # as Hydra does later: the folder may need it
            folder = Path(config.hydra.run.dir)
        except OmegaConfBaseException:
            return  # Hydra will report what is wrong with the config
        with report_user_errors():
            typed = [word.partition("=")[0] for word in config.hydra.overrides.hydra]
            if "hydra.sweep.dir" in typed and config.stage != "report":
                raise DevrfError(
                    "hydra.sweep.dir: no sweep is typed (-m); without one, and without "
                    f"experiment=, it names the folder of a sweep, which has {SWEEP_RECORD}"
                )
            # A report's default folder is a name in the folder of the runs.
            named = config.stage == "report" and folder == Path(str(config.report.runs)) / "report"
            refuse_links(folder, itself=named)
            if config.stage not in UNRECORDED and not _is_worker(config):
                lock_folder(folder, _elsewhere(config, folder))
            # As Hydra does next, with a traceback where it cannot.
            folder.mkdir(parents=True, exist_ok=True)
            if config.stage in UNRECORDED:
                logs = OmegaConf.select(config.hydra, "job_logging.root.handlers") or []
                with read_write(config.hydra):
                    config.hydra.output_subdir = None
                    # The folder may be another's to write, and its log that of a run at work.
                    if config.stage == "view" and "file" in logs:
                        logs.remove("file")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Lock the folder of a sweep, and write its record; each job locks its own folder.

        Hydra's own sweeper writes the same record, others write none. An objective that no job
        would have ends the sweep here, and not each of its jobs.
        """
        folder = Path(config.hydra.sweep.dir)
        with report_user_errors():
            # What is no list each job refuses.
            if OmegaConf.is_list(config.evaluation.metrics):
                check_objective(str(config.objective), config.evaluation.metrics)
            missing = [name for name in ("srun", "sbatch") if shutil.which(name) is None]
            if config.hydra.launcher._target_.endswith(".SlurmLauncher") and missing:
                raise DevrfError(
                    f"hydra/launcher: no {' and no '.join(missing)} here; type the command where "
                    "SLURM takes jobs, or leave hydra/launcher out"
                )
            for path in (folder, *folder.glob("[!.]*/")):
                refuse_links(path)
            draw_others(config.hydra.sweeper)
            lock_folder(folder, "hydra.sweep.dir")
            OmegaConf.save(config, folder / SWEEP_RECORD)
        FolderLock.sweep = folder


@contextmanager
def working_in(folder: Path, config: DictConfig) -> Iterator[None]:
    """While the block lasts, no other process works in a run's folder.

    A folder that holds no results is removed if the block ends in a user error, but not by a
    worker: rank 0 works there, and locks for it. That of a sweep's job stays, for the record of
    its failure, which a success removes. A report only reads; what the viewer writes, a camera
    path, the page and its pictures, becomes whole at once; stage=fetch locks where it writes.

    Raises:
        DevrfError: another process works there.
    """
    is_rank_zero = not _is_worker(config)
    if is_rank_zero and config.stage not in UNRECORDED:
        lock_folder(folder, "hydra.sweep.dir" if in_sweep() else "hydra.run.dir")
        below = (walked for name in BEGUN for walked, *_ in walk(folder / name))
        recent = time.time() - WRITING
        for begun in (path for walked in (folder, *below) for path in walked.glob(f"{PARTIAL}*")):
            with suppress(FileNotFoundError):  # the viewer has just finished it
                if begun.lstat().st_mtime < recent:
                    remove(begun)
    was_new = is_rank_zero and not in_sweep() and holds_at_most(folder, AT_FIRST)
    try:
        yield
        (folder / FAILURE).unlink(missing_ok=True)
    except Exception as error:
        if was_new and one_line(error) is not None:
            remove_if_only(folder, {*AT_FIRST, "run.log"})
        raise
    finally:
        release_folder(folder)


def _elsewhere(config: DictConfig, folder: Path) -> str:
    """The words before ``=FOLDER`` by which the command writes to another folder."""
    learned = latest_checkpoint(folder) if config.stage in OF_A_CHECKPOINT else None
    given = config.ckpt is not None or learned is None
    return "hydra.run.dir" if given else f"{to_type('ckpt', learned)} hydra.run.dir"


def _is_worker(config: DictConfig) -> bool:
    """Whether a launcher started this process to learn together with rank 0."""
    ranked = any(os.environ.get(name, "0") != "0" for name in RANKS)
    return ranked and config.trainer.get("strategy") is not None


def archive_previous(folder: Path, *needed: Path) -> None:
    """Move the results of earlier commands into ``previous-<n>/`` within the run's folder.

    ``.hydra`` and the lock are the present command's and stay. Files that it needs are copied back.
    """
    old = [p for p in folder.iterdir() if p.name not in AT_FIRST and p.name[:9] != "previous-"]
    if not old:
        return
    close_logs()
    taken = [int(p.name[9:]) for p in folder.glob("previous-*") if p.name[9:].isdecimal()]
    previous = folder / f"previous-{max(taken, default=0) + 1}"
    previous.mkdir()
    for path in old:
        path.rename(previous / path.name)
    for path in needed:
        moved = previous / path.relative_to(folder)
        if moved.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(moved, path)
    log.info("what was in %s is kept in %s", folder, previous)
