"""Structure from motion: cameras, lenses and sparse points of chosen images, by COLMAP."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path

import cv2
import numpy as np
import torch

from devrf.apps.capture.images import Chosen, Mask, motion_masks
from devrf.apps.capture.movers import MonocularVideo
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.scenes.footage import is_folder
from devrf.scenes.sparse_model import SparseModel, colmap, read_model

log = logging.getLogger(__name__)

# An image of a video is compared with so many that follow it, then with some at doubling distances.
NEIGHBOURS = 10
# A camera that turns by more degrees than this between two frames of a video, and so many times the
# median, has been placed wrongly: two places that look alike were taken for one.
MOST_TURN = 45.0
MOST_TURNS = 5.0
# A model of a smaller share of a moving camera's images is not the scene.
LEAST_SHARE = 2 / 3
# A model without moving pixels is taken if it places so large a share of the images that the first
# one places.
FEWER = 0.9
# Cameras are found so often without moving pixels, at most, and until their masks change by less
# than this share of the pixels: a first pass may follow a moving thing for a while.
ROUNDS = 3
STEADY = 0.05
# Errors of static pixels up to so many times the least are as good.
ABOUT = 1.05
# If so large a share of the pairs of images shows no depth, that is why no cameras are found.
DEPTHLESS = 0.9
# In the folder of the work: features with their matches, and the models.
DATA_BASE = "matches.db"
MODELS = "models"

_ADVICE = (
    "film more slowly, with more overlap (neighbouring frames share more than half of what they "
    "show), and with more texture in sight"
)
_FLAT = (
    "its frames show no depth: the camera stood still or only turned, or saw one flat thing; walk "
    "past what you film, or half round it"
)


def pairs(moving: Sequence[str], fixed: Sequence[str], matching: str) -> list[tuple[str, str]]:
    """Pairs of images to compare: all with all, or those near in the moving camera's order.

    Images of the ``fixed`` views are compared with all.
    """
    if matching == "exhaustive":
        return list(combinations([*moving, *fixed], 2))
    steps = [*range(1, NEIGHBOURS + 1)]
    while steps[-1] < len(moving):
        steps.append(2 * steps[-1])
    near = [(a, moving[k + n]) for k, a in enumerate(moving) for n in steps if k + n < len(moving)]
    return near + [(a, b) for a in moving for b in fixed] + list(combinations(fixed, 2))


def reconstruct(
    images: Path, work: Path, moving: Chosen, fixed: Sequence[str], settings: CaptureSettings
) -> Path:
    """Run structure from motion, and write the data base and the models to ``work``.

    The moving camera's images and one of each ``fixed`` view are in the folder ``images``. If they
    are all of the scene at rest, COLMAP's incremental mapper finds the cameras. If one camera films
    a scene that moves, cameras are found again without moving pixels (:func:`_without_movers`); if
    masks are given, or nothing moves, the global mapper is tried, too. Returns the folder of the
    model, below ``work``.

    Raises:
        DevrfError: nothing could be matched, nothing shows depth, or a given mask does not fit.
    """
    library = colmap()
    library.set_random_seed(0)
    models = work / MODELS
    shutil.rmtree(models, ignore_errors=True)
    given = {} if moving.motion is None else motion_masks(images, moving)
    _match(images, work, moving, fixed, settings, given)
    first = _mapped(images, work, "incremental", models / "first")
    flat = _shows_no_depth(work / DATA_BASE)
    if first is None:
        why = f"too few matches between its frames to find any camera; {_ADVICE}"
        raise DevrfError(f"{moving.path}: {_FLAT if flat else why}")
    if not settings.monocular:
        return first.folder
    best = None if given else _without_movers(images, work, moving, settings, first)
    if best is None:
        best = _largest([first, _mapped(images, work, "global", models / "global")])
    if flat and best.images < LEAST_SHARE * len(moving.names):
        raise DevrfError(f"{moving.path}: {_FLAT}")
    log.info("structure from motion: the %s mapper's cameras are taken", best.mapper)
    return best.folder


def _without_movers(
    images: Path, work: Path, moving: Chosen, settings: CaptureSettings, first: _Mapped
) -> _Mapped | None:
    """The cameras with the least epipolar error of static pixels; None if nothing moves.

    The ``first`` cameras and the video's flow give masks of moving pixels. Without these cameras
    are found again, by both of COLMAP's mappers, and give better masks: until masks stay as they
    are, at most ``ROUNDS`` times.
    """
    folder = work / MODELS
    video = MonocularVideo(images, moving.names)
    models = [first]
    used = list[dict[str, Mask]]()
    masks = dict[str, Mask]()
    for number in range(1, ROUNDS + 1):
        movers = video.motion_masks(read_model(models[-1].folder))
        if not movers or (masks and _difference(movers, masks) < STEADY):
            break
        masks = masks | movers  # an image that is not placed keeps the mask that it had
        log.info("structure from motion: again, without moving pixels (%d)", number)
        _match(images, work, moving, (), settings, masks)
        tried = [
            _mapped(images, work, mapper, folder / f"{mapper}-{number}")
            for mapper in ("incremental", "global")
        ]
        # If masks leave too little, cameras are those of whole images.
        placed = [model for model in tried if model and model.images >= FEWER * first.images]
        if not placed:
            break
        models.append(_largest(placed))
        used.append(masks)
    if not masks:
        return None
    return _most_consistent(video, models, used) if used else first


def _most_consistent(
    video: MonocularVideo, mapped: Sequence[_Mapped], masks: Sequence[dict[str, Mask]]
) -> _Mapped:
    """The model with the least epipolar error where nothing moves by any of the ``masks``.

    Models are compared in the images that all of them place; those that place far fewer than
    another are out. Among models about as good the largest is taken; the first, if the masks
    together leave nothing.
    """
    most = max(model.images for model in mapped)
    mapped = [model for model in mapped if model.images >= FEWER * most]
    if len(mapped) == 1:
        return mapped[0]
    models = [read_model(model.folder) for model in mapped]
    names = set.intersection(*({image.name for image in model.images} for model in models))
    static = {
        name: np.minimum.reduce([each[name] for each in masks if name in each])
        for name in sorted(names & {*masks[-1]})  # the last ones have all that were before
    }
    errors = [video.static_error(model, static) for model in models]
    said = ", then ".join(f"{error:.2f}" for error in errors)
    log.info(
        "structure from motion: median epipolar error of static pixels per reconstruction: %s px",
        said,
    )
    if min(errors) == float("inf"):
        return mapped[0]
    return _largest(
        [model for model, error in zip(mapped, errors, strict=True) if error <= ABOUT * min(errors)]
    )


def _largest(models: Sequence[_Mapped | None]) -> _Mapped:
    """The model with the most images; ties by reprojection error."""
    successes = [model for model in models if model]
    return max(successes, key=lambda model: (model.images, -model.error))


def _difference(masks: dict[str, Mask], before: dict[str, Mask]) -> float:
    """The share of the pixels that masks cover now and did not before, or the other way round.

    An image that had no mask was covered nowhere.
    """
    changed = [
        float((mask != before[name] if name in before else mask == 0).mean())
        for name, mask in masks.items()
    ]
    return sum(changed) / max(len(changed), 1)


@dataclass(frozen=True)
class _Mapped:
    """The largest model that a mapper has found.

    Attributes:
        mapper: ``incremental`` or ``global``.
        folder: of its files.
        images: the number of images that it places.
        error: mean reprojection error of its points, pixels.
    """

    mapper: str
    folder: Path
    images: int
    error: float


def _match(
    images: Path,
    work: Path,
    moving: Chosen,
    fixed: Sequence[str],
    settings: CaptureSettings,
    masks: dict[str, Mask],
) -> None:
    """Write a new data base of features, none of them where masks are 0, and their matches."""
    library = colmap()
    base = work / DATA_BASE
    base.unlink(missing_ok=True)
    reading = library.ImageReaderOptions(camera_model=settings.camera)
    if masks:
        reading.mask_path = _written(masks, work / "masks")
    names = [*dict.fromkeys([*moving.names, *fixed])]
    log.info("structure from motion: features of %d images", len(names))
    modes = library.CameraMode
    library.extract_features(
        base,
        images,
        names,
        camera_mode=modes.SINGLE if settings.intrinsics == "shared" else modes.PER_FOLDER,
        reader_options=reading,
        extraction_options=library.FeatureExtractionOptions(use_gpu=False),
        device=library.Device.cpu,
    )
    compared = pairs(moving.names, [n for n in fixed if n not in moving.names], settings.matching)
    listed = work / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in compared))
    log.info("structure from motion: matches of %d pairs", len(compared))
    matching = library.FeatureMatchingOptions(use_gpu=False)
    pairing = library.ImportedPairingOptions(match_list_path=str(listed))
    verification = library.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    library.match_image_pairs(base, matching, pairing, verification, device=library.Device.cpu)


def _shows_no_depth(base: Path) -> bool:
    """Whether a plane or a turning camera explains the matches of most pairs in a data base."""
    library = colmap()
    database = library.Database.open(base)
    _, geometries = database.read_two_view_geometries()
    database.close()
    kinds = library.TwoViewGeometryConfiguration
    # COLMAP takes matches that do not move at all for those of a watermark.
    depthless = [kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC, kinds.WATERMARK]
    pairs = [geometry.config for geometry in geometries if len(geometry.inlier_matches)]
    return sum(kind in depthless for kind in pairs) > DEPTHLESS * max(len(pairs), 1)


def _written(masks: dict[str, Mask], folder: Path) -> Path:
    """Masks as files where COLMAP looks for them: ``<folder>/<image>.png``."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, mask in masks.items():
        file = folder / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), mask)
    return folder


