"""The command line, called in this process as a user would call it."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig

import devrf as package
import devrf.cli.run  # what every command loads is there before the garbage collector looks
from devrf.__main__ import entry
from devrf.pictures import held_out
from devrf.scenes.procedural.recipe import Recipe
from devrf.scenes.scene import Scene

# A scene of 24 x 20 pixels and schedules of a few iterations: seconds, and no quality.
TINY = (
    "data.width=24",
    "data.height=20",
    "data.static_views=6",
    "data.static_test_views=2",
    "data.train_views=2",
    "data.frames=3",
    "data.supersample=1",
)
# A forward-facing one.
FACING = (
    "data=procedural_forward",
    "data.width=24",
    "data.height=20",
    "data.static_views=8",
    "data.train_views=2",
    "data.frames=3",
    "data.supersample=1",
)
SHORT = (
    "field.planes=null",
    "field.width=16",
    "schedule.canonical.iterations=6",
    "schedule.canonical.side=16",
    "schedule.canonical.search_side=16",
    "schedule.canonical.upsample_at=[2]",
    "schedule.canonical.rays=64",
    "schedule.deformation.levels.1={side:4,iterations:2}",
    "schedule.deformation.levels.2={side:8,iterations:2}",
    "schedule.deformation.levels.3=null",
    "schedule.deformation.rays=64",
    "video.frames=4",
    "video.height=40",
    "trainer=cpu",
)
# The plots of training take a tenth of the time of such a run.
PLAIN = "~callbacks.training_curve"
# The least height of images in contact sheets; at the usual 300 they take another tenth.
SHEET = 40


@dataclass(frozen=True)
class Outcome:
    """A command's exit status and output."""

    status: int
    out: str
    err: str


Devrf = Callable[..., Outcome]

render = Recipe.__call__
rendered: dict[str, Scene] = {}


def known_scene(recipe: Recipe) -> Scene:
    """The scene of a recipe, rendered once: the same recipe always gives the same scene."""
    if repr(recipe) not in rendered:
        rendered[repr(recipe)] = render(recipe)
    return rendered[repr(recipe)]


def call(folder: Path, *arguments: str) -> Outcome:
    """``devrf ARGUMENTS`` with ``folder`` as the working folder."""
    said, complained = io.StringIO(), io.StringIO()
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["devrf", *arguments])
        patch.setattr(Recipe, "__call__", known_scene)
        patch.setattr(held_out, "MIN_HEIGHT", SHEET)
        patch.setenv("HYDRA_FULL_ERROR", "0")  # restored afterwards: the entry point changes it
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
            try:
                entry()
                status = 0
            except SystemExit as stop:
                status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            finally:
                os.environ.pop("PL_GLOBAL_SEED", None)
                HydraConfig.instance().cfg = None  # which --cfg leaves behind
                for handler in set(root.handlers) - set(handlers):
                    handler.close()
                root.handlers[:] = handlers
                root.setLevel(level)
    return Outcome(status, said.getvalue(), complained.getvalue())


@pytest.fixture(scope="session")
def tiny_data() -> tuple[str, ...]:
    """Overrides that make the embedded scene tiny, whatever the method."""
    return TINY


@pytest.fixture(scope="session")
def tiny_facing() -> tuple[str, ...]:
    """Overrides that choose the embedded forward-facing scene and make it tiny."""
    return FACING


@pytest.fixture(scope="session")
def tiny() -> tuple[str, ...]:
    """Overrides that make the embedded scene and the schedules tiny, and draw no plot."""
    return (*TINY, *SHORT, PLAIN)


@pytest.fixture(scope="session")
def short() -> tuple[str, ...]:
    """Overrides that make the schedules tiny, for a scene of any kind, and draw no plot."""
    return (*SHORT, PLAIN)


@pytest.fixture(scope="session")
def often() -> tuple[str, ...]:
    """Overrides that write a progress file after every iteration."""
    saving = ("callbacks.checkpoint.every_seconds=0", "callbacks.checkpoint.share=1.0")
    steps = ("canonical.iterations_per_step=1", "deformation.iterations_per_step=1")
    return (*saving, *steps, "trainer.log_every_n_steps=100")


