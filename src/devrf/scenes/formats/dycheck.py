"""DyCheck's captures: Nerfies' layout with split lists and masks of what training has seen."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter
from pydantic.dataclasses import dataclass

from devrf.scenes.files import Ids, Number, inside, read_json, scene_folder
from devrf.scenes.formats.nerfies import ItemsReader, read_items
from devrf.scenes.image_folders import Downscale, ImageFolder
from devrf.scenes.images import image_at
from devrf.scenes.reader import Holdout
from devrf.scenes.scene import Scene
from devrf.scenes.splits import every_nth
from devrf.scenes.validation import abbreviated, scene_error

log = logging.getLogger(__name__)


SPLITS, COVISIBLE = "splits", "covisible"
TRAIN, VAL = f"{SPLITS}/train.json", f"{SPLITS}/val.json"


class _Split(BaseModel):
    """``splits/<name>.json``: K images and when they were taken, on some scale."""

    frame_names: Ids
    time_ids: Annotated[list[Number], Field(fail_fast=True)]


_SPLIT = TypeAdapter(_Split)


@dataclass(frozen=True)
class DycheckReader(ItemsReader):
    """Reads ``splits/train.json``, ``splits/val.json``, ``scene.json``, ``camera/``, ``rgb/<n>x/``.

    One moving camera is learned from, others are held out. Times are the ``time_ids`` of the
    splits, brought to [0, 1]; there is no static set. World, near and far are those of
    ``scene.json``; images come from ``rgb/<downscale>x``, or from a larger folder and are made
    smaller. Without alpha masks the scene is unbounded, or, where the cameras look in nearly one
    direction, the box is all that they see between near and far. Depth is left alone.

    Attributes:
        holdout: where ``val.json`` lists no image, one of so many training images is held out.
        masks: ``ignore``: what ``covisible/`` says that training has hardly seen is not scored;
            ``none``: all of the held-out images is.
    """

    _: KW_ONLY
    downscale: Downscale = "up_to_2"
    holdout: Holdout = 8
    masks: Literal["ignore", "none"] = "ignore"

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        moments, *split = _splits(folder, self.holdout)
        masks = None if self.masks == "none" else partial(_covisible, folder)

        def times(items: tuple[str, ...]) -> list[float]:
            return [moments[item] for item in items]

        return read_items(self, folder / SPLITS, list(moments), (split[0], split[1]), times, masks)


def _splits(folder: Path, holdout: int) -> tuple[dict[str, float], list[int], list[int]]:
    """When each image was taken, and the positions of those to learn from and those held out."""
    learned, held_out = (_read_split(folder / name) for name in (TRAIN, VAL))
    both = [name for name in learned if name in held_out]
    if both:
        raise scene_error(
            folder / VAL, f"lists {abbreviated(both[0])}, as {TRAIN} does; list it in one of them"
        )
    least = 1 if held_out else 2
    if len(learned) < least:
        raise scene_error(
            folder / TRAIN, f"lists {len(learned)} images, expected at least {least}; add some"
        )
    moments, count = {**learned, **held_out}, len(learned)
    if held_out:
        return moments, list(range(count)), list(range(count, len(moments)))
    log.info("%s lists no image: one of %d training images is held out", VAL, holdout)
    return moments, *every_nth(count, holdout)


def _read_split(file: Path) -> dict[str, float]:
    """The time of each image, by its name."""
    split = read_json(file, _SPLIT, "it lists images and their times; add it")
    if len(split.frame_names) != len(split.time_ids):
        raise scene_error(
            file,
            f"{len(split.frame_names)} frame_names, but {len(split.time_ids)} time_ids; correct it",
        )
    return dict(zip(split.frame_names, split.time_ids, strict=True))


def _covisible(
    folder: Path, items: tuple[str, ...], images: ImageFolder
) -> tuple[Path | None, ...]:
    """The mask of each image that has one: at the size of the images, or at full size."""
    places = [
        Path(COVISIBLE, size, "val")
        for size in dict.fromkeys((images.path.name, "1x"))
        if os.path.isdir(folder / COVISIBLE / size / "val")
    ]
    if not places:
        return (None,) * len(items)

    def mask(item: str) -> Path | None:
        return image_at(inside(folder, folder, f"{places[0]}/{item}", folder / SPLITS))

    return tuple(map(mask, items))
