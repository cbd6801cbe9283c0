"""Structure from motion: cameras, lenses and sparse points of chosen images, by COLMAP."""

from __future__ import annotations

import importlib
import logging
import shutil
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any

import torch

from devrf.apps.capture.images import Chosen
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.scenes.footage import is_folder
from devrf.scenes.sparse_model import SparseModel, read_model

log = logging.getLogger(__name__)

# An image of a video is compared with so many that follow it, then with some at doubling distances.
NEIGHBOURS = 10
# A camera that turns by more degrees than this between two frames of a video, and so many times the
# median, has been placed wrongly: two places that look alike were taken for one.
MOST_TURN = 45.0
MOST_TURNS = 5.0
# A model of a smaller share of a moving camera's images is not the scene.
LEAST_SHARE = 0.5

_FILM = (
    "film more slowly, with more overlap (neighbouring frames share more than half of what they "
    "show), and with more texture in sight"
)


def check_library() -> None:
    """Refuse to begin where COLMAP's Python package is not installed."""
    if find_spec("pycolmap") is None:
        raise DevrfError(
            'stage=capture: pycolmap is not installed; run pip install "devrf[capture]"'
        )


def pairs(moving: Sequence[str], fixed: Sequence[str], matching: str) -> list[tuple[str, str]]:
    """Which images are compared: all with all, or those near in the moving camera's order.

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

    The moving camera's images and one of each ``fixed`` view, all of the scene at rest, are in the
    folder ``images``. Returns the folder of the largest model.

    Raises:
        DevrfError: nothing could be matched.
    """
    library: Any = importlib.import_module("pycolmap")
    library.logging.minloglevel = 3
    library.set_random_seed(0)
    base = work / "matches.db"
    models = work / "models"
    listed = work / "pairs.txt"
    base.unlink(missing_ok=True)
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir(parents=True)
    names = [*dict.fromkeys([*moving.names, *fixed])]
    log.info("structure from motion: features of %d images", len(names))
    modes = library.CameraMode
    library.extract_features(
        base,
        images,
        names,
        camera_mode=modes.SINGLE if settings.intrinsics == "shared" else modes.PER_FOLDER,
        reader_options=library.ImageReaderOptions(camera_model=settings.camera),
        extraction_options=library.FeatureExtractionOptions(use_gpu=False),
        device=library.Device.cpu,
    )
    compared = pairs(moving.names, [n for n in fixed if n not in moving.names], settings.matching)
    listed.write_text("".join(f"{a} {b}\n" for a, b in compared))
    log.info("structure from motion: matches of %d pairs", len(compared))
    matching = library.FeatureMatchingOptions(use_gpu=False)
    pairing = library.ImportedPairingOptions(match_list_path=str(listed))
    verification = library.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    library.match_image_pairs(base, matching, pairing, verification, device=library.Device.cpu)
    log.info("structure from motion: cameras and points")
    mapping = library.IncrementalPipelineOptions(random_seed=0, min_model_size=3)
    reconstructions = library.incremental_mapping(base, images, models, mapping)
    if not reconstructions:
        raise DevrfError(
            f"{moving.path}: too few matches between its frames to find any camera; {_FILM}"
        )
    best = max(reconstructions, key=lambda number: reconstructions[number].num_reg_images())
    return models / str(best)


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
        raise DevrfError(
            f"{moving.path}: cameras were found for {len(posed)} of {len(moving.names)} frames "
            f"only, the others have too few matches with them; {_FILM}"
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


def _check_turns(model: SparseModel, moving: Chosen, posed: Sequence[str]) -> None:
    place = {image.name: k for k, image in enumerate(model.images)}
    turns = model.poses[[place[name] for name in posed], :, :3]
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
