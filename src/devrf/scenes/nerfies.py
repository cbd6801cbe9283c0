"""Scenes in the layout of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

import logging
from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass

from devrf.scenes.absent_images import present_images
from devrf.scenes.bounds import FALLBACK_BOUND_SCALE, axes_do_meet, box_of_frusta
from devrf.scenes.downscale import Downscale, folder_factor
from devrf.scenes.holdout import every_nth
from devrf.scenes.image_folders import image_folder
from devrf.scenes.json_files import Name, Number, Positive, Vector3, read_json
from devrf.scenes.layout import Layout, fewer, load_layout, static_alone, without_static_set
from devrf.scenes.nerfies_camera import read_camera
from devrf.scenes.paths import scene_folder
from devrf.scenes.poses import FARTHEST
from devrf.scenes.reader import EstimatedFlow, Holdout, InwardReader, Time
from devrf.scenes.scene import Scene
from devrf.scenes.splits import in_motion, one_moment
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import abbreviated, first_error, scene_error

log = logging.getLogger(__name__)

DATASET, METADATA, SCENE = "dataset.json", "metadata.json", "scene.json"


def _distinct(ids: list[str]) -> list[str]:
    if len(set(ids)) < len(ids):
        raise ValueError("expected a list of distinct ids; correct it")
    return ids


Ids = Annotated[list[Name], Field(fail_fast=True), AfterValidator(_distinct)]
Length = Annotated[Positive, Field(le=FARTHEST)]


class _World(BaseModel):
    """``scene.json``: the frame of reference, (position − center) · scale.

    ``near`` and ``far`` are in world units, scaled already.
    """

    center: Vector3
    scale: Length
    near: Length
    far: Length


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


_WORLD, _DATASET = TypeAdapter(_World), TypeAdapter(_Dataset)
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
        world = read_json(
            folder / SCENE, _WORLD, "it says where the scene is; set data.root to its folder"
        )
        items, train, test = _items(folder / DATASET, self.holdout)
        names = {"full": "1x", "reduced": "{}x"}
        factor = folder_factor(folder / "rgb", self.downscale, **names)
        images = image_folder(folder / "rgb", factor, **names)
        listed = [f"rgb/{images.path.name}/{item}" for item in items]
        present = present_images(listed, folder / DATASET, folder, self.missing)
        transforms = _transforms(folder, items, present, world)
        train, test = (_present(part, present, folder / DATASET) for part in (train, test))
        layout = _layout(transforms, train, test, self.static_until)
        layout, _ = fewer(layout, None, self.frames)
        static, dynamic = load_layout(layout, folder, images.downscale)
        near = world.near if self.near is None else self.near
        far = world.far if self.far is None else self.far
        reader, cameras = replace(self, near=near, far=far), static.train.cameras
        wide = self.box is None and not static.train.cut_out and 0 <= near < far
        if not wide or (self.space != "world" and axes_do_meet(cameras)):
            return reader.scene(folder, static, dynamic)
        # Without mattes the backdrop is to be learned too.
        seen = box_of_frusta(cameras, near, far)
        scale = FALLBACK_BOUND_SCALE if self.bound_scale == "auto" else self.bound_scale
        box = [seen.low, seen.high]
        reader = replace(reader, box=box, space="world", bound_scale=scale)
        scene = reader.scene(folder, static, dynamic)
        why = "data.space=world" if self.space == "world" else "the cameras look in one direction"
        bounds = replace(scene.bounds, reason=why, box_source="all that the cameras see up to far")
        return replace(scene, bounds=bounds)


def _layout(transforms: Transforms, train: list[int], test: list[int], until: float) -> Layout:
    if not one_moment(transforms):
        both = in_motion(transforms[train]), in_motion(transforms[test])
        return without_static_set(*both, until)
    why = f"all images have one time in {METADATA}"
    return static_alone(transforms[train], transforms[test], why)


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


def _present(wanted: list[int], present: dict[int, Path], file: Path) -> list[int]:
    """Positions among the images that are present."""
    place = {position: k for k, position in enumerate(present)}
    kept = [place[position] for position in wanted if position in place]
    if not kept:
        raise scene_error(
            file, "all images to learn from, or all that are held out, are absent; add them"
        )
    return kept


def _transforms(
    folder: Path, items: list[str], images: dict[int, Path], world: _World
) -> Transforms:
    """The images, by their positions among the items, with cameras and times."""
    names = [items[position] for position in images]
    cameras = [read_camera(folder, name, world.center, world.scale) for name in names]
    return Transforms(
        folder / DATASET,
        tuple(intrinsics for _, intrinsics in cameras),
        tuple(images.values()),
        torch.stack([pose for pose, _ in cameras]),
        _times(folder / METADATA, names),
    )


def _times(file: Path, items: list[str]) -> tuple[float, ...]:
    """When each image was taken, from 0 (the first of all) to 1 (the last)."""
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
    first, last = min(ids), max(ids)
    return tuple((value - first) / ((last - first) or 1.0) for value in ids)
