"""``stage=evaluate``: scores on held-out views."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from devrf.apps.records import (
    dynamic_scores,
    frame_rows,
    in_words,
    mean_scores,
    provenance,
    write_frames,
)
from devrf.apps.still import write_contact_sheet
from devrf.checkpoints.checkpoint import CheckpointMetadata, TrainingFigures
from devrf.checkpoints.checkpoint_file import digest_of
from devrf.cli.config import choices, overrides
from devrf.cli.context import GIVEN_REST, OWN_REST, RunContext
from devrf.evaluation.held_out import HeldOutView, score_all
from devrf.evaluation.objective import TRAINING
from devrf.evaluation.suite import MetricSuite
from devrf.methods.base import Renderable
from devrf.scenes.scene import CaptureName
from devrf.system.files import write_json

log = logging.getLogger(__name__)

# Held-out images of the dynamic capture at times that a training view has, and at others.
OF_TIMES = ("training_times", "novel_times")
# How iterations were carried out: which kernels and graphs really ran.
EXECUTION = ("kernels", "startup_seconds", "graph_captures", "short_lists", "peak_reserved_gb")


def evaluate(run: RunContext) -> list[Path]:
    """Score what was learned on held-out views; return the files: metrics and contact sheets."""
    loaded = run.load()
    model = loaded.model.to_view(run.device)
    suite = run.evaluation.suite(run.device)

    def training(stage: str) -> TrainingFigures:
        record = loaded.metadata.records.get(stage, {})
        return {name: record.get(name) for name in TRAINING}

    frames: dict[str, list[HeldOutView]] = {"static": _score(run, model, "static", suite)}
    last = loaded.metadata.stage
    # A single stage's training stands in the dynamic section, where there is one.
    rest = next((step.name for step in run.protocol.steps if step.capture == "static"), None)
    moved = model.moves and last != rest
    static: dict[str, Any] = mean_scores(frames["static"])
    sections = {"static": static}
    if rest is not None or not moved:
        sections["static"] = sections[rest or last] = static | training(rest or last)
    if moved:
        frames["dynamic"] = _score(run, model, "dynamic", suite)
        dynamic = dynamic_scores(frames["dynamic"], run.scene.clock) | training(last)
        sections |= {"dynamic": dynamic, **({} if rest is None else {last: dynamic})}
    size = round(run.checkpoint(last).stat().st_size / 1e6, 3)
    sections["dynamic" if moved else "static"]["checkpoint_mb"] = size
    write_frames(run.folder / "frames.csv", frames)
    protocol = loaded.metadata.protocol or run.protocol.name
    head = {"scene": run.scene.name, "method": model.name, "protocol": protocol}
    at_rest = {} if run.scene.moves else {"at_rest": True}
    ran = {**provenance(model.size, run.device), **_origin(run, loaded.metadata)}
    write_json(run.folder / "metrics.json", {**head, **at_rest, **sections, "run": ran})
    _tell(run, sections, frames)
    written = ("metrics.json", "frames.csv", *(f"images/{capture}.png" for capture in frames))
    return [run.folder / name for name in written]


def _tell(
    run: RunContext,
    sections: Mapping[str, Mapping[str, Any]],
    frames: Mapping[str, Sequence[HeldOutView]],
) -> None:
    """Log the scores and give them to the trackers, those of some times as further sections."""
    plain = {
        name: {k: v for k, v in row.items() if k not in OF_TIMES} for name, row in sections.items()
    }
    dynamic = sections.get("dynamic", {})
    of_times = {name: dynamic[name] for name in OF_TIMES if name in dynamic}
    shown = {name: plain[name] for name in frames} | of_times
    scores: dict[str, Any] = {}  # training curves have their names without "test/"
    for section, row in (plain | shown).items():
        scores |= {f"test/{section}/{k}": v for k, v in row.items() if v is not None}
    for name, values in shown.items():
        log.info("%s: %s", name.replace("_", " "), in_words(values))
    for tracker in run.trackers:
        tracker.conclude(scores)
        tracker.show_table("metrics", [{"section": name, **row} for name, row in shown.items()])
        tracker.show_table("frames", frame_rows(frames))


def _origin(run: RunContext, described: CheckpointMetadata) -> dict[str, Any]:
    """Choices, amount of data, and seconds of each step, of the stages as their checkpoints say.

    ``settings`` are those that decided what was learned, by config key, in all stages.
    """
    scene, records = run.scene, described.records
    settings: dict[str, Any] = {}
    for of_stage in (*described.earlier_configs.values(), described.training_config):
        settings |= of_stage
    frames = scene.clock.frames_of(scene.dynamic.train.times)
    stages = {name: records.get(name, {}) for name in run.stages_with_images}
    learned = {name: record.get("wall_seconds") for name, record in stages.items()}
    execution = {n: {key: record.get(key) for key in EXECUTION} for n, record in stages.items()}
    return {
        "choices": choices(),
        "overrides": overrides(),
        "seed": settings.get("seed", run.config.seed),
        "settings": {k: settings[k] for k in sorted(settings) if k not in (OWN_REST, GIVEN_REST)},
        "fingerprint": described.fingerprint,
        "checkpoint": digest_of(run.checkpoint(described.stage)),
        # A camera that moves is one view, however many images it took.
        "train_views": int(frames.bincount().max()) if scene.moves else None,
        "test_frames": len(scene.dynamic.test),
        "wall_seconds": {**learned, "evaluate": run.step_seconds},
        "execution": execution,
    }


def _score(
    run: RunContext, model: Renderable, capture: CaptureName, suite: MetricSuite
) -> list[HeldOutView]:
    """Score a capture's held-out views; the static ones show the rest state at any time."""
    views, background = run.scene.capture(capture).test, run.scene.background
    name, time = f"held-out images, {capture}", 0.0 if capture == "static" else None
    scored = score_all(model, views, background, suite, name, time=time)
    sheet = write_contact_sheet(run.folder / "images" / f"{capture}.png", scored)
    for tracker in run.trackers:
        tracker.show_image(f"held_out/{capture}", sheet)
    return scored
