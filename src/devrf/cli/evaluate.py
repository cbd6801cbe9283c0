"""The step that measures: ``stage=evaluate``."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from devrf.artifacts.contact_sheet import write_contact_sheet
from devrf.artifacts.records import (
    frame_rows,
    in_words,
    mean_scores,
    provenance,
    write_frames,
)
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli import job
from devrf.cli.context import RunContext
from devrf.evaluation.held_out import HeldOutView, score
from devrf.evaluation.suite import MetricSuite
from devrf.methods.devrf.renderer import Renderer
from devrf.scenes.scene import CaptureName
from devrf.system.files import write_json

log = logging.getLogger(__name__)

# What a checkpoint knows of its training that stands beside the scores.
TRAINING = ("seconds", "iterations", "iterations_per_second", "peak_gpu_gb", "num_rollbacks")


def evaluate(run: RunContext) -> None:
    """Score what was learned on held-out views; write metrics and contact sheets."""
    stored = run.load("deformation", "canonical")
    records = stored.metadata.records
    judge = run.evaluation.judge(run.device)
    rest = _score(run, stored, "static", judge)
    frames = {"static": rest}
    sections: dict[str, Any] = {
        "scene": run.scene.name,
        "canonical": {**mean_scores(rest), **_training(records, "canonical")},
    }
    if stored.model.deformation is not None:
        moving = frames["dynamic"] = _score(run, stored, "dynamic", judge)
        checkpoint = run.checkpoint("deformation")
        sections["deformation"] = {
            **mean_scores(moving),
            "rest_pose_psnr": round(mean(v.rest_pose_psnr for v in moving), 4),
            **_training(records, "deformation"),
            "checkpoint_mb": round(checkpoint.stat().st_size / 1e6, 3),
        }
    write_frames(run.folder / "frames.csv", frames)
    ran = {**provenance(stored.model, run.device), **_origin(run, records)}
    write_json(run.folder / "metrics.json", {**sections, "run": ran})
    scores = {name: values for name, values in sections.items() if isinstance(values, dict)}
    for name, values in scores.items():
        log.info("%s: %s", name, in_words(values))
    _track(run, scores, frames)


def _track(
    run: RunContext,
    scores: Mapping[str, Mapping[str, float | None]],
    frames: Mapping[str, Sequence[HeldOutView]],
) -> None:
    """Show where the run is tracked what it has come to."""
    for tracker in run.trackers:
        tracker.conclude(
            {
                f"{section}/{name}": value
                for section, values in scores.items()
                for name, value in values.items()
                if value is not None
            }
        )
        tracker.show_table("metrics", [{"stage": name, **row} for name, row in scores.items()])
        tracker.show_table("frames", frame_rows(frames))


Records = Mapping[str, Mapping[str, float | None]]


def _training(records: Records, stage: str) -> dict[str, float | None]:
    return {name: records.get(stage, {}).get(name) for name in TRAINING}


def _origin(run: RunContext, records: Records) -> dict[str, Any]:
    """What was asked for, on how much data, and how long each step took from end to end.

    The steps that learn may have run in other processes: their checkpoints tell (None if they
    do not), measured up to the writing of the checkpoint.
    """
    scene = run.scene
    frames = scene.clock.frames_of(scene.dynamic.train.times)
    learned = {k: records.get(k, {}).get("wall_seconds") for k in ("canonical", "deformation")}
    return {
        "choices": job.choices(),
        "overrides": job.overrides(),
        "seed": run.config.seed,
        # A camera that moves is one view, however many images it took.
        "train_views": int(frames.bincount().max()),
        "test_frames": len(scene.dynamic.test),
        "wall_seconds": {**learned, "evaluate": run.step_seconds},
    }


def _score(
    run: RunContext, stored: LoadedCheckpoint, capture: CaptureName, judge: MetricSuite
) -> list[HeldOutView]:
    views, model = run.scene.capture(capture).test, stored.model.to(run.device)
    if capture == "static":
        model = model.at_rest()
    player = Renderer(model)
    scored = [score(player, views, k, run.scene.background, judge) for k in range(len(views))]
    sheet = write_contact_sheet(run.folder / "images" / f"{capture}.png", scored)
    for tracker in run.trackers:
        tracker.show_image(f"held_out/{capture}", sheet)
    return scored
