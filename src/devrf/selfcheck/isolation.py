"""Work in a process of its own: what ends or hangs there ends nothing else.

An illegal access on a GPU makes every later call of its process fail; a kernel may never return.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any

import torch

from devrf.selfcheck.finding import Finding

# What the processes' parent imports once for all of them.
PRELOADED = "devrf.selfcheck.checks"
Work = Callable[..., Finding]
# Seconds in which a process should have reached a device.
REACHED = 60.0


class NoFindingError(Exception):
    """The work has not come to a finding; its text says why, on one line."""


@contextmanager
def warm_processes(variables: dict[str, str]) -> Iterator[BaseContext]:
    """What starts processes without waiting for their imports, where the system can fork.

    Args:
        variables: of their environment, where it does not have them already.
    """
    before = dict(os.environ)
    os.environ.update({**variables, **before})
    forks = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if forks else "spawn")
    if forks:
        context.set_forkserver_preload([PRELOADED])
    try:
        yield context
    finally:
        os.environ.clear()
        os.environ.update(before)


def can_use(context: BaseContext, device: torch.device, log: Path) -> bool:
    """Whether processes that ``context`` starts reach the device.

    Forked ones do not, if what they were forked from has called CUDA.
    """
    try:
        return isolated(context, _use, (device,), log, REACHED).held
    except NoFindingError:
        return False


def _use(device: torch.device) -> Finding:
    return Finding(bool(torch.ones(1, device=device).item()), "reached")


def isolated(
    context: BaseContext, work: Work, arguments: tuple[Any, ...], log: Path, seconds: float
) -> Finding:
    """The finding of ``work(*arguments)``, in a process of its own.

    Args:
        context: starts the process.
        work: importable by name.
        arguments: of the work; can be pickled.
        log: what the process says is appended to it, tracebacks too.
        seconds: after which it is killed.

    Raises:
        NoFindingError: the work raised an error, or its process ended or took too long.
    """
    here, there = context.Pipe(duplex=False)
    process = context.Process(  # type: ignore[attr-defined]
        target=_take_part, args=(there, work, arguments, log), daemon=True
    )
    began = time.monotonic()
    process.start()
    there.close()
    try:
        if not here.poll(max(0.0, seconds - (time.monotonic() - began))):
            raise NoFindingError(f"still at work after {seconds:.0f} s")
        answer = here.recv()
    except EOFError:
        process.join(10)
        status = process.exitcode
        how = f"was ended by signal {-status}" if status and status < 0 else f"ended with {status}"
        raise NoFindingError(f"its process {how}") from None
    finally:
        process.kill()
        process.join()
        here.close()
    if isinstance(answer, Finding):
        return answer
    raise NoFindingError(answer)


def _take_part(answer: Connection, work: Work, arguments: tuple[Any, ...], log: Path) -> None:
    """The whole life of the process."""
    with log.open("a") as file:
        # The descriptors, too: compilers and drivers write to them.
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1, closefd=False) for n in (1, 2))
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    logging.basicConfig(level=logging.INFO, format="%(message)s", force=True)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    try:
        answer.send(work(*arguments))
    except BaseException as error:
        traceback.print_exc()
        answer.send(" ".join(f"{type(error).__name__}: {error}".split())[:300])
    sys.stdout.flush()
    sys.stderr.flush()
