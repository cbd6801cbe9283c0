"""``transforms*.json``: posed images, as NeRF's Blender scenes and nerfstudio list them.

Keys about the origin of the poses (``applied_transform``, ``applied_scale``) are not read: poses
and images are consistent as they are.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from torch import Tensor

from devrf.geometry.offset import NO_OFFSET, Offset, offset_of, subtracted
from devrf.geometry.poses import from_opencv
from devrf.scenes.files import (
    MOST_IMAGES,
    Name,
    Number,
    Positive,
    Vector3,
    Vector4,
    inside,
    read_json,
)
from devrf.scenes.lens import CameraKeys, Intrinsics, frame_intrinsics, intrinsics_of
from devrf.scenes.masks import Masks
from devrf.scenes.names import ImageFinder, Missing, in_order, present_images
from devrf.scenes.validation import check_poses, scene_error

TIME_TOLERANCE = 1e-6
# Largest difference of the last row of a matrix from 0, 0, 0, 1.
LAST_ROW = 1e-3


def _time(time: float) -> float:
    if not -TIME_TOLERANCE <= time <= 1 + TIME_TOLERANCE:
        raise ValueError(f"{time:g} is outside [0, 1]; rescale the times")
    return min(max(time, 0.0), 1.0)


def _upright(matrix: list[Vector4]) -> list[Vector4]:
    off = (abs(x - whole) for x, whole in zip(matrix[-1], (0, 0, 0, 1), strict=True))
    if len(matrix) == 4 and max(off) > LAST_ROW:
        raise ValueError(
            f"its last row is {', '.join(f'{x:g}' for x in matrix[3])}, expected 0, 0, 0, 1; "
            "correct it, or transpose the matrix if it has them in its last column"
        )
    return matrix


class Frame(CameraKeys):
    """One posed image.

    Attributes:
        file_path: the image, relative to the file's folder, with or without its suffix.
        transform_matrix: 4×4 or 3×4 camera-to-world, OpenGL axes, world units.
        time: in [0, 1]; None where no frame has one.
        mask_path: a grey image, relative to the file's folder.
    """

    file_path: Name
    transform_matrix: Annotated[
        list[Vector4],
        Field(fail_fast=True, min_length=3, max_length=4),
        AfterValidator(_upright),
    ]
    time: Annotated[Number, AfterValidator(_time)] | None = None
    mask_path: Name | None = None


FileNames = Annotated[list[Name], Field(fail_fast=True, max_length=MOST_IMAGES)]


class SceneBounds(BaseModel):
    """A scene's bounds, which devrf writes when it captures a scene; other programs ignore them.

    Attributes:
        space: the space of its fields: ``ndc`` for cameras that face it from one side.
        near: its least distance, world units; for ``ndc`` the near plane's.
        far: its largest distance, world units; None: unknown.
        box: the part that cameras look at, low and high corner, world units; None: unknown.
    """

    model_config = ConfigDict(extra="forbid")

    space: Literal["world", "contracted", "ndc"]
    near: Positive | None = None
    far: Positive | None = None
    box: tuple[Vector3, Vector3] | None = None


class TransformsFile(CameraKeys):
    """The content of a transforms file.

    Attributes:
        frames: the posed images.
        train_filenames: training images, as nerfstudio lists them; None: no list.
        val_filenames: held-out images for the course of a run.
        test_filenames: held-out images for its end.
        scene_bounds: the scene's bounds, if devrf wrote the file.
    """

    frames: Annotated[list[Frame], Field(fail_fast=True, min_length=1, max_length=MOST_IMAGES)]
    train_filenames: FileNames | None = None
    val_filenames: FileNames | None = None
    test_filenames: FileNames | None = None
    scene_bounds: SceneBounds | None = None


@dataclass(frozen=True)
class Transforms:
    """The posed images of one split, in the order of the file.

    Attributes:
        file: the JSON file.
        intrinsics: N, one an image; the same object where images share it.
        images: N existing files inside the scene's folder.
        poses: (N, 3, 4) float32 camera-to-world, OpenGL axes, world units, without ``offset``.
        times: N times in [0, 1], or None when the file gives none.
        masks: N existing files inside the scene's folder, None for an image without one; None if
            masks are not used.
        cut_out: whether pixels that masks leave out are background; else they are ignored.
        downscale: the factor by which the images are yet to be made smaller; None: not chosen yet.
        skipped: number of images of the file that are absent, and left out.
        listed: (M, 3, 4) the poses of all images of the file, absent and held-out ones too, and the
            positions of the N among them; None: they have times, or need none.
        bounds: the scene's bounds in the world of the file, if it states them.
        offset: the offset that is subtracted from positions (:mod:`devrf.geometry.offset`).
    """

    file: Path
    intrinsics: tuple[Intrinsics, ...]
    images: tuple[Path, ...]
    poses: Tensor
    times: tuple[float, ...] | None
    masks: tuple[Path | None, ...] | None = None
    cut_out: bool = False
    downscale: int | None = None
    skipped: int = 0
    listed: tuple[Tensor, tuple[int, ...]] | None = None
    bounds: SceneBounds | None = None
    offset: Offset = NO_OFFSET

    def __getitem__(self, index: Sequence[int]) -> Transforms:
        """The images at the positions ``index``, in that order."""
        return replace(
            self,
            intrinsics=tuple(self.intrinsics[i] for i in index),
            images=tuple(self.images[i] for i in index),
            poses=self.poses[list(index)],
            times=self.times and tuple(self.times[i] for i in index),
            masks=self.masks and tuple(self.masks[i] for i in index),
            listed=self.listed and (self.listed[0], tuple(self.listed[1][i] for i in index)),
        )


@dataclass(frozen=True)
class Shot:
    """An image as a list of another program has it.

    Attributes:
        image: the file, relative to the scene's folder.
        world_to_camera: (3, 4) or (4, 4) float64, OpenCV axes, world units.
        intrinsics: of its camera.
        time: in [0, 1].
        mask: a grey image, relative to the scene's folder, black where the background is.
    """

    image: str
    world_to_camera: Tensor
    intrinsics: Intrinsics
    time: float
    mask: str | None = None


def posed_images(
    file: Path,
    shots: Sequence[Shot],
    finder: ImageFinder,
    missing: Missing,
    offset: Offset | None = None,
) -> Transforms:
    """The images that ``file`` lists as ``shots``; the ``offset`` is their own if it is None.

    DevrfError if an image or a mask is missing, or a pose is no rigid transform.
    """
    root = finder.root
    names = [shot.image for shot in shots]
    present = present_images(names, file, finder, missing, relative_to=root)
    kept = [shots[row] for row in present]
    poses = from_opencv(torch.stack([shot.world_to_camera for shot in kept]))
    check_poses(poses, lambda row: f"{file}: the camera of {kept[row].image}")
    offset = offset_of(poses) if offset is None else offset
    masks = None
    if all(shot.mask is not None for shot in kept):
        wanted = [str(shot.mask) for shot in kept]
        found = present_images(wanted, file, finder, "error", relative_to=root, once=False)
        masks = tuple(found.values())
    return Transforms(
        file,
        tuple(shot.intrinsics for shot in kept),
        tuple(present.values()),
        subtracted(poses, offset).float(),
        tuple(shot.time for shot in kept),
        masks,
        cut_out=masks is not None,
        skipped=len(shots) - len(kept),
        offset=offset,
    )


class TransformsFiles:
    """The transforms files of one scene, all with the offset of the first."""

    def __init__(self, root: Path, missing: Missing, masks: Masks = "none") -> None:
        """Choose how to read them.

        Args:
            root: the scene's folder.
            missing: as for :func:`devrf.scenes.names.present_images`.
            masks: the meaning of the images of ``mask_path``; ``none``: they are not read.
        """
        self._missing = missing
        self._masks = masks
        self._finder = ImageFinder(root)
        what = "every capture needs its posed images"
        self._listing = cache(lambda file: read_json(file, TransformsFile, what))
        self._offset: Offset | None = None

    def read(
        self, file: Path, *, times_by_order: bool = False
    ) -> tuple[TransformsFile, Transforms]:
        """The content of a file, and its posed images.

        ``times_by_order``: times are spread evenly over the images in the order of their names,
        whatever the file says of times.

        Raises:
            DevrfError: the file or an image is missing, a value is wrong (NaN, a time outside
                [0, 1], a negative focal length …), a pose is no rigid transform, or only some
                frames have a time.
        """
        listing = self._listing(file)
        matrices = [frame.transform_matrix[:3] for frame in listing.frames]
        poses = torch.tensor(matrices, dtype=torch.float64)
        check_poses(poses, lambda index: f"{file}: frames[{index}]: transform_matrix")
        names = [frame.file_path for frame in listing.frames]
        images = present_images(names, file, self._finder, self._missing)
        every_pose, poses = poses, poses[[*images]]
        frames = [listing.frames[index] for index in images]
        where = [f"{file}: frames[{index}]" for index in images]
        times = [frame.time for frame in frames]
        if times_by_order:
            ordered = in_order(names, name=str, where=file)  # absent images keep their times
            moments = {name: k / max(len(ordered) - 1, 1) for k, name in enumerate(ordered)}
            times = [moments[frame.file_path] for frame in frames]
        stated = [t for t in times if t is not None]
        if stated and len(stated) < len(times):
            raise scene_error(
                where[times.index(None)],
                'has no "time" although others have; give every frame its time, or none',
            )
        self._offset = offset_of(poses) if self._offset is None else self._offset
        lenses = [frame_intrinsics(listing, f, at) for f, at in zip(frames, where, strict=True)]
        shared = cache(lambda: intrinsics_of(listing, file))  # only if it is needed
        masked = self._masks != "none"
        transforms = Transforms(
            file,
            tuple(own or shared() for own in lenses),
            tuple(images.values()),
            subtracted(poses, self._offset).float(),
            tuple(stated) or None,
            tuple(self._mask(frame.mask_path, file) for frame in frames) if masked else None,
            cut_out=self._masks == "alpha",
            skipped=len(listing.frames) - len(frames),
            listed=None if stated else (subtracted(every_pose, self._offset).float(), (*images,)),
            bounds=listing.scene_bounds,
            offset=self._offset,
        )
        return listing, transforms

    def find(self, name: str, file: Path) -> Path | None:
        """The image that ``name`` in a file means; None: there is none."""
        return self._finder.find(inside(self._finder.root, file.parent, name, file))

    def any_image(self, file: Path) -> bool:
        """Whether the file exists, and any of its images does."""
        if not os.path.isfile(file):
            return False
        return any(self.find(frame.file_path, file) for frame in self._listing(file).frames)

    def _mask(self, name: str | None, file: Path) -> Path | None:
        mask = None if name is None else self.find(name, file)
        if name is not None and mask is None:
            path = inside(self._finder.root, file.parent, name, file)
            raise scene_error(path, "no such mask; correct mask_path, or set data.masks=none")
        return mask
