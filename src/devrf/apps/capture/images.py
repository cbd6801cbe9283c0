"""Chosen frames of all footage as image files of one size, and their masks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devrf.errors import DevrfError
from devrf.scenes.files import entries
from devrf.scenes.footage import VIDEOS, Picture, frame_count, frames_at, is_folder, pictures
from devrf.scenes.image_folders import listed_images
from devrf.scenes.masks import HALF, WHITE, read_mask, white_in, white_in_files

Size = tuple[int, int]


@dataclass(frozen=True)
class Chosen:
    """The frames of one video that become images.

    Attributes:
        label: the folder of its images: ``static``, ``view1`` …
        positions: positions of its frames, ascending; one may appear twice.
        masks: alpha masks of all its frames; None: the images have no alpha.
        motion: masks of all its frames, black where something moves; None: unknown.
    """

    path: Path
    label: str
    positions: tuple[int, ...]
    masks: Path | None = None
    motion: Path | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The image of each position, relative to the folder of images."""
        return tuple(f"{self.label}/{position:05d}.png" for position in self.positions)


def common_size(sizes: dict[Path, Size], longer: int) -> Size:
    """Width and height of all images: those of the first footage, made smaller if need be.

    Raises:
        DevrfError: some footage is upright, other lies on its side.
    """
    (first, (width, height)), *others = sizes.items()
    for path, (w, h) in others:
        if (w > h) != (width > height):
            raise DevrfError(
                f"{path}: {w}x{h} px, but {first} has {width}x{height} px; hold all cameras the "
                "same way, or turn the video"
            )
    factor = min(1.0, longer / max(width, height))
    return round(width * factor), round(height * factor)


def write_frames(folder: Path, footage: Chosen, size: Size, filmed: Size) -> Iterator[Path]:
    """Write the images of one video, each when it is asked for, from frames of size ``filmed``.

    Frames of other proportions are cropped in the middle; then all are brought to ``size``.

    Raises:
        DevrfError: a frame or a mask cannot be read, or an image cannot be written.
    """
    (folder / footage.label).mkdir(parents=True, exist_ok=True)
    places = dict(zip(footage.positions, footage.names, strict=True))
    wanted = sorted(places)
    masks: Iterator[Mask | None] = repeat(None, len(wanted))
    if footage.masks is not None:
        masks = chosen_masks(footage.masks, footage.path, wanted, filmed)
    for (position, picture), mask in zip(frames_at(footage.path, wanted), masks, strict=False):
        path = folder / places[position]
        image = cv2.cvtColor(fitted(picture, size), cv2.COLOR_RGB2BGR)
        if mask is not None:
            image = np.dstack([image, fitted(mask, size)])
        if not cv2.imwrite(str(path), image):
            raise DevrfError(f"{path}: cannot be written; see that there is room, and permission")
        yield path


def fitted(picture: Picture, size: Size) -> Picture:
    """A picture cropped in the middle to the proportions of ``size``, and brought to it."""
    height, width = picture.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    w = min(width, round(size[0] / scale))
    h = min(height, round(size[1] / scale))
    left = (width - w) // 2
    top = (height - h) // 2
    part = picture[top : top + h, left : left + w]
    if (w, h) == size:
        return part
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(part, size, interpolation=way), np.uint8)


# 8-bit grey, (H, W): white is kept, black is background.
Mask = npt.NDArray[np.uint8]


def masks_of(
    folder: Path,
    footage: Path,
    count: int,
    key: str = "capture.alpha_masks",
    others: Iterable[Path] = (),
) -> Path:
    """The masks of some footage: ``<folder>/<its name without suffix>``, a folder or a video.

    ``<folder>/<name of the footage's folder>/<its name without suffix>`` is looked for first.

    Args:
        folder: holds the masks of all footage.
        footage: of photographs the masks are a folder with a file of each one's name; of a video
            a folder of as many images, in the order of their names, or a video of as many frames.
        count: the number of its frames.
        key: the setting that gives ``folder``.
        others: all footage, whose masks these may not be, too.

    Raises:
        DevrfError: there are none, or not of all frames, or they may be those of other footage.
    """
    if not folder.is_dir():
        raise DevrfError(f"{folder}: no such folder of masks; correct {key}, or leave it out")
    nested, plain = _places(folder, footage)
    masks = _masks_at(folder, footage)
    if masks is None:
        raise DevrfError(
            f"{plain}: no such folder, expected the masks of {footage} ({key}); add it with an "
            f"image for each {'photograph' if is_folder(footage) else 'frame'}"
        )
    for other in others:
        if other.resolve() != footage.resolve() and _masks_at(folder, other) == masks:
            apart, _ = _places(folder, other)
            remedy = f"give {nested} and {apart}" if apart != nested else "rename one of them"
            raise DevrfError(f"{masks}: masks of {footage} or of {other}? {remedy}")
    # The header of a video of masks may be a little off.
    slack = 0.0 if is_folder(masks) else 0.05 * count
    if is_folder(footage):
        _of_photographs(masks, footage)
    elif abs(frame_count(masks) - count) > slack:
        raise DevrfError(
            f"{masks}: {frame_count(masks)} masks, but {footage} has {count} frames; "
            "give an image for each frame, in the order of their names"
        )
    return masks