def _mapped(images: Path, work: Path, mapper: str, into: Path) -> _Mapped | None:
    """The largest model that a mapper finds in the data base; None if it finds none."""
    library = colmap()
    into.mkdir(parents=True)
    base = work / DATA_BASE
    if mapper == "incremental":
        options = library.IncrementalPipelineOptions(random_seed=0, min_model_size=3)
        models = library.incremental_mapping(base, images, into, options)
    else:
        options = library.GlobalPipelineOptions(random_seed=0, min_model_size=3)
        models = library.global_mapping(base, images, into, options)
    if not models:
        log.info("structure from motion: the %s mapper finds no cameras", mapper)
        return None
    number, model = max(models.items(), key=lambda item: item[1].num_reg_images())
    error = float(model.compute_mean_reprojection_error())
    placed = int(model.num_reg_images())
    log.info(
        "structure from motion: the %s mapper places %d images, reprojection error %.2f px",
        mapper,
        placed,
        error,
    )
    return _Mapped(mapper, into / str(number), placed, error)


def checked_model(folder: Path, moving: Chosen, fixed: dict[str, Path]) -> SparseModel:
    """The model in a folder, if it holds the scene; ``fixed``: each fixed view's video by image.

    Raises:
        DevrfError: too few of the moving camera's images are in it, or a fixed view is not; or
            its cameras jump from frame to frame of a video.
    """
    model = read_model(folder)
    placed = {image.name for image in model.images}
    posed = [name for name in moving.names if name in placed]
    if len(posed) < max(3, LEAST_SHARE * len(moving.names)):
        first, last = _longest_gap(moving.names, placed)
        raise DevrfError(
            f"{moving.path}: cameras were found for {len(posed)} of {len(moving.names)} frames "
            f"only, it broke from {Path(first).stem} to {Path(last).stem}, which have too few "
            f"matches with the others; cut the video there, or {_ADVICE}"
        )
    if len(posed) < len(moving.names):
        log.warning(
            "%s: %d of %d frames could not be placed, and are left out",
            moving.path,
            len(moving.names) - len(posed),
            len(moving.names),
        )
    if not is_folder(moving.path):
        _check_turns(model, moving, posed)
    for name, path in fixed.items():
        if name not in placed:
            raise DevrfError(
                f"{path}: its camera could not be placed among the static frames; let the static "
                "video pass by where that camera stands and look the same way, or leave the view "
                "out of capture.views"
            )
    return model


def _longest_gap(names: Sequence[str], placed: set[str]) -> tuple[str, str]:
    """The first and the last image of the longest stretch that was not placed."""
    runs = [list(run) for is_placed, run in groupby(names, placed.__contains__) if not is_placed]
    longest = max(runs, key=len)
    return longest[0], longest[-1]


def _check_turns(model: SparseModel, moving: Chosen, posed: Sequence[str]) -> None:
    index = {image.name: k for k, image in enumerate(model.images)}
    turns = model.poses[[index[name] for name in posed], :, :3]
    trace = (turns[1:] * turns[:-1]).sum(dim=(1, 2))
    degrees = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())
    worst = int(degrees.argmax())
    turn = float(degrees[worst])
    if turn > max(MOST_TURN, MOST_TURNS * float(degrees.median())):
        raise DevrfError(
            f"{moving.path}: between {Path(posed[worst]).stem} and {Path(posed[worst + 1]).stem}, "
            f"frames that follow one another, its camera seems to turn by {turn:.0f} degrees: "
            "different places look alike; give more frames with capture.frames, or "
            "capture.matching=sequential, or film where there is more texture"
        )
