"""The processes that learn one scene together: started, watched, and ended with this one.

Rank 0 is the process that the user started. It alone composes the config, writes files and logs;
the others take part in the stages that learn. Where a launcher such as torchrun has started all of
them, none is started here.

Other launchers do not fit. Lightning's script launcher and torchrun run the command line again in
each process: each composes the config, a mistake is reported once a process, with torchrun's
traceback behind it, and Ctrl-C ends torchrun with status 1. Lightning's other launcher, and
torchrun's for functions, move rank 0 to a process of its own, away from the run's loggers, viewer,
files, lock and signals.
"""

from __future__ import annotations

import atexit
import logging
import multiprocessing
import os
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing.connection import wait
from queue import Empty, Queue
from typing import Any

import torch
from torch.multiprocessing.spawn import (
    ProcessContext,
    ProcessException,
    ProcessExitedException,
    start_processes,
)

from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.system.process import tune_for_cpu

Work = Callable[..., None]
# Seconds that a process has to end, or to notice that another has ended.
GRACE = 10.0


@contextmanager
def launch_workers(strategy: ManualDDP, work: Work, arguments: Sequence[Any]) -> Iterator[None]:
    """While the block lasts, all processes that the trainer's ``strategy`` asks for take part.

    The others do ``work``, a function that they import by its name, with ``arguments``, which are
    pickled. A mistake of the user is a :class:`DevrfError`, there and in the block.

    Raises:
        DevrfError: the processes cannot be started, or such a mistake ended one of them.
        RuntimeError: another error of another process, with its traceback.
    """
    environment = strategy.cluster_environment
    assert environment is not None
    outside = environment.creates_processes_externally
    if not outside and strategy.num_nodes > 1:
        raise DevrfError("trainer.num_nodes: several machines need torchrun, or SLURM's srun")
    try:
        environment.validate_settings(strategy.num_processes, strategy.num_nodes)
    except (RuntimeError, ValueError) as error:
        raise DevrfError(f"trainer.devices: {error}") from None
    if not strategy.is_global_zero:
        _silence_logs()
    others = nullcontext() if outside else _others(work, arguments, strategy.num_processes)
    with _restored(), others:
        strategy.setup_environment()
        strategy.barrier("the scene is read")
        yield
        strategy.barrier("everything is learned")
        _leave_group()


@contextmanager
def _restored() -> Iterator[None]:
    """Restore afterwards what launching and Lightning change in this process."""
    environment = dict(os.environ)
    threads = torch.get_num_threads()
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
def _others(work: Work, arguments: Sequence[Any], count: int) -> Iterator[None]:
    """Processes 1 to ``count`` - 1, which end with this block, by force if necessary."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ.update(
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), NODE_RANK="0", WORLD_SIZE=str(count)
    )
    with _signals_blocked():
        others: ProcessContext = start_processes(  # type: ignore[no-untyped-call]
            _take_part, (work, arguments), count - 1, join=False, daemon=True
        )
    os.environ["LOCAL_RANK"] = "0"
    failures: Queue[Exception] = Queue()
    over = threading.Event()
    watcher = threading.Thread(target=_watch, args=(others, failures, over), daemon=True)
    watcher.start()
    try:
        yield
        watcher.join(GRACE)
    except DevrfError:
        raise
    except Exception:
        # If another process has failed, this one only notices a broken connection.
        with suppress(Empty):
            raise failures.get(timeout=GRACE) from None
        raise
    finally:
        over.set()
        for process in others.processes:
            process.kill()
        watcher.join()


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


def _watch(others: ProcessContext, failures: Queue[Exception], over: threading.Event) -> None:
    """Wait for the others; end this process if one has failed and this one does not notice.

    Between CPUs a connection breaks at once; a GPU may wait for the lost process for half an hour.
    """
    try:
        while not others.join(grace_period=0.0):
            pass
    except ProcessException as error:
        failure = _failure(error)
        failures.put(failure)
        if not over.wait(GRACE):
            print(f"devrf: {failure}", file=sys.stderr, flush=True)
            os._exit(2 if isinstance(failure, DevrfError) else 1)


def _failure(error: ProcessException) -> Exception:
    """The error that ended another process: a user error in its one line, or its traceback."""
    if isinstance(error, ProcessExitedException):
        return DevrfError(
            f"trainer.devices: the process of rank {error.error_index + 1} ended by "
            f"{error.signal_name or f'exit status {error.exit_code}'}; was memory short?"
        )
    last = error.msg.rstrip().rpartition("\n")[2]
    _, is_devrf_error, line = last.partition(f"{DevrfError.__module__}.{DevrfError.__name__}: ")
    return DevrfError(line) if is_devrf_error else RuntimeError(error.msg)


def _take_part(index: int, work: Work, arguments: Sequence[Any]) -> None:
    """The whole life of another process."""
    os.environ["LOCAL_RANK"] = str(index + 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _silence_logs()
    tune_for_cpu()
    try:
        work(*arguments)
    except Exception:
        atexit.register(os._exit, 1)  # without the slow end of torch: rank 0 waits for it
        raise


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _silence_logs() -> None:
    """Log nothing in this process: rank 0 logs the same."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
