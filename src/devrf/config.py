"""Where the configuration lives, and the words it may use (OmegaConf resolvers)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any


def config_folder() -> Path:
    """The folder ``conf/``: inside an installed package, else beside ``src/`` in a checkout."""
    installed = Path(__file__).parent / "conf"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "conf"


def scene_name(data: Any) -> str:
    """The scene's short name, told from its data config alone: for folders and tables.

    The name that was given, else the embedded scene's shape, else the folder's name.
    """
    from omegaconf import OmegaConf

    if OmegaConf.is_missing(data, "root"):
        return "scene"
    chosen = data.get("name") or data.get("shape") or Path(str(data.get("root"))).resolve().name
    return re.sub(r"[^\w.-]+", "_", str(chosen)) or "scene"


def run_name(experiment: str | None, ablation: str | None) -> str:
    """The run's folder name: the experiment, and the ablation unless it is the full method."""
    parts = [experiment or "default"]
    if ablation not in (None, "full"):
        parts.append(str(ablation))
    return "-".join(parts)


def register_resolvers() -> None:
    """Make ``${devrf.scene_name:…}`` and ``${devrf.run_name:…}`` known to OmegaConf."""
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("devrf.scene_name", scene_name, replace=True)
    OmegaConf.register_new_resolver("devrf.run_name", run_name, replace=True)
