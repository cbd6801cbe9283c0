"""The command line, called in this process as a user would call it."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from devrf.__main__ import entry

# A scene of 24 x 20 pixels and schedules of a few iterations: seconds, and no quality.
TINY = (
    "data.width=24", "data.height=20", "data.static_views=6", "data.static_test_views=2",
    "data.train_views=2", "data.frames=3", "data.supersample=1",
)
SHORT = (
    "field=small", "field.width=16", "schedule.canonical.iterations=6",
    "schedule.canonical.side=16", "schedule.canonical.search_side=16",
    "schedule.canonical.doublings=[2]", "schedule.canonical.rays=64",
    "schedule.deformation.sides=[4,8]", "schedule.deformation.iterations_per_frame=[2,2]",
    "schedule.deformation.rays=64", "video.frames=4", "trainer=cpu",
)


@dataclass(frozen=True)
class Outcome:
    """What a command came to: its exit status and what it said."""

    status: int
    out: str
    err: str


Devrf = Callable[..., Outcome]


def call(folder: Path, *arguments: str) -> Outcome:
    """``devrf ARGUMENTS`` with ``folder`` as the working folder."""
    said, complained = io.StringIO(), io.StringIO()
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["devrf", *arguments])
        patch.setenv("HYDRA_FULL_ERROR", "0")  # restored afterwards: the entry point changes it
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
            try:
                entry()
                status = 0
            except SystemExit as stop:
                status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            finally:
                os.environ.pop("PL_GLOBAL_SEED", None)
                for handler in set(root.handlers) - set(handlers):
                    handler.close()
                root.handlers[:] = handlers
                root.setLevel(level)
    return Outcome(status, said.getvalue(), complained.getvalue())


@pytest.fixture(scope="session")
def tiny() -> tuple[str, ...]:
    """Overrides that make the embedded scene and the schedules tiny."""
    return (*TINY, *SHORT)


@pytest.fixture(scope="session")
def short() -> tuple[str, ...]:
    """Overrides that make the schedules tiny, for a scene of any kind."""
    return SHORT


@pytest.fixture(scope="session")
def devrf_in() -> Devrf:
    """``devrf_in(folder, *arguments)``: the command with that working folder."""
    return call


@pytest.fixture
def devrf(tmp_path: Path) -> Devrf:
    """``devrf(*arguments)``: the command in a folder of the test's own."""
    return lambda *arguments: call(tmp_path, *arguments)


@pytest.fixture(scope="session")
def trained(
    tmp_path_factory: pytest.TempPathFactory, tiny: tuple[str, ...]
) -> Iterator[tuple[Path, Outcome]]:
    """The folder of a whole tiny run and what the command said; to be read only."""
    folder = tmp_path_factory.mktemp("trained")
    outcome = call(folder, *tiny)
    yield folder / "outputs" / "robot" / "default", outcome
