"""The processes that learn one scene together: started, watched, and ended with this one.

Rank 0 is the process that the user started. It alone composes the config, writes files and logs;
the others get the composed config and take part in the stages that learn. Where a launcher such as
torchrun has started all of them, none is started here.

Lightning's own launchers do not fit: one runs the command line again in each process, which would
compose every job of a sweep anew; the other moves rank 0 to a process of its own, away from the
run's files, lock and signals.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import socket
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from devrf.cli.context import RunContext
from devrf.cli.messages import is_user_error, one_line
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.system.process import tune_for_cpu

Work = Callable[[DictConfig, Path], None]
# Failures of other processes, the first one first: whether it is a user error, and its one line or
# else the traceback.
Reports = SimpleQueue[tuple[bool, str]]

# Seconds that a process has to end, or to notice that another has ended.
GRACE = 10.0


@contextmanager
def launch_workers(run: RunContext, work: Work) -> Iterator[None]:
    """While the block lasts, all processes that ``trainer`` asks for take part.

    Rank 0 reads the scene first: errors in it are reported once, and the others find the optical
    flow that it has estimated and stored.

    Args:
        run: of this process.
        work: what the others do with the composed config and the run's folder; importable by name.

    Raises:
        DevrfError: the processes cannot be started, or a user error ended one of them.
        RuntimeError: another error of another process, with its traceback.
    """
    strategy = run.strategy
    assert isinstance(strategy, ManualDDP)
    environment = strategy.cluster_environment
    assert environment is not None
    outside = environment.creates_processes_externally
    if not outside and strategy.num_nodes > 1:
        raise DevrfError("trainer.num_nodes: several machines need torchrun, or SLURM's srun")
    try:
        environment.validate_settings(strategy.num_processes, strategy.num_nodes)
    except (RuntimeError, ValueError) as error:
        raise DevrfError(f"trainer.devices: {error}") from None
    if run.leads:
        _ = run.scene
    else:
        _silence_logs()
    others = nullcontext() if outside else _others(run, work, strategy.num_processes)
    with _restored(), others:
        strategy.setup_environment()
        strategy.barrier("the scene is read")
        yield
        strategy.barrier("everything is learned")
        _leave_group()


@contextmanager
def _restored() -> Iterator[None]:
    """Restore afterwards what launching and Lightning change in this process."""
    environment, threads = dict(os.environ), torch.get_num_threads()
    try:
        yield
    finally:
        _leave_group()
        os.environ.clear()
        os.environ.update(environment)
        torch.set_num_threads(threads)


def _leave_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


@contextmanager
def _others(run: RunContext, work: Work, count: int) -> Iterator[None]:
    """Processes 1 to ``count`` - 1, which end with this block, by force if necessary."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ.update(
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), NODE_RANK="0", WORLD_SIZE=str(count)
    )
    config = OmegaConf.to_container(run.config, resolve=True)
    spawn = multiprocessing.get_context("spawn")
    reports: Reports = spawn.SimpleQueue()
    arguments = (work, config, run.folder, reports)
    children: list[SpawnProcess] = []
    over = threading.Event()
    try:
        for rank in range(1, count):
            os.environ["LOCAL_RANK"] = str(rank)
            child = spawn.Process(target=_take_part, args=arguments, daemon=True)
            with _signals_blocked():
                child.start()
            children.append(child)
        os.environ["LOCAL_RANK"] = "0"
        for child in children:
            watched = (child, children, reports, over)
            threading.Thread(target=_watch, args=watched, daemon=True).start()
        yield
        for child in children:
            child.join(GRACE)
    except Exception as error:
        if is_user_error(error):
            raise
        # If another process has ended, this one only notices a broken connection.
        wait([child.sentinel for child in children], timeout=1.0)
        raise _failure(children, reports) or error  # noqa: B904 - its cause is over there
    finally:
        for child in children:
            child.kill()
            child.join()
        over.set()


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """A process started now receives neither Ctrl-C nor SIGTERM.

    A terminal or launcher may send them to all processes, but rank 0 ends the others.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # What is blocked is inherited.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _failure(children: Sequence[SpawnProcess], reports: Reports) -> Exception | None:
    """The first error that was reported, else that of an exit status, if any."""
    if not reports.empty():
        user_error, text = reports.get()
        return DevrfError(text) if user_error else RuntimeError(text)
    for rank, child in enumerate(children, 1):
        if status := child.exitcode:
            how = f"was ended by signal {-status}" if status < 0 else f"ended with {status}"
            return DevrfError(
                f"trainer.devices: the process of rank {rank} {how}; was memory short?"
            )
    return None


def _watch(
    child: SpawnProcess, children: Sequence[SpawnProcess], reports: Reports, over: threading.Event
) -> None:
    """End this process if ``child`` has failed and this one does not notice.

    Between CPUs a connection breaks at once; a GPU may wait for the lost process for half an hour.
    """
    wait([child.sentinel])
    if child.exitcode == 0 or over.wait(GRACE):
        return
    failure = _failure(children, reports)
    print(f"devrf: {failure or 'ended'}", file=sys.stderr, flush=True)
    os._exit(2 if isinstance(failure, DevrfError) else 1)


def _take_part(work: Work, config: Any, folder: Path, reports: Reports) -> None:
    """The whole life of another process."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _silence_logs()
    tune_for_cpu()
    try:
        work(OmegaConf.create(config), folder)
    except BaseException as error:
        user_error = isinstance(error, Exception) and is_user_error(error)
        reports.put((user_error, one_line(error) if user_error else traceback.format_exc()))
        sys.exit(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _silence_logs() -> None:
    """Log nothing in this process: rank 0 logs the same."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
