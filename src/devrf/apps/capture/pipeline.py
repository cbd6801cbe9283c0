"""All steps from footage to a scene's folder, each kept and found again."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from devrf.apps.capture.alignment import Timeline, timeline
from devrf.apps.capture.images import Chosen, box_of_motion, common_size, mattes_of, write_frames
from devrf.apps.capture.structure import check_library, checked_model, reconstruct
from devrf.apps.capture.survey import Survey, check_sharp, sharpest, survey
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.scenes.footage import frame_count, is_folder, pictures
from devrf.scenes.formats.nerfstudio import FILE
from devrf.scenes.sparse_model import AROUND, SparseModel, World, normalised
from devrf.scenes.splits import every_nth
from devrf.system.files import write_json
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# Part of every key: a change of a step makes what was kept before foreign.
VERSION = 1


def kept(
    file: Path, source: Any, make: Callable[[], dict[str, Any]], *, files: Path | None = None
) -> dict[str, Any]:
    """What ``make`` returns, or what it returned before from the same source.

    Args:
        file: the JSON file that keeps it.
        source: all that it depends on, as JSON can hold it.
        make: finds it anew.
        files: a folder of files that belong to it; without it, it is found anew.
    """
    key = digest(source)
    if file.is_file() and (files is None or files.is_dir()):
        try:
            found = json.loads(file.read_text())
            if found["key"] == key and isinstance(found["result"], dict):
                log.info("%s: found before", file.stem)
                return dict(found["result"])
        except (ValueError, KeyError, TypeError):
            log.warning("%s: damaged; it is found again", file)
    result = make()
    write_json(file, {"key": key, "result": result})
    return result


def digest(source: Any) -> str:
    """A short hash of something that JSON can hold."""
    text = json.dumps([VERSION, source], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stamp(path: Path) -> list[Any]:
    """What tells one state of a file, or of a folder of files, from another."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found = [(file, file.stat()) for file in files if file.is_file()]
    return [str(path.resolve()), *([f.name, s.st_size, s.st_mtime_ns] for f, s in found)]


# Below the scene's folder.
IMAGES = "images"


@dataclass(frozen=True)
class Shot:
    """One image of the scene.

    Attributes:
        name: of its file, relative to the folder of images.
        pose: (3, 4) camera-to-world, OpenGL axes, world units.
        lens: ``fl_x``, ``cx``, ``k1`` … in pixels of the image.
        time: in [0, 1], 0 at rest.
        held_out: whether it is scored instead of learned from.
    """

    name: str
    pose: Tensor
    lens: dict[str, float]
    time: float
    held_out: bool


def write_scene(
    folder: Path, shots: Sequence[Shot], world: World, model: str, *, cut_out: bool = False
) -> Path:
    """Write ``transforms.json``; the images are there already.

    Args:
        folder: the scene's.
        shots: all images.
        world: where the scene is.
        model: the lenses' camera model.
        cut_out: whether the images have mattes: there is nothing around what they cut out, and
            the reader finds its box.

    Returns:
        The file.
    """
    path = folder / FILE
    bounds: dict[str, Any] = {"space": world.space, "near": world.near, "far": world.far}
    if world.box is not None:
        bounds["box"] = world.box
    if cut_out and world.space == "contracted":
        bounds = {"space": "world"}
    write_json(
        path,
        {
            "camera_model": model,
            "scene_bounds": bounds,
            "frames": [_frame(shot) for shot in shots],
            "train_filenames": [f"{IMAGES}/{one.name}" for one in shots if not one.held_out],
            "test_filenames": [f"{IMAGES}/{one.name}" for one in shots if one.held_out],
        },
    )
    return path


