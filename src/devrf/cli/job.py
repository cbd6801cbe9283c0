"""The present Hydra job: its choices, overrides and mode."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode


def choices() -> dict[str, str | None]:
    """The chosen option of each config group, without Hydra's own; empty outside Hydra."""
    if not HydraConfig.initialized():
        return {}
    chosen = HydraConfig.get().runtime.choices
    return {str(k): v for k, v in chosen.items() if not str(k).startswith("hydra/")}


def overrides() -> list[str]:
    """The overrides of the command line, without Hydra's own; empty outside Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def in_sweep() -> bool:
    """Whether the job is one of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_search() -> bool:
    """Whether the sweeper optimises, and so needs the objective of each job."""
    return in_sweep() and "direction" in HydraConfig.get().sweeper