def _places(folder: Path, footage: Path) -> tuple[Path, Path]:
    """Paths its masks may have, without a suffix: by the footage's folder and name, or its name."""
    name = footage.name if is_folder(footage) else footage.stem
    return folder / footage.absolute().parent.name / name, folder / name


def _masks_at(folder: Path, footage: Path) -> Path | None:
    """The first folder, or video of a video, at one of these places."""
    for base in _places(folder, footage):
        if base.is_dir():
            return base
        if not is_folder(footage) and base.parent.is_dir():
            for path in entries(base.parent):
                if path.stem == base.name and path.suffix.lower() in VIDEOS:
                    return path
    return None


def chosen_masks(
    masks: Path, footage: Path, positions: Sequence[int], size: Size
) -> Iterator[Mask]:
    """The masks, as :func:`masks_of` found them, of frames at ascending ``positions``.

    Raises:
        DevrfError: one is no grey image, has another size than its frame, or is missing.
    """
    if is_folder(masks):
        files = _of_photographs(masks, footage) if is_folder(footage) else listed_images(masks)
        white = white_in_files(files)
        for position in positions:
            yield read_mask(files[position], size, None, footage, white)
        return
    white = white_in((_grey(picture) for _, picture in pictures(masks)), masks)
    for _, picture in frames_at(masks, positions):
        height, width = picture.shape[:2]
        if (width, height) != size:
            raise DevrfError(
                f"{masks}: {width}x{height} px, but {footage} has {size[0]}x{size[1]} px; give "
                "masks of its size"
            )
        yield _grey(picture) * np.uint8(WHITE // white)


def _grey(picture: Picture) -> Mask:
    """A mask from a video, grey as it is, whatever compression has made of its colours."""
    return np.asarray(picture.mean(axis=2).round(), np.uint8)


def motion_masks(images: Path, footage: Chosen) -> dict[str, Mask]:
    """Masks of each image of some footage, by its ``motion``: 0 where it moves, else 255.

    Raises:
        DevrfError: as of :func:`chosen_masks`.
    """
    assert footage.motion is not None
    _, frame = next(pictures(footage.path))
    height, width = np.asarray(cv2.imread(str(images / footage.names[0]))).shape[:2]
    filmed = (frame.shape[1], frame.shape[0])
    masks = chosen_masks(footage.motion, footage.path, footage.positions, filmed)
    fit = (fitted(mask, (width, height)) for mask in masks)
    whole = (np.where(mask > HALF, WHITE, 0).astype(np.uint8) for mask in fit)
    return dict(zip(footage.names, whole, strict=True))


def _of_photographs(masks: Path, footage: Path) -> list[Path]:
    named = {mask.stem: mask for mask in reversed(listed_images(masks))}
    photographs = listed_images(footage)
    if lacking := [photograph for photograph in photographs if photograph.stem not in named]:
        raise DevrfError(
            f"{masks / lacking[0].stem}.png: no such mask, of {lacking[0]}; give each "
            "photograph one of its name"
        )
    return [named[photograph.stem] for photograph in photographs]


def shrunk(image: npt.NDArray[Any], longer: int) -> npt.NDArray[Any]:
    """An image (H, W) or (H, W, 3) with at most ``longer`` pixels of its longer side."""
    factor = longer / max(image.shape[:2])
    if factor >= 1:
        return image
    height, width = (max(1, round(side * factor)) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
