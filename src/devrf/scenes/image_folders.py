"""Folders of images at several sizes: ``images``, ``images_4``, ``images_8``."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from devrf.scenes.image_files import SUFFIXES
from devrf.scenes.paths import entries
from devrf.scenes.validation import scene_error

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
    ``images`` itself; the rest is left to area averages.

    Args:
        parent: where the folders are.
        downscale: integer factor ≥ 1.
        full: name of the folder of full-size images.
        reduced: name of a folder of smaller images, ``{}`` in place of the factor.

    Raises:
        DevrfError: there is none.
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
            parent,
            f"no folder {wanted} (found: {found}); add it, or set data.downscale to a "
            "factor that is there",
        )
    best = max(fitting)
    return ImageFolder(folders[best], downscale // best)


def listed_images(folder: Path, *, by_number: bool = False) -> list[Path]:
    """The image files in ``folder``, at least one, in order of their names.

    Args:
        folder: an existing folder.
        by_number: count runs of digits as numbers, so that 10.png comes after 9.png; else
            character by character, which is the order of COLMAP's poses.

    Raises:
        DevrfError: it holds no image.
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
