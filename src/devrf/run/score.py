"""The step that measures: ``stage=evaluate``."""

from __future__ import annotations

import logging
from statistics import mean
from typing import Any

from devrf.artifacts.contact_sheet import write_contact_sheet
from devrf.artifacts.files import write_json
from devrf.artifacts.records import in_words, mean_scores, provenance, write_frames
from devrf.run.context import RunContext
from devrf.scenes.scene import CaptureName
from devrf.stages.checkpoint import Stored
from devrf.stages.evaluation import Judge
from devrf.stages.held_out import HeldOutView, score

log = logging.getLogger(__name__)


def evaluate(run: RunContext) -> None:
    """Score what was learned on held-out views; write metrics and contact sheets."""
    stored = run.load("deformation", "canonical")
    records = stored.passport.records
    judge = run.evaluation.judge(run.device)
    rest = _score(run, stored, "static", judge)
    frames = {"static": rest}
    sections: dict[str, Any] = {
        "scene": run.scene.name,
        "canonical": {**mean_scores(rest), **records.get("canonical", {})},
    }
    if stored.model.deformation is not None:
        moving = frames["dynamic"] = _score(run, stored, "dynamic", judge)
        checkpoint = run.checkpoint("deformation")
        sections["deformation"] = {
            **mean_scores(moving),
            "rest_pose_psnr": round(mean(v.rest_pose_psnr for v in moving), 4),
            **records.get("deformation", {}),
            "checkpoint_mb": round(checkpoint.stat().st_size / 1e6, 3),
        }
    write_frames(run.folder / "frames.csv", frames)
    ran = provenance(stored.model, run.device)
    write_json(run.folder / "metrics.json", {**sections, "run": ran})
    for name, values in sections.items():
        if isinstance(values, dict):
            log.info("%s: %s", name, in_words(values))


def _score(
    run: RunContext, stored: Stored, capture: CaptureName, judge: Judge
) -> list[HeldOutView]:
    views, model = run.scene.capture(capture).test, stored.model.to(run.device)
    if capture == "static":
        model = model.at_rest()
    scored = [
        score(model, views, k, run.scene.background, run.device, judge) for k in range(len(views))
    ]
    write_contact_sheet(run.folder / "images" / f"{capture}.png", scored)
    return scored
