"""Runs devrf commands in processes of their own that need not import anything first.

A script, not a test: it loads the program and its kernels and composes its config once, and then
forks for each command. It reads a JSON object a line and answers with the command's exit status,
negative for the signal that ended it. The keys, all but the first two optional:

* ``folder``, ``arguments``: where to run what. What the command says is added to ``said.txt``.
* ``after``: ``[kind, count]``, the moment of the signal. The kind is ``step`` (an optimiser step
  begins) or ``file`` (the write of a tensor, an fsync or a rename begins).
* ``delay``: seconds from that moment to the signal.
* ``signals``: the numbers of the signals to send.
* ``most_bytes``: how large a file may become, as on a disk that is full.
* ``most_memory``: bytes that the process may take beside what it has already.
* ``hangs``: the stage ``prepare`` makes a file ``begun`` in the run's folder and goes on for longer
  than any test.
* ``environment``: variables to set.
* ``path``: a folder in which it, and processes that it starts, find modules.
* ``torchrun``: arguments of torchrun, which runs the command in further processes.
* ``begins``: the answer, at once, is the number of the process, for which ``{"wait": NUMBER}``
  waits, and which ``{"end": NUMBER}`` kills.
* ``unread``: nobody reads what is said on stdout.
* ``complaints``: the file for what is said on stderr, instead of ``said.txt``.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

gc.disable()  # what is imported stays

import torch
from hydra import compose, initialize_config_dir
from torch.distributed import run as torchrun

import devrf.apps.video
import devrf.callbacks
import devrf.cli.run
from devrf.__main__ import entry
from devrf.checkpoints import checkpoint_file
from devrf.cli.config import config_folder
from devrf.engine.grid_adam import GridAdam
from devrf.kernels.ahead import compile_ahead, grid_kernels, march_kernels
from devrf.pictures import held_out


class Fuse:
    """Counts what happens, and sends this process its signals when it is time."""

    def __init__(self, asked: dict[str, Any]) -> None:
        self.counts = {"step": 0, "file": 0}
        self._asked = asked

    def tick(self, kind: str) -> bool:
        """Count; say whether this is the moment."""
        self.counts[kind] += 1
        return [kind, self.counts[kind]] == self._asked.get("after")

    def burn(self) -> None:
        """Send the signals: now, or from another thread a little later."""
        if self._asked.get("delay"):
            threading.Thread(target=self._send).start()
        else:
            self._send()

    def _send(self) -> None:
        time.sleep(self._asked.get("delay", 0))
        for number in self._asked["signals"]:
            os.kill(os.getpid(), number)

    def install(self) -> None:
        """Count from now on."""
        step = GridAdam.step

        def counted_step(optimizer: Any, closure: Any = None) -> Any:
            if self.tick("step"):
                self.burn()
            return step(optimizer, closure)

        GridAdam.step = counted_step  # type: ignore[method-assign]
        # Before a tensor is written, the file holds those before it.
        checkpoint_file._data = self._counted(checkpoint_file._data)
        os.fsync, os.replace = self._counted(os.fsync), self._counted(os.replace)

    def _counted(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            if self.tick("file"):
                self.burn()
            return function(*arguments)

        return call


def run(asked: dict[str, Any]) -> int:
    """The life of a child; its status."""
    folder = Path(asked["folder"])
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    for file, descriptor in (("said.txt", 1), (asked.get("complaints", "said.txt"), 2)):
        with open(file, "a") as said:
            os.dup2(said.fileno(), descriptor)
    if "unread" in asked:
        read, write = os.pipe()
        os.close(read)
        os.dup2(write, 1)
    os.environ.update(asked.get("environment", {}))
    if "path" in asked:
        sys.path.insert(0, asked["path"])
        os.environ["PYTHONPATH"] = os.pathsep.join([asked["path"], os.environ["PYTHONPATH"]])
    if "most_bytes" in asked:
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["most_bytes"],) * 2)
    if "most_memory" in asked:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + asked["most_memory"],) * 2)
    if asked.get("hangs"):
        devrf.cli.run.STEPS["prepare"] = hang
    fuse = Fuse(asked)
    fuse.install()
    sys.argv = ["devrf", *asked["arguments"]]
    status = 0
    try:
        if "torchrun" in asked:
            torchrun.main([*asked["torchrun"], "-m", "devrf", *asked["arguments"]])
        else:
            entry()
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
    sys.stdout.flush()
    sys.stderr.flush()
    return status


def hang(context: Any) -> None:
    """Say that the run has begun, and go on."""
    (context.folder / "begun").touch()
    time.sleep(600)


def main() -> None:
    """Fork for each command that is asked for."""
    torch.set_num_threads(1)
    held_out.MIN_HEIGHT = 40  # contact sheets of tiny images are small, too
    compile_ahead([*march_kernels(), *grid_kernels({1, 3, 12})], torch.device("cpu")).join()
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        compose("config")
    gc.freeze()  # what is there stays shared with the children
    gc.enable()
    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if "end" in asked:
            child = asked["end"]
            os.kill(child, signal.SIGKILL)
        elif "wait" in asked:
            child = asked["wait"]
        else:
            child = os.fork()
        if child == 0:
            status = 99
            try:
                status = run(asked)
            finally:
                os._exit(status)
        if asked.get("begins"):
            print(child, flush=True)
            continue
        _, how = os.waitpid(child, 0)
        print(json.dumps(os.waitstatus_to_exitcode(how)), flush=True)


main()
