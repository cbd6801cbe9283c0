"""``stage=evaluate``: scores on held-out views."""

from __future__ import annotations

import logging
from pathlib import Path

from devrf.apps.records import (
    data_record,
    frame_rows,
    in_words,
    learning_record,
    mean_scores,
    provenance,
    scores_by_section,
    shown_sections,
    tracked_scores,
    write_frames,
)
from devrf.apps.settings import REHEARSAL
from devrf.checkpoints.file_metadata import digest_of
from devrf.cli.config import choices
from devrf.cli.context import RunContext
from devrf.cli.restore_config import as_typed
from devrf.cli.resume import unfinished
from devrf.errors import DevrfError
from devrf.evaluation.objective import VALIDATION, objective
from devrf.evaluation.scoring import score_held_out
from devrf.pictures.held_out import write_contact_sheet
from devrf.scenes.scene import Views
from devrf.system.files import write_json
from devrf.system.override import to_type

log = logging.getLogger(__name__)


def evaluate(run: RunContext) -> list[Path]:
    """Score the learned scene on held-out views; return the files: metrics and contact sheets.

    Raises:
        DevrfError: the last stage is not finished, and not named by ``ckpt``.
    """
    standing = unfinished(run)
    if standing is not None and run.config.ckpt is None:
        given = to_type("ckpt", run.checkpoint())
        raise DevrfError(f"{standing}, stage=evaluate {given} scores that file as it stands")
    loaded = run.load(scene=run.scene)
    model = loaded.model
    metadata = loaded.metadata
    scene = run.scene
    suite = run.evaluation.suite(run.device)
    # The stage that learns the scene at rest.
    rest = next((step.name for step in run.protocol.steps if step.capture == "static"), None)
    sets: dict[str, Views] = {"static": scene.static.test}
    if model.moves and metadata.stage != rest:
        sets["dynamic"] = scene.dynamic.test
    if run.datamodule.validation and {*sets} == {*scene.captures}:
        if scene.dynamic.validation is None:
            log.info("%s: no validation split; the test views decide the objective", scene.name)
        else:
            sets[VALIDATION] = scene.dynamic.validation
    frames = score_held_out(model, sets, scene.background, suite)
    validated = frames.pop(VALIDATION, [])
    for capture, scored in frames.items():
        sheet = write_contact_sheet(run.folder / "images" / f"{capture}.png", scored)
        for tracker in run.trackers:
            tracker.show_image(f"held_out/{capture}", sheet)
    size = round(run.checkpoint(metadata.stage).stat().st_size / 1e6, 3)
    sections = scores_by_section(frames, scene.clock, metadata, rest, size)
    if validated:
        sections[VALIDATION] = {**mean_scores(validated), "images": len(validated)}
    write_frames(run.folder / "frames.csv", frames)
    protocol = metadata.protocol or run.protocol.name
    head = {"scene": scene.name, "method": model.name, "protocol": protocol}
    without_motion = {} if scene.moves else {"at_rest": True}
    ran = {
        **provenance(model.size, run.device),
        "choices": choices(),
        "overrides": as_typed(run.command),
        "seed": run.config.seed,
        **learning_record(metadata, run.stages_with_images),
        **data_record(scene),
        "lpips_network": run.evaluation.lpips_network,
        "checkpoint": digest_of(run.checkpoint(metadata.stage)),
    }
    ran["wall_seconds"]["evaluate"] = run.step_seconds
    # A report takes metrics.json for the scores of a finished run.
    metrics = "metrics.json" if standing is None else "metrics-unfinished.json"
    metrics = REHEARSAL if run.rehearses else metrics
    write_json(run.folder / metrics, {**head, **without_motion, **sections, "run": ran})
    summary = shown_sections(sections)
    for name, values in summary.items():
        log.info("%s: %s", name.replace("_", " "), in_words(values))
    best = objective(run.config.objective, sections)
    numbers = tracked_scores(sections | summary) | ({} if best is None else {"objective": best})
    for tracker in run.trackers:
        tracker.conclude(numbers)
        tracker.show_table("metrics", [{"section": name, **row} for name, row in summary.items()])
        tracker.show_table("frames", frame_rows(frames))
    written = (metrics, "frames.csv", *(f"images/{capture}.png" for capture in frames))
    return [run.folder / name for name in written]
