"""The door: composes the config, checks it, and runs the asked stage."""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from devrf.config import config_folder, register_resolvers
from devrf.config_check import check_config
from devrf.messages import mistakes_in_one_line
from devrf.run_folder import nothing_left_of_mistakes

register_resolvers()


@hydra.main(config_path=str(config_folder()), config_name="config", version_base="1.3")
def main(config: DictConfig) -> None:
    """Run ``stage=…`` in the folder that Hydra made for it."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    with mistakes_in_one_line(), nothing_left_of_mistakes(folder):
        check_config(config)
        # Imported here: --help and a misspelt key are answered before torch has loaded.
        from devrf.run.steps import run_stage

        run_stage(config, folder)
