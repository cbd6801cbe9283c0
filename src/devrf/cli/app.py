"""The Hydra application: composes the config, checks it, and runs the stage."""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from devrf.cli import job, learned_with
from devrf.cli.config import config_folder, register_resolvers
from devrf.cli.config_check import check_config
from devrf.cli.data_choice import with_recognised_data
from devrf.cli.extras import check_extras
from devrf.cli.messages import report_user_errors
from devrf.cli.paper_scene import check_paper_scene
from devrf.cli.run_folder import removed_on_user_error
from devrf.cli.run_lock import exclusive
from devrf.cli.sweep import forget_failure, run_job
from devrf.system.process import importing

register_resolvers()


def run(config: DictConfig) -> float | None:
    """Run ``stage=…`` in Hydra's output folder; return the objective, if measured."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    learned_with.log_source()
    if job.in_sweep():
        return run_job(lambda: _job(config, folder), config, folder)
    with (
        report_user_errors(),
        exclusive(folder, config, "hydra.run.dir"),
        removed_on_user_error(folder),
    ):
        value = _checked(config, folder)
        forget_failure(folder)
        return value


def _job(config: DictConfig, folder: Path) -> float | None:
    with exclusive(folder, config, "hydra.sweep.dir"):
        return _checked(config, folder)


def _checked(config: DictConfig, folder: Path) -> float | None:
    check_paper_scene(job.choices())
    config = with_recognised_data(config)
    check_config(config)
    check_extras(config)
    # Imported here: --help and a misspelt key are answered before torch has loaded.
    with importing():
        from devrf.cli.steps import run_stage

    return run_stage(config, folder)


# A name of its own: other processes import `run` by its name.
main = hydra.main(config_path=str(config_folder()), config_name="config", version_base="1.3")(run)
