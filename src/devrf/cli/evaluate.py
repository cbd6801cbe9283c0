"""``stage=evaluate``: scores on held-out views."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from torch import Tensor

from devrf.apps.benchmarks import followed
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
from devrf.apps.render import Video
from devrf.apps.settings import REHEARSAL
from devrf.apps.video import VideoSettings, held_out_images, held_out_pictures
from devrf.checkpoints.file_metadata import digest_of
from devrf.cli.config import choices, foreign_program, overrides
from devrf.cli.context import RunContext
from devrf.cli.render import write_video
from devrf.cli.restore_config import as_typed
from devrf.cli.resume import unfinished
from devrf.errors import DevrfError
from devrf.evaluation.held_out import HeldOutView
from devrf.evaluation.motion import mostly_lost, pck_t, with_motion_masks
from devrf.evaluation.objective import VALIDATION, objective
from devrf.evaluation.predictions import picture_name, read_predictions
from devrf.evaluation.scoring import score_held_out, score_pictures
from devrf.geometry.cameras import Cameras
from devrf.pictures.held_out import write_contact_sheet
from devrf.pictures.images import scaled, write_image
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views
from devrf.system.files import UNREADABLE, read_record, write_json
from devrf.system.override import to_type

log = logging.getLogger(__name__)


def evaluate(run: RunContext) -> None:
    """Score the learned scene on held-out views, or another program's pictures of them.

    Raises:
        DevrfError: the last stage is not finished, and not named by ``ckpt``.
    """
    if run.evaluation.predictions is not None:
        _evaluate_predictions(run)
        return
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
    rest = next((stage.name for stage in run.protocol.order if stage.capture == "static"), None)
    sets: dict[str, Views] = {"static": scene.static.test}
    if model.moves and metadata.stage != rest:
        sets["dynamic"] = scene.dynamic.test
    if run.datamodule.validation and {*sets} == {*scene.captures}:
        if scene.dynamic.validation is None:
            log.info("%s: no validation split; the test views decide the objective", scene.name)
        else:
            sets[VALIDATION] = scene.dynamic.validation
    sets, rule = _with_motion_masks(run, sets)
    frames = score_held_out(model, sets, scene.background, suite)
    validated = frames.pop(VALIDATION, [])
    _write_scores(run, frames, sets)
    size = round(run.checkpoint(metadata.stage).stat().st_size / 1e6, 3)
    sections = scores_by_section(frames, scene.clock, metadata, rest, size)
    if "dynamic" in sets:
        sections["dynamic"]["pck_t"] = pck_t(Renderer(model), scene.dynamic)
    if validated:
        sections[VALIDATION] = {**mean_scores(validated), "images": len(validated)}
    head = {"method": model.name, "protocol": metadata.protocol or run.protocol.name}
    ran = {
        "parameters": model.size,
        "overrides": as_typed(run.command),
        "seed": run.config.seed,
        **learning_record(metadata, run.stages_with_images),
        "motion_masks": rule,
        "checkpoint": digest_of(run.checkpoint(metadata.stage)),
    }
    ran["wall_seconds"]["evaluate"] = run.step_seconds
    # A report takes metrics.json for the scores of a finished run.
    metrics = "metrics.json" if standing is None else "metrics-unfinished.json"
    if run.rehearses:
        metrics = REHEARSAL
        if not run.rehearsed:  # scored once more: what was found when it learned stays
            with suppress(FileNotFoundError, *UNREADABLE):
                head["rehearsal"] = json.loads(read_record(run.folder / metrics))["rehearsal"]
    _write_record(run, metrics, head | sections, ran)
    summary = shown_sections(sections)
    for name, values in summary.items():
        log.info("%s: %s", name.replace("_", " "), in_words(values))
    complaint = mostly_lost(sections)
    if complaint is not None and not run.rehearses:  # which says itself what was learned
        log.warning(complaint)
    best = objective(run.config.objective, sections)
    numbers = tracked_scores(sections | summary) | ({} if best is None else {"objective": best})
    for tracker in run.trackers:
        tracker.conclude(numbers)
        tracker.show_table("metrics", [{"section": name, **row} for name, row in summary.items()])
        tracker.show_table("frames", frame_rows(frames))


def _with_motion_masks(
    run: RunContext, sets: Mapping[str, Views]
) -> tuple[dict[str, Views], str | None]:
    """The sets with masks of what moves in the dynamic test views, and the rule of these."""
    views = run.scene.dynamic.test
    if "dynamic" not in sets:
        return dict(sets), None
    given = run.evaluation.motion_masks
    masked, rule = with_motion_masks(views, run.scene.background, given)
    # A set of the same views stays one, since its scores at rest serve both.
    return {name: masked if own is views else own for name, own in sets.items()}, rule


def _write_scores(
    run: RunContext, frames: Mapping[str, Sequence[HeldOutView]], sets: Mapping[str, Views]
) -> None:
    """Write a table of all images, contact sheets, and the pictures if they are asked for."""
    for capture, scored in frames.items():
        for index, view in enumerate(scored if run.evaluation.pictures else ()):
            name = picture_name(sets[capture], index)
            write_image(run.folder / "images" / "held_out" / capture / name, view.prediction)
        sheet = write_contact_sheet(run.folder / "images" / f"{capture}.png", scored)
        for tracker in run.trackers:
            tracker.show_image(f"held_out/{capture}", sheet)
    write_frames(run.folder / "frames.csv", frames)


def _write_record(
    run: RunContext, name: str, scores: Mapping[str, Any], ran: Mapping[str, Any]
) -> None:
    """Write scores with their provenance: of data, LPIPS, and a benchmark that these follow."""
    data = data_record(run.scene)
    network = run.evaluation.lpips_network
    origin = {
        **provenance(run.device),
        "choices": choices(),
        **ran,
        **data,
        "lpips_network": network,
        "benchmark": followed(run.scene, run.datamodule, data, network),
    }
    at_rest = {} if run.scene.moves else {"at_rest": True}
    write_json(run.folder / name, {"scene": run.scene.name, **scores, **at_rest, "run": origin})


def check_pictures_folder(folder: Path) -> None:
    """Check that the scores of another program's pictures would overwrite no learned run's.

    Raises:
        DevrfError: a run has learned in the folder.
    """
    learned = any((folder / "checkpoints").glob("*.ckpt"))
    with suppress(FileNotFoundError, *UNREADABLE):
        learned |= "predictions" not in json.loads(read_record(folder / "metrics.json"))["run"]
    if learned:
        raise DevrfError(
            f"{folder}: of a run that has learned; evaluation.predictions needs a folder of its "
            "own: leave hydra.run.dir out, or give hydra.run.dir=FOLDER"
        )


def _evaluate_predictions(run: RunContext) -> None:
    """Score another program's pictures as a run's are; nothing is learned or loaded."""
    scene = run.scene
    sets: dict[str, Views] = {"static": scene.static.test}
    if scene.moves:
        sets["dynamic"] = scene.dynamic.test
    program = foreign_program(run.config)
    folder = Path(run.config.evaluation.predictions)
    pictures = read_predictions(folder, sets, scene.background)
    suite = run.evaluation.suite(run.device)
    scored, rule = _with_motion_masks(run, {name: sets[name] for name in pictures})
    frames = {
        name: score_pictures(name, picture, scored[name], scene.background, suite)
        for name, picture in pictures.items()
    }
    sections = {name: {**mean_scores(v), "images": len(v)} for name, v in frames.items()}
    _write_scores(run, frames, scored)
    name = f"{program} (pictures)"
    head = {"method": name, "protocol": run.protocol.name}
    given = {"overrides": overrides(), "predictions": str(folder.resolve()), "motion_masks": rule}
    _write_record(run, "metrics.json", head | sections, given)
    for section, values in sections.items():
        log.info("%s, %s: %s", name, section, in_words(values))
    settings: VideoSettings = instantiate(run.config.video)
    last, picture = [*pictures.items()][-1]
    views = sets[last]

    def shown(cameras: Cameras, _time: float, _behind: float, image: int) -> tuple[Tensor, Tensor]:
        camera = cameras.single(image)
        color = scaled(picture(image), camera.height, camera.width)
        return color, torch.ones_like(color)  # nobody knows its depth

    images = held_out_images(views, settings.frames)
    moves = bool((views.times != views.times[0]).any())
    times = views.times[images].tolist()
    film = held_out_pictures(shown, moves, views, images, times, settings, scene.background)
    write_video(run, Video("held_out", settings.fps, settings.frames, film))
