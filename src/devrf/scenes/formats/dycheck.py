"""DyCheck's captures: Nerfies' layout with split lists and covisibility masks."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import KW_ONLY
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, Field
from pydantic.dataclasses import dataclass

from devrf.scenes.files import Ids, Number, inside, read_json
from devrf.scenes.formats.nerfies import ItemsReader, Listed
from devrf.scenes.image_folders import Downscale, ImageFolder
from devrf.scenes.names import ImageFinder
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


@dataclass(frozen=True)
class DycheckReader(ItemsReader):
    """Reads ``splits/train.json``, ``splits/val.json``, ``scene.json``, ``camera/``, ``rgb/<n>x/``.

    One moving camera takes the training images, others are held out. Times are the ``time_ids`` of
    the splits, brought to [0, 1]. Depth is not read.

    Attributes:
        masks: ``ignore``: only pixels in the masks of ``covisible/``, which enough training images
            show, are scored; ``none``: all pixels of held-out images are.
    """

    listing: ClassVar[str] = SPLITS

    _: KW_ONLY
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


def _read_split(file: Path) -> dict[str, float]:
    """The time of each image, by its name."""
    split = read_json(file, _Split, "it lists images and their times; add it")
    if len(split.frame_names) != len(split.time_ids):
        raise scene_error(
            file,
            f"{len(split.frame_names)} frame_names, but {len(split.time_ids)} time_ids; correct it",
        )
    return dict(zip(split.frame_names, split.time_ids, strict=True))
