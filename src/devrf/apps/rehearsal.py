"""What a rehearsal of a run came to: tables, and why it says no where it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any, Literal

import torch
from rich.console import Group, RenderableType

from devrf.apps.images import evenly
from devrf.apps.inspection.report import titled_table
from devrf.evaluation.held_out import background_value, truth_image
from devrf.metrics.image import psnr, psnr_masked
from devrf.scenes.scene import CaptureName, Scene

# The scores of a rehearsal, and what took place in it; of a run they are in metrics.json.
REHEARSAL = "rehearsal.json"
# A rehearsal's images have at most so many pixels a side.
LONGEST = 64
# A stage has learned something where it is so much better than a picture of one colour, in dB,
# and motion where it is so much better than the scene at rest.
LEAST_GAIN = 1.0
LEAST_MOTION = 0.05
# Images of which the mean colour is taken.
SAMPLED = 32

ALL: tuple[CaptureName, ...] = ("static", "dynamic")

# By capture: scores as in metrics.json; the PSNR of a picture of one colour.
Sections = Mapping[CaptureName, Mapping[str, Any]]
Blank = Mapping[CaptureName, float]


@dataclass(frozen=True)
class RehearsedStage:
    """A stage that was rehearsed.

    Attributes:
        capture: the part of the scene that it learned from.
        iterations: that were carried out.
        whole: iterations of the stage in the run itself.
        events: what took place, and how often.
        planned: the same as its schedule says.
    """

    capture: CaptureName | Literal["both"]
    iterations: int
    whole: int
    events: Mapping[str, int]
    planned: Mapping[str, int]


def single_color_psnr(scene: Scene, capture: CaptureName) -> float:
    """PSNR (dB) of the best picture of one colour, in the mean over a capture's held-out images.

    That colour is the background's, or the mean of the images that are learned from.
    """
    views = scene.capture(capture).test
    learned = scene.capture(capture).train
    images = [truth_image(learned, k, scene.background) for k in evenly(len(learned), SAMPLED)]
    mean = torch.stack([image.mean(dim=(0, 1)) for image in images]).mean(dim=0)

    def score(color: torch.Tensor) -> float:
        values = []
        for index in range(len(views)):
            truth = truth_image(views, index, scene.background)
            valid = views.valid_mask_of(index)
            picture = color.expand_as(truth)
            masked = None if valid is None else psnr_masked(picture, truth, valid)
            values.append(psnr(picture, truth) if masked is None else masked)
        return fmean(values)

    return max(score(mean), score(torch.full((3,), background_value(scene.background))))


def shortfalls(stages: Mapping[str, RehearsedStage], sections: Sections, blank: Blank) -> list[str]:
    """Why the run itself should not be begun: what a stage did not learn, what did not take place.

    Args:
        stages: what was rehearsed, by name.
        sections: the scores of each capture, as in ``metrics.json``.
        blank: PSNR of a picture of one colour, by capture.
    """
    reasons: list[str] = []
    for name, stage in stages.items():
        captures = ALL if stage.capture == "both" else (stage.capture,)
        for capture in captures:
            if capture not in sections:
                continue
            reached = sections[capture]["psnr"]
            if not reached >= blank[capture] + LEAST_GAIN:
                reasons.append(
                    f"the {name} stage has learned nothing: {reached:.2f} dB on {capture} images, "
                    f"a picture of one colour {blank[capture]:.2f}"
                )
        rest = sections.get("dynamic", {}).get("rest_pose_psnr")
        if "dynamic" in captures and rest is not None and not reasons:
            reached = sections["dynamic"]["psnr"]
            if not reached >= rest + LEAST_MOTION:
                reasons.append(
                    f"the {name} stage has learned no motion: {reached:.2f} dB, the scene at rest "
                    f"{rest:.2f}"
                )
        reasons += [
            f"the {name} stage: {event} {stage.events.get(event, 0)} times of {count}"
            for event, count in stage.planned.items()
            if stage.events.get(event, 0) != count
        ]
    return reasons


def rehearsal_tables(
    stages: Mapping[str, RehearsedStage],
    sections: Sections,
    blank: Blank,
    needs: Sequence[tuple[str, str]],
) -> RenderableType:
    """What each stage reached, what took place, and what the run itself ``needs``, for people."""
    reached = [
        (
            capture,
            f"{section['psnr']:.2f} dB",
            f"{blank[capture]:.2f} dB",
            _in_db(section.get("rest_pose_psnr")),
        )
        for capture, section in sections.items()
        if capture in blank
    ]
    events = [
        (name, f"{event}: {stage.events.get(event, 0)} of {count}")
        for name, stage in stages.items()
        for event, count in stage.planned.items()
    ]
    lengths = [
        (name, f"{stage.iterations:,} of {stage.whole:,}".replace(",", " "))
        for name, stage in stages.items()
    ]
    heading = ("held-out images", "reached", "one colour", "scene at rest")
    return Group(
        titled_table("what was learned", reached, heading),
        titled_table("iterations", lengths),
        *([titled_table("what took place", events)] if events else []),
        titled_table("what the run itself will need, estimated", needs),
    )


def record(
    stages: Mapping[str, RehearsedStage], blank: Blank, reasons: Sequence[str]
) -> dict[str, Any]:
    """What ``rehearsal.json`` has beside scores and provenance."""
    return {
        "stages": {name: asdict(stage) for name, stage in stages.items()},
        "single_color_psnr": {capture: round(value, 4) for capture, value in blank.items()},
        "shortfalls": list(reasons),
    }


def _in_db(value: float | None) -> str:
    return "" if value is None else f"{value:.2f} dB"
