"""The one number by which a run is compared with others: what a search maximises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from devrf.cli.evaluate import TRAINING
from devrf.errors import DevrfError

OF_BOTH = ("psnr", "ssim", *TRAINING)
OF_MOTION = ("rest_pose_psnr", "checkpoint_mb")


def check_objective(key: str, metrics: Sequence[str]) -> None:
    """See that metrics.json will have ``key``.

    Args:
        key: ``SECTION.NAME``, such as ``deformation.psnr``.
        metrics: what is measured beside PSNR and SSIM (``evaluation.metrics``).

    Raises:
        DevrfError: it will not.
    """
    section, _, name = key.partition(".")
    if section not in ("canonical", "deformation"):
        raise DevrfError(f"objective: expected canonical.NAME or deformation.NAME, not {key!r}")
    known = [*OF_BOTH, *metrics, *(OF_MOTION if section == "deformation" else ())]
    if name not in known:
        raise DevrfError(f"objective: {section} has no {name!r}; choose from {', '.join(known)}")


def objective(key: str, found: Mapping[str, Any]) -> float | None:
    """The number ``key`` of metrics.json; None where it could not be measured.

    Of the canonical section where nothing has learned to move.
    """
    section, _, name = key.partition(".")
    value: float | None = found.get(section, found["canonical"]).get(name)
    return value
