"""Images that a file lists and that are not there: counted, or left out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from devrf.scenes.image_files import SUFFIXES, image_at
from devrf.scenes.paths import inside
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

Missing = Literal["error", "skip"]


def present_images(
    names: Sequence[str], file: Path, root: Path, missing: Missing
) -> dict[int, Path]:
    """The existing images that a file lists, by their positions in the list.

    Args:
        names: of N images, relative to the file's folder, with or without their suffix.
        file: the file that lists them.
        root: the scene's folder, which no name may leave.
        missing: whether absent images are an error, or left out with one warning.

    Raises:
        DevrfError: an image is absent and must not be, or all are; the line has the first one and
            their number.
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
