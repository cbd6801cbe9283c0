"""Results of a run's rehearsal: tables, and the reasons for a refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import Any, Literal

import torch
from rich.console import Group, RenderableType
from torch import Tensor

from devrf.apps.inspection.report import titled_table
from devrf.evaluation.held_out import score
from devrf.metrics.image import psnr
from devrf.pictures.images import evenly
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.scenes.reduced import reduced
from devrf.scenes.scene import Capture, CaptureName, Scene, background_value

# A rehearsal's images have at most so many pixels a side, and so many of a set are looked at.
LONGEST = 64
LOOKED_AT = 6
# A stage has learned something if it is so much better than a picture of one colour, in dB, and
# motion if it is so much better than the scene at rest. Training images are compared, since the few
# iterations of a rehearsal do not generalise to new views.
LEAST_GAIN = 1.0
LEAST_MOTION = 0.05

ALL: tuple[CaptureName, ...] = ("static", "dynamic")


@dataclass(frozen=True)
class Learned:
    """Scores of some training images: PSNR in dB, means over them.

    Attributes:
        psnr: of the renderings.
        blank: of the best picture of one colour.
        rest_pose: of the scene at rest; None for images at rest.
    """

    psnr: float
    blank: float
    rest_pose: float | None


@dataclass(frozen=True)
class RehearsedStage:
    """A stage that was rehearsed.

    Attributes:
        capture: the part of the scene that it learned from.
        iterations: that were carried out.
        whole: iterations of the stage in the run itself.
        events: counts of events, by name.
        planned: the same as its schedule says.
    """

    capture: CaptureName | Literal["both"]
    iterations: int
    whole: int
    events: Mapping[str, int]
    planned: Mapping[str, int]


def for_rehearsal(scene: Scene) -> Scene:
    """The scene with small images, and few of them held out."""

    def few_held_out(capture: Capture) -> Capture:
        subset = torch.tensor(evenly(len(capture.test), LOOKED_AT))
        return replace(capture, test=capture.test[subset])

    small = reduced(scene, LONGEST)
    if scene.static.test is scene.dynamic.test:  # of a monocular video
        static = few_held_out(small.static)
        return replace(small, static=static, dynamic=replace(small.dynamic, test=static.test))
    return replace(small, static=few_held_out(small.static), dynamic=few_held_out(small.dynamic))


def learned(model: Renderable, scene: Scene, capture: CaptureName) -> Learned:
    """Scores of some of a capture's training images."""
    train = scene.capture(capture).train
    views = train[torch.tensor(evenly(len(train), LOOKED_AT))]
    renderer = Renderer(model)
    time = 0.0 if capture == "static" else None
    scored = [score(renderer, views, k, scene.background, time=time) for k in range(len(views))]
    truths = [view.truth for view in scored]
    mean = torch.stack([truth.mean(dim=(0, 1)) for truth in truths]).mean(dim=0)
    background = torch.full((3,), background_value(scene.background))

    rest_pose = [view.rest_pose_psnr for view in scored if view.rest_pose_psnr is not None]

    def of_color(color: Tensor) -> float:
        return fmean(psnr(color.expand_as(truth), truth) for truth in truths)

    return Learned(
        psnr=fmean(view.psnr for view in scored),
        blank=max(of_color(mean), of_color(background)),
        rest_pose=fmean(rest_pose) if capture == "dynamic" else None,
    )


def shortfalls(
    stages: Mapping[str, RehearsedStage], reached: Mapping[CaptureName, Learned]
) -> list[str]:
    """Reasons not to begin the run itself: stages that learned nothing, events that are missing.

    Args:
        stages: the rehearsed stages, by name.
        reached: the scores of each capture.
    """
    reasons: list[str] = []
    for name, stage in stages.items():
        for capture in ALL if stage.capture == "both" else (stage.capture,):
            if (of := reached.get(capture)) is None:
                continue
            # NaN compares false.
            if not of.psnr >= of.blank + LEAST_GAIN:
                reasons.append(
                    f"the {name} stage has learned nothing of the {capture} images: "
                    f"{of.psnr:.2f} dB, where one colour has {of.blank:.2f}"
                )
            elif of.rest_pose is not None and not of.psnr >= of.rest_pose + LEAST_MOTION:
                reasons.append(
                    f"the {name} stage has learned no motion: {of.psnr:.2f} dB, where the scene "
                    f"at rest has {of.rest_pose:.2f}"
                )
        reasons += [
            f"{event} {stage.events.get(event, 0)} times of {count} in the {name} stage"
            for event, count in stage.planned.items()
            if stage.events.get(event, 0) != count
        ]
    return reasons


def rehearsal_tables(
    stages: Mapping[str, RehearsedStage],
    reached: Mapping[CaptureName, Learned],
    held_out: Mapping[CaptureName, float],
    needs: Sequence[tuple[str, str]],
) -> RenderableType:
    """Scores, events, and the ``needs`` of the run itself, for people.

    ``held_out`` is the PSNR of each capture's held-out images.
    """
    rows = [
        (capture, *map(_in_db, (of.psnr, of.blank, of.rest_pose, held_out.get(capture))))
        for capture, of in reached.items()
    ]
    lengths = [
        (name, f"{stage.iterations:,} of {stage.whole:,}".replace(",", " "))
        for name, stage in stages.items()
    ]
    events = [
        (name, f"{event}: {stage.events.get(event, 0)} of {count}")
        for name, stage in stages.items()
        for event, count in stage.planned.items()
    ]
    heading = ("images", "learned", "one colour", "scene at rest", "held-out images")
    return Group(
        titled_table("what was learned", rows, heading),
        titled_table("iterations", lengths),
        *([titled_table("what took place", events)] if events else []),
        titled_table("what the run itself will need, estimated", needs),
    )


def record(
    stages: Mapping[str, RehearsedStage],
    reached: Mapping[CaptureName, Learned],
    reasons: Sequence[str],
) -> dict[str, Any]:
    """Entries of ``rehearsal.json`` beside scores and provenance."""
    return {
        "stages": {name: asdict(stage) for name, stage in stages.items()},
        "learned": {capture: asdict(of) for capture, of in reached.items()},
        "shortfalls": list(reasons),
    }


def _in_db(value: float | None) -> str:
    return "" if value is None else f"{value:.2f} dB"
