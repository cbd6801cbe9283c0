"""All steps from footage to a scene's folder, each kept and found again."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from devrf.apps.capture.alignment import Timeline, timeline
from devrf.apps.capture.images import (
    Chosen,
    common_size,
    masks_of,
    write_frames,
)
from devrf.apps.capture.structure import MODELS, checked_model, reconstruct
from devrf.apps.capture.survey import Survey, check_sharp, sharpest, survey
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.scenes.files import inside
from devrf.scenes.footage import frame_count, is_folder, pictures
from devrf.scenes.formats.nerfstudio import FILE
from devrf.scenes.sparse_model import (
    LEFT_OUT,
    LEFT_OUT_OF_VIDEO,
    SparseModel,
    colmap,
    ndc_holds,
    normalised,
)
from devrf.scenes.splits import every_nth
from devrf.scenes.transforms import SceneBounds
from devrf.system.files import (
    UNREADABLE,
    read_record,
    refuse_links,
    write_json,
    write_text,
)
from devrf.system.plain_data import Kind, validate
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# Part of every key: a new version makes earlier results invalid.
VERSION = 3
# Folders below the scene's: the results of the steps, and the images.
WORK = "capture"
IMAGES = "images"


def scene_from_footage(settings: CaptureSettings) -> Path:
    """Make a scene of footage, or go on with it; its folder.

    Raises:
        DevrfError: the footage cannot be read, aligned or reconstructed; the line says what to
            do. The folder then has no ``transforms.json``.
    """
    settings.check()
    colmap()
    into, work = _folders(settings)
    views = [] if settings.monocular else [Path(view).expanduser() for view in settings.views]
    source = settings.views[0] if settings.monocular else settings.static
    assert source is not None  # settings.check has seen to it
    static = Path(source).expanduser()
    surveys = {path: _surveyed(path, work) for path in (static, *views)}
    for path in views:
        if len(surveys[path].times) < 2 or is_folder(path):
            raise DevrfError(f"{path}: expected a video by a camera that stands still")
    sharp = surveys[static].sharpness
    picked = list(range(len(sharp))) if is_folder(static) else sharpest(sharp, settings.frames)
    check_sharp(static, sharp, picked)
    masks: dict[Path, Path] = {}
    if settings.alpha_masks is not None:
        folder = Path(settings.alpha_masks).expanduser()
        masks = {
            path: masks_of(folder, path, len(s.times), others=surveys)
            for path, s in surveys.items()
        }
    motion_masks = None
    if settings.masks is not None:
        folder = Path(settings.masks).expanduser()
        motion_masks = masks_of(folder, static, len(sharp), "capture.masks", surveys)
    moving = Chosen(static, "static", tuple(picked), masks.get(static), motion_masks)
    clock = Timeline((), ())
    if views:
        in_view = [surveys[view] for view in views]
        clock = timeline(views, in_view, settings.max_timesteps, settings.offsets)
    fixed = [
        Chosen(path, f"view{k}", positions, masks.get(path))
        for k, (path, positions) in enumerate(zip(views, clock.positions, strict=True), 1)
    ]
    filmed = {path: survey.size for path, survey in surveys.items()}
    _write_images(into, work, [moving, *fixed], common_size(filmed, settings.size), filmed)
    model = _model(into, work, moving, fixed, settings)
    facing = settings.facing
    if facing == "auto" and settings.monocular:
        facing = "forward" if ndc_holds(model) else "inward"
    left_out = LEFT_OUT_OF_VIDEO if settings.monocular else LEFT_OUT
    poses, bounds = normalised(model, facing, left_out=left_out)
    if settings.facing == "auto":
        facing = "forward" if bounds.space == "ndc" else "inward"
        log.info("cameras look %s-facing; capture.facing says otherwise", facing)
    frame_seconds = surveys[static].times if settings.monocular else None
    frames, test = _frames(model, poses, moving, fixed, clock, settings, frame_seconds)
    names = [frame["file_path"] for frame in frames]
    if masks and bounds.space == "contracted":
        # There is nothing around what is cut out, and the reader finds its box.
        bounds = SceneBounds(space="world")
    content = {
        "camera_model": settings.camera,
        "scene_bounds": bounds.model_dump(exclude_none=True),
        "frames": frames,
        "train_filenames": [name for name in names if name not in test],
        "test_filenames": [name for name in names if name in test],
    }
    write_json(into / FILE, content)
    log.info("%d images written to %s", len(frames), into / FILE)
    return into


def kept(file: Path, source: Any, kind: type[Kind], make: Callable[[], dict[str, Any]]) -> Kind:
    """The ``kind`` that ``make`` returns the entries of.

    It is read from the JSON ``file`` if that was made from the same source.

    Raises:
        DevrfError: the file is damaged.
    """
    key = _digest(source)
    if file.is_file():
        try:
            stored = json.loads(read_record(file))
            same, result = stored["key"] == key, stored["result"]
            if same:
                stored = validate(kind, result)
                log.info("%s: found before", file.stem)
                return stored
        except UNREADABLE:
            raise DevrfError(f"{file}: damaged; remove it, and it is made again") from None
    result = make()
    write_text(file, json.dumps({"key": key, "result": result}))
    return validate(kind, result)


def _digest(source: Any) -> str:
    """A short hash of something that JSON can hold."""
    text = json.dumps([VERSION, source], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _stamp(path: Path) -> list[Any]:
    """A stamp that differs between two states of a file, or of a folder of files."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    states = [(file.name, file.stat()) for file in files if file.is_file()]
    return [str(path.resolve()), *([name, s.st_size, s.st_mtime_ns] for name, s in states)]


