"""Shared by the benchmarks: a composed run, its learned scene, and the report of results.

Import it before torch, which reads its threading options when it is loaded.
"""

from __future__ import annotations

from devrf.system.process import tune_for_cpu

tune_for_cpu()

import argparse
import json
import logging
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli import run as command
from devrf.cli.complete import completed
from devrf.cli.config import config_folder
from devrf.cli.config_check import check_config
from devrf.cli.context import RunContext
from devrf.cli.run_folder import working_in
from devrf.errors import DevrfError


def parser(description: str | None, *, overrides: bool = True) -> argparse.ArgumentParser:
    """A command line with ``--json`` and, if ``overrides``, overrides of devrf's config."""
    arguments = argparse.ArgumentParser(description=description)
    if overrides:
        arguments.add_argument(
            "overrides", nargs="*", help="of devrf's config: experiment=quickstart"
        )
    arguments.add_argument("--json", type=Path, help="where the results are written")
    return arguments


def open_run(overrides: Sequence[str]) -> RunContext:
    """The run of ``python -m devrf OVERRIDES``, in the same folder.

    Raises:
        DevrfError: a setting is unknown or invalid, or asks for several processes.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    typed = completed(overrides).words
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("config", overrides=typed, return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    folder = Path(config.hydra.run.dir)
    with read_write(config.hydra), open_dict(config.hydra):
        config.hydra.runtime.output_dir = str(folder.absolute())
    HydraConfig.instance().set_config(config)  # which keeps a copy
    task = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    check_config(task)
    run = RunContext(task, folder)
    if getattr(run.strategy, "world_size", 1) > 1:
        raise DevrfError("trainer: benchmarks measure one process; leave out trainer=ddp")
    return run


def learned_scene(run: RunContext) -> LoadedCheckpoint:
    """The scene in the run's checkpoints; stages that lack one are trained first."""
    if run.config.ckpt is None:
        for stage in run.learning_stages:
            if not run.own_checkpoint(stage).exists():
                config = run.config.copy()
                config.stage = stage
                run_stage(config, run.folder)
    return run.load()


def run_stage(config: DictConfig, folder: Path) -> None:
    """Take ``config.stage`` in a run's folder, in which no other process works meanwhile."""
    with working_in(folder, config):
        command.run_stage(config, folder)


def report(rows: Sequence[dict[str, Any]], into: Path, device: torch.device, **about: Any) -> None:
    """Print rows as a table, and write them in full precision as JSON.

    Args:
        rows: results by column; missing columns of a row stay empty.
        into: the JSON file; its folder is created.
        device: the device that was measured.
        about: further entries of the file.
    """
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor()
    machine = {"device": name or device.type, "torch": torch.__version__}
    into.parent.mkdir(parents=True, exist_ok=True)
    into.write_text(json.dumps({**machine, **about, "rows": list(rows)}, indent=2) + "\n")
    table = pd.DataFrame(rows).astype(object).map(_shown)
    print(table.to_markdown(index=False, disable_numparse=True))
    print(f"written to {into}")


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.3g}"
    return str(value)
