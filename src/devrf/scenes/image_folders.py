"""Folders of images: the size to read, and the factor by which it is made smaller."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from pydantic import PlainValidator

from devrf.errors import DevrfError
from devrf.scenes.files import entries
from devrf.scenes.images import SUFFIXES, image_size, unread
from devrf.scenes.names import in_order, last_number
from devrf.scenes.validation import scene_error
from devrf.system.files import utf8_path

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImageFolder:
    """The folder to read images from, and the factor that remains.

    Attributes:
        path: the folder.
        downscale: integer factor ≥ 1 by which its images are yet to be made smaller.
    """

    path: Path
    downscale: int


def image_folder(
    parent: Path, downscale: int, *, full: str = "images", reduced: str = "images_{}"
) -> ImageFolder:
    """The folder in ``parent`` with the smallest images that are large enough.

    That is ``images_<downscale>``, else the folder of the largest factor that divides
    ``downscale``, down to ``images`` itself; area averages do the rest.
    ``full`` and ``reduced`` are the folders' names, ``{}`` in place of the factor. DevrfError if
    there is none.
    """
    pattern = re.compile(re.escape(reduced).replace(r"\{\}", r"([1-9]\d{0,3})"))
    folders = {}
    for path in entries(parent) if os.path.isdir(parent) else ():
        match = pattern.fullmatch(path.name)
        if os.path.isdir(path) and (match or path.name == full):
            folders[int(match[1]) if match else 1] = path
    fitting = [factor for factor in folders if downscale % factor == 0]
    if not fitting:
        expected = full if downscale == 1 else f"{reduced.format(downscale)} or {full}"
        present = ", ".join(sorted(path.name for path in folders.values())) or "none"
        raise scene_error(
            parent, f"no folder {expected} (found: {present}); add it, or change data.downscale"
        )
    best = max(fitting)
    return ImageFolder(folders[best], downscale // best)


def listed_images(folder: Path, *, by_characters: bool = False) -> list[Path]:
    """The image files in ``folder``, at least one, else DevrfError, in order of their names.

    For the order and ``by_characters`` see :func:`~devrf.scenes.names.in_order`.
    """
    images = [
        utf8_path(path)
        for path in entries(folder)
        if path.suffix.lower() in SUFFIXES and path.name[0] != "." and os.path.isfile(path)
    ]
    if not images:
        raise scene_error(folder, f"no images (looked for {', '.join(SUFFIXES)}){unread(folder)}")
    return in_order(images, name=lambda path: path.name, where=folder, by_characters=by_characters)


def shot_together(folders: Sequence[Path]) -> list[list[Path]]:
    """The images of cameras that take theirs together, a folder each, in the order of their names.

    DevrfError if folders have different numbers of images. A warning says that the numbers in their
    names differ: one camera may have begun later, or have lost an image.
    """
    taken = [listed_images(folder) for folder in folders]
    for folder, images in zip(folders, taken, strict=True):
        if len(images) != len(taken[0]):
            raise scene_error(
                folder,
                f"has {len(images)} images, but {folders[0]} has {len(taken[0])}; each camera "
                "needs one a time",
            )
        for image, first in zip(images, taken[0], strict=True):
            if last_number(image.stem) != last_number(first.stem):
                log.warning("%s is taken to show the moment of %s, by its place", image, first)
                break
    return taken


# Images with a shorter side of fewer pixels teach little.
LEAST_SIDE = 64
# Most pixels of the longer side with ``cpu`` and ``gpu``: the grids that a CPU learns show no more
# detail; scenes are published at about the size for a GPU.
LONGEST = {"cpu": 640, "gpu": 1600}
_UP_TO = re.compile(r"up_to_([1-9]\d{0,3})")


def _downscale(value: object) -> object:
    is_factor = isinstance(value, int) and not isinstance(value, bool) and value >= 1
    is_choice = isinstance(value, str) and (value in ("auto", *LONGEST) or _UP_TO.fullmatch(value))
    if not is_factor and not is_choice:
        raise ValueError(
            f"expected auto, a whole number of at least 1, or up_to_<number>, not {value!r}"
        )
    return value


# A factor, a kind of device, or ``up_to_<factor>``.
Downscale = Annotated[int | str, PlainValidator(_downscale)]
SizeAt = Callable[[int], tuple[int, int] | None]


def whole_factor(downscale: int | str, size_at: SizeAt) -> int:
    """The factor by which images are made smaller.

    A number is the factor itself. ``cpu`` and ``gpu`` take the least power of two that leaves no
    more than :data:`LONGEST`, ``auto`` that of this machine, ``up_to_<N>`` the largest factor up to
    N. All keep 64 pixels of the shorter side; if no factor does, the one that leaves the most
    counts. ``size_at`` gives (width, height) at a factor, None where there are no such images.
    """
    if isinstance(downscale, int):
        return downscale
    device = downscale
    if downscale == "auto":
        device = "gpu" if torch.cuda.is_available() else "cpu"
    limit = LONGEST.get(device, LONGEST["cpu"])
    factors = [1 << k for k in range(10)]
    if match := _UP_TO.fullmatch(downscale):
        limit = sys.maxsize
        factors = list(range(int(match[1]), 0, -1))
    sizes = {factor: size for factor in factors if (size := size_at(factor)) is not None}
    if not sizes:
        return factors[0]  # the reader of the files names the missing ones
    fitting = [factor for factor, size in sizes.items() if min(size) >= LEAST_SIDE]
    fitting = fitting or [max(sizes, key=lambda factor: (min(sizes[factor]), -factor))]
    factor = next((factor for factor in fitting if max(sizes[factor]) <= limit), fitting[-1])
    width, height = sizes[factor]
    reason = f"data.downscale={downscale}" if match else f"chosen for a {device.upper()}"
    log.info(
        "images of %dx%d px, made smaller by %d (%s; data.downscale=NUMBER chooses otherwise)",
        width,
        height,
        factor,
        reason,
    )
    return factor


def folder_size(parent: Path, *, full: str = "images", reduced: str = "images_{}") -> SizeAt:
    """The size at a factor of images in folders of several sizes, named as for image_folder."""

    def size_at(factor: int) -> tuple[int, int] | None:
        try:
            source = image_folder(parent, factor, full=full, reduced=reduced)
        except DevrfError:
            return None
        width, height = image_size(listed_images(source.path)[0])
        return width // source.downscale, height // source.downscale

    return size_at
