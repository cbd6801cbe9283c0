"""A search that goes on with the trials of a stored study (``hydra.sweeper.storage``)."""

from __future__ import annotations

from contextlib import suppress

from omegaconf import DictConfig, OmegaConf, read_write


def draw_others(sweeper: DictConfig) -> None:
    """Have a search draw other trials than its study has; none changes where nothing is stored.

    A sampler with the same seed would draw, and record, the first ones again.

    Args:
        sweeper: the config of Hydra's sweeper, whose seed is changed.

    Raises:
        SQLAlchemyError | ImportError: the storage cannot be read.
    """
    named = sweeper.get("storage") and sweeper.get("study_name")
    seed = OmegaConf.select(sweeper, "sampler.seed") if named else None
    if seed is None:
        return
    import optuna  # an extra

    with suppress(KeyError):  # nothing is stored under this name yet
        study = optuna.load_study(study_name=sweeper.study_name, storage=sweeper.storage)
        with read_write(sweeper):
            sweeper.sampler.seed = seed + len(study.trials)