def _folders(settings: CaptureSettings) -> tuple[Path, Path]:
    assert settings.into is not None  # settings.check has seen to it
    into = Path(settings.into).expanduser()
    work = into / WORK
    if into.exists() and not work.is_dir() and (not into.is_dir() or any(into.iterdir())):
        raise DevrfError(
            f"{into}: is there already, and not from stage=capture; give capture.into another "
            "folder"
        )
    refuse_links(into)
    return into, work


def _surveyed(path: Path, work: Path) -> Survey:
    if not path.exists():
        raise DevrfError(f"{path}: no such video; correct capture.static or capture.views")
    # Before a folder is made: a first frame that cannot be read ends here.
    next(pictures(path))
    work.mkdir(parents=True, exist_ok=True)

    def make() -> dict[str, Any]:
        frames = followed(pictures(path), frame_count(path), f"looking at {path.name}")
        return asdict(survey(path, frames))

    slug = f"{path.stem}-{_digest(str(path.resolve()))[:6]}"
    return kept(work / f"survey-{slug}.json", _stamp(path), Survey, make)


def _write_images(
    into: Path,
    work: Path,
    footage: Sequence[Chosen],
    size: tuple[int, int],
    filmed: dict[Path, tuple[int, int]],
) -> None:
    """The images, written again where anything has changed."""
    images = into / IMAGES
    file = work / "images.json"
    source = [
        [video.label, _stamp(video.path), video.positions, video.masks and _stamp(video.masks)]
        for video in footage
    ]

    def make() -> dict[str, Any]:
        # The scene that they belong to is no longer complete.
        (into / FILE).unlink(missing_ok=True)
        shutil.rmtree(images, ignore_errors=True)
        for video in footage:
            written = write_frames(images, video, size, filmed[video.path])
            for _ in followed(written, len(set(video.positions)), f"images of {video.label}"):
                pass
        return {"size": size}

    if not images.is_dir():
        file.unlink(missing_ok=True)
    kept(file, [source, size], dict[str, Any], make)


def _model(
    into: Path, work: Path, moving: Chosen, fixed: Sequence[Chosen], settings: CaptureSettings
) -> SparseModel:
    first = {video.names[0]: video.path for video in fixed}
    options = [settings.camera, settings.intrinsics, settings.matching, settings.monocular]
    images = [
        [video.label, _stamp(video.path), video.positions, video.motion and _stamp(video.motion)]
        for video in (moving, *fixed)
    ]

    def make() -> dict[str, Any]:
        model = reconstruct(into / IMAGES, work, moving, list(first), settings)
        return {"model": model.relative_to(work / MODELS).as_posix()}

    file = work / "structure.json"
    name = kept(file, [images, options, settings.size], dict[Literal["model"], str], make)["model"]
    return checked_model(inside(work / MODELS, work / MODELS, name, file), moving, first)


def _frames(
    model: SparseModel,
    poses: Tensor,
    moving: Chosen,
    fixed: Sequence[Chosen],
    clock: Timeline,
    settings: CaptureSettings,
    frame_seconds: Sequence[float] | None,
) -> tuple[list[dict[str, Any]], set[str]]:
    """All images with cameras and times, as nerfstudio's file has them; which are held out.

    ``frame_seconds`` are the times of the moving camera's frames, if the scene moved before it.
    """
    index = {image.name: k for k, image in enumerate(model.images)}
    frames = list[dict[str, Any]]()
    test = set[str]()

    def add(name: str, camera: str, time: float, held_out: bool) -> None:
        k = index[camera]
        path = f"{IMAGES}/{name}"
        lens = model.cameras[model.images[k].camera]
        pose = [*poses[k].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": path, "time": time, **lens, "transform_matrix": pose})
        if held_out:
            test.add(path)

    named = zip(moving.positions, moving.names, strict=True)
    posed = [(position, name) for position, name in named if name in index]
    _, held_out = every_nth(len(posed), settings.holdout)
    first = posed[0][0]
    last = posed[-1][0]
    for k, (position, name) in enumerate(posed):
        time = 0.0
        if frame_seconds is not None:
            duration = frame_seconds[last] - frame_seconds[first]
            time = (frame_seconds[position] - frame_seconds[first]) / duration
        add(name, name, time, k in held_out)
    test_view = settings.test_view - (settings.test_view > 0)
    held_out = every_nth(len(clock.times), settings.holdout)[1] if fixed else []
    for v, video in enumerate(fixed):
        for k, (name, time) in enumerate(zip(video.names, clock.times, strict=True)):
            is_test = v == test_view % len(fixed) if len(fixed) > 1 else k in held_out
            add(name, video.names[0], time, is_test)
    return frames, test
