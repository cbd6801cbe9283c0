"""The objective of a search for settings, a number of ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from devrf.errors import DevrfError, did_you_mean

# Figures of any training, and of one of frames, from the checkpoint, beside the scores.
ANY_TRAINING = ("seconds", "iterations", "iterations_per_second", "peak_gpu_gb", "num_rollbacks")
TRAINING = (*ANY_TRAINING, "lost_frames")
# Numbers of both sections of metrics.json, and of the dynamic one: of what moves, and the size of
# the checkpoint, which has all. Their second names are those of DeVRF's stages.
SCORES = ("psnr", "ssim")
OF_BOTH = (*SCORES, *ANY_TRAINING)
OF_DYNAMIC = ("rest_pose_psnr", "flicker", "pck_t", "checkpoint_mb", "lost_frames")
STATIC = ("static", "canonical")
DYNAMIC = ("dynamic", "deformation")
# The section that metrics.json has only where the objective is one of its numbers.
VALIDATION = "validation"


def check_objective(key: str, metrics: Sequence[str]) -> None:
    """Check that metrics.json will have ``key``, with these ``evaluation.metrics``.

    Raises:
        DevrfError: it will not.
    """
    section, _, name = key.partition(".")
    if section not in (*STATIC, *DYNAMIC, VALIDATION):
        expected = "static.NAME, dynamic.NAME or validation.NAME"
        raise DevrfError(f"objective: expected {expected}, not {key!r}")
    recorded = SCORES if section == VALIDATION else OF_BOTH
    names = [*recorded, *metrics, *(OF_DYNAMIC if section in DYNAMIC else ())]
    if name not in names:
        raise DevrfError(
            f"objective: {section} has no {name!r}; choose from {', '.join(names)}"
            f"{did_you_mean(name, names, f'objective={section}.')}"
        )


def objective(key: str, metrics: Mapping[str, Any]) -> float | None:
    """The number ``key`` of metrics.json; None where it could not be measured.

    The dynamic section stands in for a missing validation one, the static for a missing dynamic.
    """
    section, _, name = key.partition(".")
    dynamic = metrics["static"] if section in STATIC else metrics.get("dynamic", metrics["static"])
    value: float | None = metrics.get(section, dynamic).get(name)
    return value