def _frame(shot: Shot) -> dict[str, Any]:
    matrix = [*shot.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return {
        "file_path": f"{IMAGES}/{shot.name}",
        "time": shot.time,
        **shot.lens,
        "transform_matrix": matrix,
    }


# Below the scene's folder: what the steps have found.
WORK = "capture"


def scene_from_footage(settings: CaptureSettings) -> Path:
    """Make a scene of footage, or go on with it.

    Args:
        settings: what was filmed, and how it is to be taken.

    Returns:
        The scene's folder, which ``data=auto`` reads.

    Raises:
        DevrfError: the footage cannot be read, aligned or reconstructed; the line says what to
            do. The folder then has no ``transforms.json``.
    """
    settings.check()
    check_library()
    into, work = _folders(settings)
    views = [] if settings.monocular else [_path(view) for view in settings.views]
    source = settings.views[0] if settings.monocular else settings.static
    assert source is not None  # settings.check has seen to it
    still = _path(source)
    surveys = {path: _surveyed(path, work) for path in (still, *views)}
    for path in views:
        if len(surveys[path].times) < 2 or is_folder(path):
            raise DevrfError(f"{path}: expected a video by a camera that stands still")
    sharp = surveys[still].sharpness
    picked = list(range(len(sharp))) if is_folder(still) else sharpest(sharp, settings.frames)
    check_sharp(still, sharp, picked)
    mattes = _mattes(settings, surveys)
    moving = Chosen(still, "static", tuple(picked), mattes.get(still))
    clock = Timeline((), (), ())
    if views:
        clock = timeline(views, [surveys[v] for v in views], settings.moments, settings.offsets)
    fixed = [
        Chosen(path, f"view{k}", positions, mattes.get(path))
        for k, (path, positions) in enumerate(zip(views, clock.positions, strict=True), 1)
    ]
    filmed = {path: one.size for path, one in surveys.items()}
    size = common_size(filmed, settings.size)
    _written(into, work, [moving, *fixed], size, filmed)
    model = _model(into, work, moving, fixed, settings)
    world = normalised(model, settings.facing)
    if settings.facing == "auto":
        facing = "forward" if world.space == "ndc" else "inward"
        log.info("cameras look %s-facing; capture.facing says otherwise", facing)
    if settings.subtracts:
        world = _around_motion(world, model, into / IMAGES, fixed)
    taken = surveys[still].times if settings.monocular else None
    shots = _shots(model, world, moving, fixed, clock, settings, taken)
    path = write_scene(into, shots, world, settings.camera, cut_out=bool(mattes))
    log.info("%d images written to %s", len(shots), path)
    return into


def _folders(settings: CaptureSettings) -> tuple[Path, Path]:
    assert settings.into is not None  # settings.check has seen to it
    into = _path(settings.into)
    work = into / WORK
    if into.exists() and not work.is_dir() and (not into.is_dir() or any(into.iterdir())):
        raise DevrfError(
            f"{into}: is there already, and not from stage=capture; give capture.into another "
            "folder"
        )
    return into, work


def _path(given: str | Path) -> Path:
    return Path(given).expanduser()


def _surveyed(path: Path, work: Path) -> Survey:
    if not path.exists():
        raise DevrfError(f"{path}: no such video; correct capture.static or capture.views")
    # Before a folder is made: a first frame that cannot be read ends here.
    next(pictures(path))
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DevrfError(
            f"{work}: cannot be made ({error.strerror}); give capture.into another folder"
        ) from None

    def make() -> dict[str, Any]:
        frames = followed(pictures(path), frame_count(path), f"looking at {path.name}")
        return survey(path, frames).plain()

    source = stamp(path)
    return Survey.of(kept(work / f"survey-{_slug(path)}.json", source, make))


def _slug(path: Path) -> str:
    return f"{path.stem}-{digest(str(path.resolve()))[:6]}"


def _mattes(settings: CaptureSettings, surveys: dict[Path, Survey]) -> dict[Path, Path]:
    """The mattes of each footage, or none of any."""
    if settings.mattes is None or settings.subtracts:
        return {}
    folder = _path(settings.mattes)
    return {path: mattes_of(folder, path, len(one.times)) for path, one in surveys.items()}


def _written(
    into: Path,
    work: Path,
    footage: Sequence[Chosen],
    size: tuple[int, int],
    filmed: dict[Path, tuple[int, int]],
) -> None:
    """The images, written anew where anything has changed."""
    images = into / IMAGES
    source = [
        [one.label, stamp(one.path), one.positions, one.mattes and stamp(one.mattes)]
        for one in footage
    ]

    def make() -> dict[str, Any]:
        # What they belong to is no longer whole.
        (into / FILE).unlink(missing_ok=True)
        shutil.rmtree(images, ignore_errors=True)
        for one in footage:
            count = len(set(one.positions))
            written = write_frames(images, one, size, filmed[one.path])
            for _ in followed(written, count, f"images of {one.label}"):
                pass
        return {"size": size}

    kept(work / "images.json", [source, size], make, files=images)


def _model(
    into: Path, work: Path, moving: Chosen, fixed: Sequence[Chosen], settings: CaptureSettings
) -> SparseModel:
    first = {one.names[0]: one.path for one in fixed}
    options = [settings.camera, settings.intrinsics, settings.matching]
    images = [[one.label, stamp(one.path), one.positions] for one in (moving, *fixed)]

    def make() -> dict[str, Any]:
        def say(what: str) -> None:
            log.info("structure from motion: %s", what)

        folder = reconstruct(into / IMAGES, work, moving, list(first), settings, say)
        return {"model": folder.name}

    found = kept(work / "structure.json", [images, options, settings.size], make)
    return checked_model(work / "models" / found["model"], moving, first)


def _around_motion(
    world: World, model: SparseModel, images: Path, fixed: Sequence[Chosen]
) -> World:
    """The world with the box of what moves, where it has a box."""
    if world.space != "contracted":
        log.warning(
            "capture.mattes=subtract: a forward-facing scene has no box, it changes nothing"
        )
        return world
    place = {one.name: k for k, one in enumerate(model.images)}
    first = [place[one.names[0]] for one in fixed]
    lenses = [_lens(model, model.images[k].camera) for k in first]
    poses = world.poses[first]
    around = Box.of([-AROUND] * 3, [AROUND] * 3)
    box = box_of_motion(images, [one.names for one in fixed], poses, lenses, around)
    return replace(world, box=(box.low, box.high))


def _shots(
    model: SparseModel,
    world: World,
    moving: Chosen,
    fixed: Sequence[Chosen],
    clock: Timeline,
    settings: CaptureSettings,
    taken: Sequence[float] | None,
) -> list[Shot]:
    """All images with cameras, times and whether they are held out.

    Args:
        model: the structure from motion.
        world: the same, normalised.
        moving: the moving camera's images.
        fixed: those of the fixed views.
        clock: the moments of the fixed views.
        settings: what is held out.
        taken: seconds of the moving camera's frames, if the scene moved before it; else None.
    """
    place = {one.name: k for k, one in enumerate(model.images)}
    lens = [_lens(model, one.camera) for one in model.images]

    def shot(name: str, camera: str, time: float, held_out: bool) -> Shot:
        k = place[camera]
        return Shot(name, world.poses[k], lens[k], time, held_out)

    known = [
        (position, name)
        for position, name in zip(moving.positions, moving.names, strict=True)
        if name in place
    ]
    _, out = every_nth(len(known), settings.holdout)
    first, last = known[0][0], known[-1][0]
    shots = []
    for k, (position, name) in enumerate(known):
        time = 0.0
        if taken is not None:
            time = (taken[position] - taken[first]) / (taken[last] - taken[first])
        shots.append(shot(name, name, time, k in out))
    test = settings.test_view - 1 if settings.test_view > 0 else len(fixed) + settings.test_view
    _, later = every_nth(len(clock.times), settings.holdout) if fixed else ([], [])
    for v, one in enumerate(fixed):
        for k, (name, time) in enumerate(zip(one.names, clock.times, strict=True)):
            held_out = v == test if len(fixed) > 1 else k in later
            shots.append(shot(name, one.names[0], time, held_out))
    return shots


def _lens(model: SparseModel, camera: int) -> dict[str, float]:
    return model.cameras[camera].keys
