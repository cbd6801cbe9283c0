"""The processes that learn one scene together: started, watched, and ended with this one.

Rank 0 is the process that the user started. It alone composes the config, writes files and says
anything; the others get the composed config, take part in the steps that learn, and end. Where
a launcher such as torchrun has started all of them, none is started here.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
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

# Seconds that a process has to end, or to notice that another has ended.
GRACE = 10.0


@contextmanager
def launch_workers(run: RunContext, work: Work) -> Iterator[None]:
    """While the block lasts, all processes that ``trainer`` asks for are there.

    Rank 0 reads the scene first: what is wrong with it is said once, and optical flow that it
    estimates and keeps is found by the others.

    Args:
        run: what this process works on.
        work: what the others do with the composed config and the run's folder; it must be
            importable by its name.

    Raises:
        DevrfError: processes that cannot be had, or the mistake that ended another process.
        RuntimeError: a fault of another process; the message has its traceback.
    """
    strategy = run.strategy
    if not isinstance(strategy, ManualDDP):
        yield
        return
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
        silence_logs()
    others = nullcontext() if outside else _others(run, work, strategy.num_processes)
    with _as_before(), others:
        strategy.setup_environment()
        strategy.barrier("the scene is read")
        yield
        strategy.barrier("everything is learned")
        _leave_group()


@contextmanager
def _as_before() -> Iterator[None]:
    """Take back afterwards what the process says to others, and Lightning to this one."""
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


@dataclass(frozen=True)
class Failure:
    """Why a process ended.

    Attributes:
        when: seconds of a clock that all processes of a machine share.
        mistake: whether the user can put it right.
        text: a line for a mistake, else the traceback.
    """

    when: float
    mistake: bool
    text: str

    def error(self) -> Exception:
        """It, to be raised in another process."""
        return DevrfError(self.text) if self.mistake else RuntimeError(self.text)


@dataclass(frozen=True)
class Child:
    """A process that was started here, and where it says what ended it."""

    rank: int
    process: SpawnProcess
    reports: Connection

    def failure(self) -> Failure | None:
        """What it said, or what its exit status says; None while it lives or if it did well."""
        try:
            if self.reports.poll():
                said: Failure = self.reports.recv()
                return said
        except (EOFError, OSError):
            self.process.join(GRACE)
        status = self.process.exitcode
        if not status:
            return None
        signalled = f"was ended by signal {-status}" if status < 0 else f"ended with {status}"
        text = f"trainer.devices: the process of rank {self.rank} {signalled}; was memory short?"
        return Failure(time.monotonic(), True, text)


@contextmanager
def _others(run: RunContext, work: Work, count: int) -> Iterator[None]:
    """Processes 1 to ``count`` - 1, which end with this block, if need be by force."""
    children: list[Child] = []
    over = threading.Event()
    try:
        for child in _start(run, work, count):
            children.append(child)
            threading.Thread(target=_watch, args=(child, over), daemon=True).start()
        yield
        for child in children:
            child.process.join(GRACE)
    except Exception as error:
        if is_user_error(error):
            raise
        # Where another process ends, what is noticed here is a connection that broke.
        wait([child.reports for child in children], timeout=1.0)
        failure = _first_failure(children)
        raise failure.error() if failure else error  # noqa: B904 - its cause is over there
    finally:
        for child in children:
            child.process.kill()
            child.process.join()
        over.set()


def _start(run: RunContext, work: Work, count: int) -> Iterator[Child]:
    """Start processes 1 to ``count`` - 1, and tell Lightning that this one is number 0."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ.update(
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), NODE_RANK="0", WORLD_SIZE=str(count)
    )
    config = OmegaConf.to_container(run.config, resolve=True)
    spawn = multiprocessing.get_context("spawn")
    for rank in range(1, count):
        os.environ["LOCAL_RANK"] = str(rank)
        here, there = spawn.Pipe(duplex=False)
        process = spawn.Process(
            target=_take_part, args=(work, config, run.folder, there), daemon=True
        )
        with signals_blocked():
            process.start()
        there.close()
        yield Child(rank, process, here)
    os.environ["LOCAL_RANK"] = "0"


@contextmanager
def signals_blocked() -> Iterator[None]:
    """A process started now hears no Ctrl-C and no request to end.

    They may go to all processes at once, but are for rank 0, which ends the others.
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


def _first_failure(children: Sequence[Child]) -> Failure | None:
    failures = [failure for child in children if (failure := child.failure())]
    return min(failures, key=lambda failure: failure.when, default=None)


def _watch(child: Child, over: threading.Event) -> None:
    """End this process, and so the others, when one has failed and this one waits for it.

    Between CPUs a connection breaks at once; a GPU may wait for the lost one for half an hour.
    """
    wait([child.process.sentinel])
    if child.process.exitcode == 0 or over.wait(GRACE):
        return
    failure = child.failure()
    print(f"devrf: {failure.text if failure else 'ended'}", file=sys.stderr, flush=True)
    os._exit(2 if failure and failure.mistake else 1)


def _take_part(work: Work, config: Any, folder: Path, reports: Connection) -> None:
    """The whole life of another process."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    silence_logs()
    tune_for_cpu()
    try:
        work(OmegaConf.create(config), folder)
    except BaseException as error:
        mistake = isinstance(error, Exception) and is_user_error(error)
        text = one_line(error) if mistake else traceback.format_exc()
        reports.send(Failure(time.monotonic(), mistake, text))
        sys.exit(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def silence_logs() -> None:
    """Say nothing: rank 0 says the same."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
