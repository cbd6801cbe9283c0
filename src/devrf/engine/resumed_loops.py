"""Counts of Lightning's loops, in a run that goes on from a progress file."""

from __future__ import annotations

from typing import Any

from lightning import Trainer

from devrf.system.plain_data import Count, validate


def resumed_fit_loop(stored: Any, trainer: Trainer) -> Any:
    """The stored state of a trainer's fit loop, checked, as that of an epoch that goes on.

    A schedule is one epoch of a loader that never ends: what ended it there (``max_time``,
    ``limit_train_batches``, ``fast_dev_run``) has not ended it here.
    """
    loop = _counts(stored, like=trainer.fit_loop.state_dict())
    for epochs in ("total", "current"):
        loop["epoch_progress"][epochs].update(processed=0, completed=0)
    loop["epoch_loop.batch_progress"]["is_last_batch"] = False
    return loop


def _counts(stored: Any, like: Any) -> Any:
    """The stored counts at those keys at which ``like`` has some."""
    if isinstance(like, dict):
        return {key: _counts(stored[key], value) for key, value in like.items()}
    return validate(Count if type(like) is int else type(like), stored)
