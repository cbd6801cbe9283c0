"""How all tests run: one thread, seeded numbers. Other fixtures are in ``support/``."""

from __future__ import annotations

import gc
import logging
import signal
from collections.abc import Iterator

gc.disable()  # what is imported until all tests are collected stays

# A shell without job control starts what is in the background with SIGINT ignored, and so would
# be every command that a test starts.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import lightning.pytorch  # which sets its logger's level
import pytest
import torch
from hypothesis import settings

from devrf.geometry.box import Box

pytest_plugins = ["browser", "composed_configs", "tiny_scenes", "tiny_stages"]  # in support/

logging.getLogger(lightning.pytorch.__name__).setLevel(logging.ERROR)

# The same examples on every machine, however slow it is.
settings.register_profile("house", derandomize=True, deadline=None, database=None)
settings.load_profile("house")


@pytest.fixture(scope="session", autouse=True)
def single_thread() -> Iterator[None]:
    """Small tensors: on a busy machine threads cost more than they bring."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def pytest_collection_finish() -> None:
    """Keep Python from looking for garbage, again and again, among all that was imported."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def kept() -> Iterator[None]:
    """What a file's tests have left, such as composed configs, is not looked at again, either."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def seeded() -> None:
    """The global generator starts each test at the same place, whatever ran before."""
    torch.manual_seed(0)


@pytest.fixture
def rng() -> torch.Generator:
    """A generator of a test's own."""
    return torch.Generator().manual_seed(1)


@pytest.fixture(scope="session")
def cube() -> Box:
    """The cube from −1 to 1."""
    return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