@pytest.fixture(scope="session")
def devrf_in() -> Devrf:
    """``devrf_in(folder, *arguments)``: the command with that working folder."""
    return call


@pytest.fixture
def devrf(tmp_path: Path) -> Devrf:
    """``devrf(*arguments)``: the command in a folder of the test's own."""
    return lambda *arguments: call(tmp_path, *arguments)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Outcome]]:
    """The folder of a whole tiny run and what the command said; to be read only."""
    folder = tmp_path_factory.mktemp("trained")
    outcome = call(folder, *TINY, *SHORT)
    yield folder / "outputs" / "robot" / "quickstart", outcome


def environment() -> dict[str, str]:
    """This process's environment, with the package on Python's path."""
    path = [str(Path(package.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    own = {"PYTHONPATH": os.pathsep.join(path), "OMP_NUM_THREADS": "1", "HYDRA_FULL_ERROR": "0"}
    return {**os.environ, **own}


@pytest.fixture(scope="session")
def python() -> Callable[..., Outcome]:
    """``python(folder, *arguments)``: what Python in a process of its own came to."""

    def run(folder: Path, *arguments: str) -> Outcome:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=folder,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=300,
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return run


class Warm:
    """Runs commands in processes of their own, without waiting for their imports."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._hanging: list[int] = []

    def __call__(self, folder: Path, *arguments: str, **how: Any) -> Outcome:
        """``devrf ARGUMENTS`` in ``folder``; ``warm_process.py`` describes ``how``."""
        said = folder / "said.txt"
        before = said.stat().st_size if said.exists() else 0
        status = self._answer(folder=str(folder), arguments=arguments, **how)
        return Outcome(status, said.read_text()[before:], "")

    def together(self, folders: Sequence[Path], *arguments: str, **each: Any) -> list[Outcome]:
        """``devrf ARGUMENTS`` in each of the folders at once; ``each`` has a value for each."""
        begun = []
        for k, folder in enumerate(folders):
            how = {name: values[k] for name, values in each.items()}
            how |= {"begins": True, "complaints": "complaints.txt"}
            begun.append(self._answer(folder=str(folder), arguments=arguments, **how))
        outcomes = []
        for child, folder in zip(begun, folders, strict=True):
            status = self._answer(wait=child)
            said = (folder / "said.txt").read_text()
            outcomes.append(Outcome(status, said, (folder / "complaints.txt").read_text()))
        return outcomes

    def hanging(self, folder: Path, *arguments: str) -> int:
        """``devrf ARGUMENTS stage=prepare``, begun in a process that works on; its number."""
        arguments = (*arguments, "stage=prepare")
        child = self._answer(folder=str(folder), arguments=arguments, hangs=True, begins=True)
        self._hanging.append(child)
        for _ in range(6000):
            if list(folder.rglob("begun")):
                return child
            time.sleep(0.01)
        raise AssertionError((folder / "said.txt").read_text())

    def end(self, child: int) -> None:
        """Kill a process that hangs."""
        self._hanging.remove(child)
        self._answer(end=child)

    def end_all(self) -> None:
        """Kill the processes that still hang."""
        for child in list(self._hanging):
            self.end(child)

    def _answer(self, **asked: Any) -> int:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return int(json.loads(self._process.stdout.readline()))


@contextlib.contextmanager
def warmed(*path: Path) -> Iterator[Warm]:
    """Runs commands in processes of their own, which find modules in the folders of ``path``."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")
    own = environment()
    own["PYTHONPATH"] = os.pathsep.join([own["PYTHONPATH"], *map(str, path)])
    with subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("warm_process.py"))],
        env=own,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield Warm(process)
        process.stdin.close()


@pytest.fixture(scope="session")
def warm() -> Iterator[Warm]:
    """Runs commands in processes of their own, at the cost of a fork each."""
    with warmed() as commands:
        yield commands


@pytest.fixture(scope="session")
def warm_with() -> Callable[..., contextlib.AbstractContextManager[Warm]]:
    """The function :func:`warmed`."""
    return warmed
