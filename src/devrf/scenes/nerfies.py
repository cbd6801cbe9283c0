"""Scenes in the layout of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import KW_ONLY
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from devrf.scenes.downscale import Downscale
from devrf.scenes.holdout import every_nth
from devrf.scenes.json_files import Ids, Number, read_json
from devrf.scenes.layout import fewer, load_layout
from devrf.scenes.nerfies_images import images_at, list_items, motion_layout, posed_items
from devrf.scenes.nerfies_world import placed, read_world
from devrf.scenes.paths import scene_folder
from devrf.scenes.reader import EstimatedFlow, Holdout, InwardReader, Time
from devrf.scenes.scene import Scene
from devrf.scenes.validation import abbreviated, first_error, scene_error

log = logging.getLogger(__name__)

DATASET, METADATA = "dataset.json", "metadata.json"


class _Dataset(BaseModel):
    """``dataset.json``: the ids of the images; numbers are taken for text."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    count: int | None = None
    ids: Ids | None = None
    train_ids: Ids | None = None
    val_ids: Ids | None = None


class _Moment(BaseModel):
    """An entry of ``metadata.json``: when an image was taken, on some scale."""

    time_id: Number | None = None
    warp_id: Number | None = None


_DATASET = TypeAdapter(_Dataset)
_ENTRIES: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, Any])


@dataclass(frozen=True)
class NerfiesReader(InwardReader):
    """Reads ``dataset.json``, ``metadata.json``, ``scene.json``, ``camera/`` and ``rgb/<n>x/``.

    World units are those of ``scene.json``: (position − center) · scale; it gives near and far,
    too. The time of an image is its ``time_id`` (HyperNeRF), else its ``warp_id``, brought to
    [0, 1]. Images come from ``rgb/<downscale>x``, or from a larger folder and are made smaller;
    they are undistorted. With one time for all of them the scene is at rest.
    Without alpha masks the scene has no end, or, where the cameras look in
    nearly one direction, the box is all that they see between near and far.

    Attributes:
        holdout: without ``val_ids``, one of so many images is held out.
        static_until: the latest time of an image that counts as static: there is no static set.
    """

    _: KW_ONLY
    downscale: Downscale = "up_to_4"
    flow: EstimatedFlow = "auto"
    holdout: Holdout = 8
    static_until: Time = 1.0

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        world = read_world(folder)
        items, train, test = _items(folder / DATASET, self.holdout)
        images = images_at(folder, self.downscale)
        listed = list_items(folder, folder / DATASET, items, images, self.missing)
        times = _times(folder / METADATA, listed.items)
        transforms = posed_items(folder, listed, world, times)
        train, test = listed.positions(train), listed.positions(test)
        layout = motion_layout(transforms, train, test, METADATA, self.static_until)
        layout, _ = fewer(layout, None, self.frames)
        return placed(self, folder, world, *load_layout(layout, folder, images.downscale))


def _items(file: Path, holdout: int) -> tuple[list[str], list[int], list[int]]:
    """The ids of the images, and the positions of those to learn from and those held out."""
    listed = read_json(file, _DATASET, "it lists the images; add it")
    ids, train, val = listed.ids or [], listed.train_ids or [], listed.val_ids or []
    if ids and listed.count not in (None, len(ids)):
        raise scene_error(
            file, f'"count" is {listed.count}, but "ids" lists {len(ids)} images; correct it'
        )
    items = ids or list(dict.fromkeys(train + val))
    position = {item: i for i, item in enumerate(items)}
    unknown = [item for item in train + val if item not in position]
    if unknown:
        raise scene_error(
            file, f'{abbreviated(unknown[0])} is in train_ids or val_ids, but not in "ids"'
        )
    if len(items) < 2:
        raise scene_error(
            file, f"lists {len(items)} images, expected at least two; correct its ids"
        )
    if not val:
        chosen = [position[item] for item in train] or list(range(len(items)))
        if len(chosen) < 2:
            raise scene_error(file, "one image in train_ids and none in val_ids; list more")
        learn, held_out = every_nth(len(chosen), holdout)
        return items, [chosen[i] for i in learn], [chosen[i] for i in held_out]
    held = set(val)
    both = [item for item in train if item in held]
    if both:
        log.warning("%s: %d images of val_ids are in train_ids too; held out", file, len(both))
    learned = [position[item] for item in train or items if item not in held]
    if not learned:
        raise scene_error(file, "all images are held out by val_ids; list some in train_ids only")
    return items, learned, [position[item] for item in val]


def _times(file: Path, items: Sequence[str]) -> tuple[float, ...]:
    """When each image was taken, on the scale of the file."""
    content = read_json(
        file,
        _ENTRIES,
        "it says when each image was taken; add it, with one time_id for all of a scene at rest",
    )
    moments = []
    for item in items:
        if item not in content:
            raise scene_error(file, f"says nothing of image {abbreviated(item)}; add its warp_id")
        try:
            moments.append(_Moment.model_validate(content[item]))
        except ValidationError as error:
            raise first_error(error, f"{file}: {item}.") from None
    key = "warp_id" if any(moment.time_id is None for moment in moments) else "time_id"
    ids = []
    for item, moment in zip(items, moments, strict=True):
        value = getattr(moment, key)
        if value is None:
            raise scene_error(file, f"image {abbreviated(item)} has no {key}; add it")
        ids.append(value)
    return tuple(ids)
