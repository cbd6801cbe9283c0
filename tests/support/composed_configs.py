"""The real configs, composed as the command line composes them: a fixture."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, open_dict

from devrf.cli.config import config_folder

Composed = Callable[..., DictConfig]

known: dict[tuple[str, ...], bytes] = {}


def whole_config(*overrides: str) -> DictConfig:
    """The config with Hydra's own part; composed once, whoever asks for it."""
    if overrides not in known:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            whole = compose("config", list(overrides), return_hydra_config=True)
        known[overrides] = pickle.dumps(whole)
    return cast(DictConfig, pickle.loads(known[overrides]))


@pytest.fixture
def composed(tmp_path: Path) -> Iterator[Composed]:
    """``composed(*overrides)``: the config of a run in a folder of the test's own."""
    hydra = HydraConfig.instance()
    before = hydra.cfg

    def config(*overrides: str) -> DictConfig:
        whole = whole_config(*overrides)
        with open_dict(whole):
            whole.hydra.runtime.output_dir = str(tmp_path)
        hydra.set_config(whole)
        task = whole_config(*overrides)
        with open_dict(task):
            del task["hydra"]
        return task

    yield config
    hydra.cfg = before
