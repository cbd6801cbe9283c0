"""DyCheck's captures: Nerfies' layout with split lists and covisibility masks."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
import torch
from pydantic import BaseModel, Field, RootModel
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.scenes.files import Ids, Number, Numbers, inside, read_json, scene_folder
from devrf.scenes.formats.nerfies import Camera, ItemsReader, Listed
from devrf.scenes.image_folders import Downscale, ImageFolder
from devrf.scenes.names import ImageFinder
from devrf.scenes.scene import Scene, Views
from devrf.scenes.splits import parted
from devrf.scenes.validation import scene_error
from devrf.system.options import abbreviated

log = logging.getLogger(__name__)

SPLITS = "splits"
COVISIBLE = "covisible"
TRAIN = f"{SPLITS}/train.json"
VAL = f"{SPLITS}/val.json"


class _Split(BaseModel):
    """``splits/<name>.json``: K images and their times, on some scale."""

    frame_names: Ids
    time_ids: Annotated[list[Number], Field(fail_fast=True)]


# ``keypoint/<n>x/train/<name>.json``: x, y in pixels of images n times smaller, and 1 if visible.
_Keypoints = RootModel[Annotated[list[tuple[Number, Number, Number]], Field(max_length=1000)]]


@dataclass(frozen=True, kw_only=True)
class DycheckReader(ItemsReader):
    """Reads ``splits/train.json``, ``splits/val.json``, ``scene.json``, ``camera/``, ``rgb/<n>x/``.

    One moving camera takes the training images, others are held out. Times are the ``time_ids`` of
    the splits, brought to [0, 1]. Key points come from ``keypoint/``, if it is there; depth is not
    read.

    Attributes:
        masks: ``ignore``: only pixels in the masks of ``covisible/``, which enough training images
            show, are scored; ``none``: all pixels of held-out images are.
    """

    listing: ClassVar[str] = SPLITS

    downscale: Downscale = "up_to_2"
    masks: Literal["ignore", "none"] = "ignore"

    def listed(self, folder: Path) -> Listed:
        """The images in both splits."""
        learned = _read_split(folder / TRAIN)
        held_out = _read_split(folder / VAL)
        both = [name for name in learned if name in held_out]
        if both:
            raise scene_error(
                folder / VAL,
                f"lists {abbreviated(both[0])}, as {TRAIN} does; list it in one of them",
            )
        if not held_out:
            log.info("%s lists no image: one of %d training images is held out", VAL, self.holdout)
        items = [*learned, *held_out]
        positions = range(len(items))
        first = len(learned)
        file = folder / TRAIN
        return items, *parted(positions[:first], positions[first:], self.holdout, file)

    def moments(self, folder: Path, ids: Sequence[str]) -> Sequence[float]:
        """The times in both splits."""
        times = {**_read_split(folder / TRAIN), **_read_split(folder / VAL)}
        return [times[item] for item in ids]

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        scene = super().read()
        keypoints = _read_keypoints(scene_folder(self.root), scene.dynamic.train)
        return replace(scene, dynamic=replace(scene.dynamic, keypoints=keypoints))

    def masks_of(
        self, folder: Path, ids: Sequence[str], images: ImageFolder
    ) -> tuple[Path | None, ...] | None:
        """The mask of each image that has one: at the size of the images, or at full size."""
        if self.masks == "none":
            return None
        for size in (images.path.name, "1x"):
            masks = Path(COVISIBLE, size, "val")
            if os.path.isdir(folder / masks):
                files = (inside(folder, folder, f"{masks}/{item}", folder / SPLITS) for item in ids)
                return tuple(map(ImageFinder(folder).find, files))
        return (None,) * len(ids)


def _read_keypoints(folder: Path, views: Views) -> Tensor | None:
    """The key points (N, K, 3) of training ``views``, as of a capture; None: the scene has none.

    DevrfError if files have different numbers of them.
    """
    found: dict[int, Tensor] = {}
    factors = [n for n in (1, 2, 4, 8) if os.path.isdir(folder / f"keypoint/{n}x/train")]
    for image, name in enumerate(views.names if factors else ()):
        item = Path(name).stem
        place = folder / f"keypoint/{factors[0]}x/train"
        file = inside(folder, place, f"{item}.json", folder / TRAIN)
        if not os.path.isfile(file):
            continue
        points = np.reshape(read_json(file, _Keypoints, "it has key points").root, (-1, 3))
        camera = read_json(folder / "camera" / f"{item}.json", Camera, "add it")
        cameras = views.cameras.single(image)
        pixels = _directions(camera, factors[0] * points[:, :2]) * cameras.focal + cameras.center
        seen = torch.from_numpy(points[:, 2:])
        found[image] = torch.cat([pixels / cameras.extents, seen], dim=1).float()
        if len(points) != len(next(iter(found.values()))):
            raise scene_error(file, f"{len(points)} key points, but others have another number")
    if not found:
        return None
    keypoints = torch.zeros(len(views), *next(iter(found.values())).shape)
    keypoints[list(found)] = torch.stack([*found.values()])
    return keypoints


def _directions(camera: Camera, pixels: Numbers) -> Tensor:
    """(K, 2) float64: x/z and y/z, y down, of ``pixels`` (K, 2) of the full image, undistorted."""
    focal, (cx, cy) = camera.focal_length, camera.principal_point
    rows = [[focal, camera.skew, cx], [0, focal * camera.pixel_aspect_ratio, cy], [0, 0, 1]]
    lens = np.array(rows, np.float64)
    bent = np.linalg.solve(lens, np.pad(pixels, ((0, 0), (0, 1)), constant_values=1).T)[:2].T
    k1, k2, k3 = camera.radial_distortion
    distortion = np.array([k1, k2, *camera.tangential_distortion, k3])
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    straight = cv2.undistortPoints(bent[:, None], np.eye(3), distortion, criteria=until)
    return torch.from_numpy(np.reshape(straight, (-1, 2)))


def _read_split(file: Path) -> dict[str, float]:
    """The time of each image, by its name."""
    split = read_json(file, _Split, "it lists images and their times; add it")
    if len(split.frame_names) != len(split.time_ids):
        raise scene_error(
            file,
            f"{len(split.frame_names)} frame_names, but {len(split.time_ids)} time_ids; correct it",
        )
    return dict(zip(split.frame_names, split.time_ids, strict=True))
