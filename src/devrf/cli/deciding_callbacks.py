"""Which callbacks decide what is learned: all but those known only to look, or to set a limit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from devrf.cli.config import config_folder

# Classes of devrf and Lightning; what a class of the user's own does, nobody knows.
PACKAGES = ("devrf.", "lightning.")
ONLY_LOOK = {"Progress", "Meter", "FrameFit", "TrainingCurve", "Previews", "PeriodicCheckpoint"}
ONLY_LOOK |= {"ModelCheckpoint", "OnExceptionCheckpoint", "Timer", "ProgressBar", "ModelSummary"}
ONLY_LOOK |= {"TQDMProgressBar", "RichProgressBar", "RichModelSummary"}
ONLY_LOOK |= {"DeviceStatsMonitor", "LearningRateMonitor", "ThroughputMonitor"}
# In place without a section ``callbacks``, too.
ALWAYS = ("grid_upscaling", "learning_rate_decay")


def deciding_callbacks(config: DictConfig) -> dict[str, Any]:
    """The settings of callbacks that decide what is learned, where they are not the usual ones.

    By config key, ``callbacks.NAME`` alone with None for one that was left out. References stand as
    they are: what they refer to is a setting of its own, or a place.
    """
    usual = _container(OmegaConf.load(config_folder() / "callbacks" / "default.yaml"))
    without = {name: usual[name] for name in ALWAYS}
    present = _container(config.callbacks) if "callbacks" in config else without
    settings: dict[str, Any] = {}
    for name in {**usual, **present}:
        before, now = (part.get(name) or {} for part in (usual, present))
        if _only_looks(before) and _only_looks(now):
            continue
        keys = [key for key in {**before, **now} if before.get(key) != now.get(key)]
        settings |= {f"callbacks.{name}.{key}": now.get(key) for key in keys if now}
        settings |= {} if now else {f"callbacks.{name}": None}
    return settings


def _container(config: Any) -> dict[str, Any]:
    container: Any = OmegaConf.to_container(config) if config is not None else {}
    return {str(name): settings for name, settings in container.items()}


def _only_looks(callback: Mapping[str, Any]) -> bool:
    """Whether a callback by its settings, {} for none, only looks."""
    target = str(callback.get("_target_", ""))
    return not callback or target.startswith(PACKAGES) and target.rpartition(".")[2] in ONLY_LOOK
