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

import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.strategies import Strategy
from torch import distributed
from torch.distributed import run as torchrun
from torch.distributed.elastic.multiprocessing.api import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

from devrf.cli.config import in_sweep, own_folders
from devrf.cli.messages import FULL_ERRORS, one_line
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.system.folder_lock import release_folder
from devrf.system.override import literal

# Seconds in which a launcher ends the other processes after one has failed.
GRACE = 10.0


@contextmanager
def connected(strategy: Strategy) -> Iterator[None]:
    """Within the block the processes that a launcher has started are connected, if there are any.

    Raises:
        DevrfError: they are others than the trainer asks for.
    """
    if not isinstance(strategy, ManualDDP):
        yield
        return
    environment = strategy.cluster_environment
    assert environment is not None
    try:
        environment.validate_settings(strategy.num_processes, strategy.num_nodes)
    except (RuntimeError, ValueError) as error:
        raise DevrfError(f"trainer.devices: {error}") from None
    if not strategy.is_global_zero:
        logging.disable(logging.CRITICAL)  # rank 0 logs the same
        warnings.simplefilter("ignore")
    strategy.setup_environment()
    try:
        yield
    except Exception as error:
        if one_line(error) is None:
            # If another has failed, this one notices a broken connection: the launcher will end it.
            time.sleep(GRACE)
        elif distributed.get_backend() == "gloo":
            # Left open, its threads may abort the process at its end, in place of its status.
            distributed.destroy_process_group()
        raise
    distributed.destroy_process_group()


def starts_processes(strategy: Strategy) -> bool:
    """Whether several processes are to learn, and no launcher has started them."""
    if not isinstance(strategy, ManualDDP):
        return False
    environment = strategy.cluster_environment
    return environment is None or not environment.creates_processes_externally


def run_in_each(strategy: Strategy, folder: Path) -> None:
    """Run the present job in processes of torchrun's, each from the command line on.

    Raises:
        DevrfError: they cannot be started, one was killed, or those of a sweep's job have failed.
        SystemExit: they have failed, or a signal has ended them.
    """
    assert isinstance(strategy, ManualDDP)
    if strategy.num_nodes > 1:
        raise DevrfError("trainer.num_nodes: several machines need torchrun, or SLURM's srun")
    if not HydraConfig.initialized():
        raise DevrfError("trainer=ddp: needs the command line, python -m devrf trainer=ddp")
    count = strategy.num_processes
    own_environment = os.environ.copy()
    os.environ["HYDRA_FULL_ERROR"] = str(int(FULL_ERRORS))
    os.environ.setdefault("OMP_NUM_THREADS", str(max(torch.get_num_threads() // count, 1)))
    release_folder(folder)
    logging.disable(logging.CRITICAL)  # rank 0 logs the same
    started = ("--standalone", f"--nproc-per-node={count}", "-m", "devrf", *_words(folder))
    try:
        torchrun.run(torchrun.parse_args(started))  # type: ignore[no-untyped-call]
    except SignalException as stop:
        sys.exit(128 + stop.sigval)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode >= 0 and not in_sweep():
            sys.exit(failure.exitcode)
        ended = f"ended with status {failure.exitcode}, and says why"
        if failure.exitcode < 0:
            ended = f"ended by {failure.signal_name()}; was memory short?"
        raise DevrfError(f"trainer.devices: the process of rank {rank} {ended}") from None
    finally:
        logging.disable(logging.NOTSET)
        # The next job of a sweep has its own processes.
        for name in os.environ.keys() - own_environment.keys():
            del os.environ[name]
        os.environ.update(own_environment)


def _words(folder: Path) -> list[str]:
    """The command line of the present job alone, in its folder."""
    words = sys.argv[1:]
    if in_sweep():
        words = [*own_folders(), *HydraConfig.get().overrides.task, "hydra.mode=RUN"]
    elif not any(word.startswith("hydra.run.dir=") for word in words):
        return words
    # With ${now:} each process would have another folder.
    return [*words, f"hydra.run.dir={literal(str(folder))}"]
