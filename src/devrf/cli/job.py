"""The present job as Hydra knows it: what was chosen, what was asked for, whether others follow."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode


def choices() -> dict[str, str | None]:
    """The chosen option of each of devrf's config groups, by group; empty outside Hydra."""
    if not HydraConfig.initialized():
        return {}
    chosen = HydraConfig.get().runtime.choices
    return {str(k): v for k, v in chosen.items() if not str(k).startswith("hydra/")}


def overrides() -> list[str]:
    """What was given on the command line, Hydra's own keys left out; empty outside Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def in_sweep() -> bool:
    """Whether the job is one of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_search() -> bool:
    """Whether the sweeper looks for the best, and so needs a number from each job."""
    return in_sweep() and "direction" in HydraConfig.get().sweeper
