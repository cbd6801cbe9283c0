"""Folders of images: at several sizes, by which factor they are made smaller, what is absent."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import PlainValidator

from devrf.errors import DevrfError
from devrf.scenes.files import entries, inside
from devrf.scenes.images import SUFFIXES, image_at, image_size
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True)
class ImageFolder:
    """The folder to read images from, and what is left to do.

    Attributes:
        path: the folder; the flow of its images lies in a folder of its name with ``_flow``.
        downscale: integer factor ≥ 1 by which its images are yet to be made smaller.
    """

    path: Path
    downscale: int

    @property
    def flow(self) -> Path:
        """Where backward flow of these images would lie, in pixels of these images."""
        return self.path.with_name(f"{self.path.name}_flow")


def image_folder(
    parent: Path, downscale: int, *, full: str = "images", reduced: str = "images_{}"
) -> ImageFolder:
    """The folder in ``parent`` that saves most of the work of making images smaller.

    That is ``images_<downscale>``, else the largest factor that divides ``downscale``, down to
    ``images`` itself; the rest is left to area averages. ``full`` and ``reduced`` are the folders'
    names, ``{}`` in place of the factor. DevrfError if there is none.
    """
    pattern = re.compile(re.escape(reduced).replace(r"\{\}", r"([1-9]\d{0,3})"))
    folders = {}
    for path in entries(parent) if os.path.isdir(parent) else ():
        match = pattern.fullmatch(path.name)
        if os.path.isdir(path) and (match or path.name == full):
            folders[int(match[1]) if match else 1] = path
    fitting = [factor for factor in folders if downscale % factor == 0]
    if not fitting:
        wanted = full if downscale == 1 else f"{reduced.format(downscale)} or {full}"
        found = ", ".join(sorted(path.name for path in folders.values())) or "none"
        raise scene_error(
            parent, f"no folder {wanted} (found: {found}); add it, or change data.downscale"
        )
    best = max(fitting)
    return ImageFolder(folders[best], downscale // best)


def listed_images(folder: Path, *, by_number: bool = False) -> list[Path]:
    """The image files in ``folder``, at least one, else DevrfError, in order of their names.

    ``by_number`` counts runs of digits as numbers, so that 10.png comes after 9.png; else names are
    compared by characters, which is the order of COLMAP's poses.
    """
    found = [
        path
        for path in entries(folder)
        if path.suffix.lower() in SUFFIXES and path.name[0] != "." and os.path.isfile(path)
    ]
    if not found:
        raise scene_error(folder, f"no images (looked for {', '.join(SUFFIXES)}); add them")
    return sorted(found, key=lambda path: _natural(path.name) if by_number else [path.name])


def _natural(name: str) -> list[object]:
    """Text and numbers in turn: any two such lists compare."""
    pieces = _DIGITS.split(name)
    return [int(piece) if k % 2 else piece for k, piece in enumerate(pieces)]


# ``up_to_<N>`` keeps so many pixels of the shorter side: of smaller images little can be learned.
LEAST_SIDE = 64
_UP_TO = re.compile(r"up_to_([1-9]\d{0,3})")


def _downscale(value: object) -> object:
    whole = isinstance(value, int) and not isinstance(value, bool) and value >= 1
    if not whole and not (isinstance(value, str) and _UP_TO.fullmatch(value)):
        raise ValueError(f"expected a whole number of at least 1, or up_to_<number>, not {value!r}")
    return value


# A factor, or ``up_to_<factor>``.
Downscale = Annotated[int | str, PlainValidator(_downscale)]


def whole_factor(downscale: int | str, side_at: Callable[[int], int | None]) -> int:
    """The factor by which images are made smaller.

    A number is obeyed. ``up_to_<N>`` takes the largest factor up to N at which the shorter side
    keeps 64 pixels, or else the one that leaves the most. ``side_at`` gives the shorter side in
    pixels at a factor, None where it cannot be had.
    """
    if isinstance(downscale, int):
        return downscale
    most = int(downscale.removeprefix("up_to_"))
    sides = {factor: side_at(factor) for factor in range(most, 0, -1)}
    known = {factor: side for factor, side in sides.items() if side is not None}
    enough = [factor for factor, side in known.items() if side >= LEAST_SIDE]
    if not known:
        return most  # the reader of the files says what is missing
    factor = enough[0] if enough else max(known, key=lambda one: (known[one], -one))
    if factor < most:
        log.info(
            "images %s, although data.downscale=%s: their shorter side has %d px, and is not to "
            "fall below %d (data.downscale=%d all the same)",
            f"are made smaller by {factor}" if factor > 1 else "keep their size",
            downscale,
            known[factor],
            LEAST_SIDE,
            most,
        )
    return factor


def folder_factor(
    parent: Path, downscale: int | str, *, full: str = "images", reduced: str = "images_{}"
) -> int:
    """:func:`whole_factor` for images in folders of several sizes; arguments as image_folder's."""

    def side_at(factor: int) -> int | None:
        try:
            source = image_folder(parent, factor, full=full, reduced=reduced)
        except DevrfError:
            return None
        return min(image_size(listed_images(source.path)[0])) // source.downscale

    return whole_factor(downscale, side_at)


Missing = Literal["error", "skip"]


def present_images(
    names: Sequence[str], file: Path, root: Path, missing: Missing
) -> dict[int, Path]:
    """The existing images that ``file`` lists, by their positions in the list.

    Args:
        names: of N images, relative to the file's folder, with or without their suffix.
        file: the file that lists them.
        root: the scene's folder, which no name may leave.
        missing: whether absent images are an error, or left out with one warning.

    Raises:
        DevrfError: an image is absent and must not be, or all are.
    """
    places = [inside(root, file.parent, name, file) for name in names]
    found = {k: image for k, place in enumerate(places) if (image := image_at(place)) is not None}
    absent = [place for k, place in enumerate(places) if k not in found]
    if absent and (missing == "error" or not found):
        add = "add them" if len(absent) > 1 else "correct its name or add it"
        skip = ", or leave out what is absent with data.missing=skip" if found else ""
        raise scene_error(
            absent[0],
            f"no such image (looked for {', '.join(SUFFIXES)}); {len(absent)} of the {len(names)} "
            f"images in {file.name} are absent: {add}{skip}",
        )
    if absent:
        log.warning(
            "%s: %d of the %d images are absent and left out, %s the first of them",
            file,
            len(absent),
            len(names),
            absent[0].relative_to(root),
        )
    return found
