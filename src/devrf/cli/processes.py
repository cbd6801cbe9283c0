"""Several processes learn one scene: each runs the command line; rank 0 alone writes and speaks."""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.strategies import Strategy
from torch import distributed
from torch.distributed import run as torchrun
from torch.distributed.elastic.multiprocessing.api import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

from devrf.cli.config import in_sweep
from devrf.cli.messages import FULL_ERRORS, is_user_error
from devrf.cli.run_folder import ONE_COMMAND_EACH
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.system.folder_lock import release_folder
from devrf.system.override import literal

# Seconds in which a launcher ends the other processes after one has failed.
GRACE = 10.0


@contextmanager
def connected(strategy: Strategy, folder: Path) -> Iterator[None]:
    """Within the block the processes are connected, if the trainer asks for several.

    Where no launcher has started any, this one starts all, and ends with them instead.

    Raises:
        DevrfError: they are others than the trainer asks for, or they cannot be started.
        SystemExit: this process has started all, and they have ended.
    """
    if not isinstance(strategy, ManualDDP):
        yield
        return
    environment = strategy.cluster_environment
    assert environment is not None
    if not environment.creates_processes_externally:
        if strategy.num_nodes > 1:
            raise DevrfError("trainer.num_nodes: several machines need torchrun, or SLURM's srun")
        if not HydraConfig.initialized() or in_sweep():
            raise DevrfError(ONE_COMMAND_EACH)
        _run_in_each(strategy.num_processes, folder)
    try:
        environment.validate_settings(strategy.num_processes, strategy.num_nodes)
    except (RuntimeError, ValueError) as error:
        raise DevrfError(f"trainer.devices: {error}") from None
    if not strategy.is_global_zero:
        _log_nothing()
    strategy.setup_environment()
    try:
        yield
    except Exception as error:
        if not is_user_error(error):
            # If another has failed, this one notices a broken connection: the launcher will end it.
            time.sleep(GRACE)
        raise
    distributed.destroy_process_group()


def _run_in_each(count: int, folder: Path) -> NoReturn:
    """Run this command line in ``count`` processes of torchrun's; end with the first failure."""
    words = sys.argv[1:]
    if any(word.startswith("hydra.run.dir=") for word in words):  # with ${now:}, each has its own
        words.append(f"hydra.run.dir={literal(str(folder))}")
    _log_nothing()
    release_folder(folder)
    os.environ["HYDRA_FULL_ERROR"] = str(int(FULL_ERRORS))
    os.environ.setdefault("OMP_NUM_THREADS", str(max(torch.get_num_threads() // count, 1)))
    started = ("--standalone", f"--nproc-per-node={count}", "-m", "devrf", *words)
    try:
        torchrun.run(torchrun.parse_args(started))  # type: ignore[no-untyped-call]
    except SignalException as stop:
        sys.exit(128 + stop.sigval)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode < 0:
            ended = f"the process of rank {rank} ended by {failure.signal_name()}"
            raise DevrfError(f"trainer.devices: {ended}; was memory short?") from None
        sys.exit(failure.exitcode)
    sys.exit()


def _log_nothing() -> None:
    """Log nothing more in this process: rank 0 logs the same."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
