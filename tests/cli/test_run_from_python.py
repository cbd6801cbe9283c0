"""A config that Python composes, in a program or a notebook, where no Hydra job runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.cli.config import config_folder
from devrf.cli.run import run_stage
from devrf.errors import DevrfError


def test_what_is_composed_is_resolved_built_and_run(tiny, tmp_path):
    assert not HydraConfig.initialized()
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("config", [*tiny, "stage=canonical"])
        tracked = compose("config", ["logger=[csv,wandb]"])
    resolved = OmegaConf.to_container(config, resolve=True)
    assert resolved["output_dir"] == "outputs"
    assert instantiate(config.callbacks).checkpoint.folder.as_posix() == "outputs/checkpoints"
    loggers = instantiate(tracked.logger)
    assert str(loggers.csv.save_dir) == "outputs"
    assert str(loggers.wandb.save_dir) == str(Path("outputs").resolve())
    assert run_stage(config, tmp_path / "run") is None
    assert (tmp_path / "run/checkpoints/canonical.ckpt").is_file()
    assert (tmp_path / "run/logs/canonical/metrics.csv").is_file()
    config.priors = "some"
    with pytest.raises(DevrfError, match="^priors: expected 'all' or 'none', not 'some'"):
        run_stage(config, tmp_path / "run")


def test_the_folder_of_a_command_is_hydras(devrf, tmp_path):
    outcome = devrf("output_dir=here", "hydra.run.dir=run")
    said = f"output_dir: expected {tmp_path}/run, which hydra.run.dir=FOLDER chooses, not here"
    assert (outcome.status, outcome.err) == (2, f"devrf: {said}\n")
    assert not list(tmp_path.iterdir())
