"""Scenes in the layout of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from devrf.scenes.bounds import box_of_frusta, inward_bounds
from devrf.scenes.holdout import every_nth
from devrf.scenes.image_folders import image_folder
from devrf.scenes.json_files import json_object, numbers
from devrf.scenes.layout import fewer, load_layout, without_static_set
from devrf.scenes.nerfies_camera import read_camera
from devrf.scenes.options import check_options
from devrf.scenes.paths import scene_folder
from devrf.scenes.poses import FARTHEST
from devrf.scenes.scene import Background, Scene
from devrf.scenes.splits import in_motion
from devrf.scenes.transforms import Transforms, listed_image
from devrf.scenes.validation import abbreviated, check_count, number, scene_error

log = logging.getLogger(__name__)

DATASET, METADATA, SCENE = "dataset.json", "metadata.json", "scene.json"


def read_nerfies(
    root: str | Path,
    *,
    name: str | None = None,
    downscale: int = 1,
    background: Background = "white",
    bound_scale: float | str = "auto",
    near: float | None = None,
    far: float | None = None,
    box: list[list[float]] | None = None,
    frames: int | None = None,
    holdout: int = 8,
    static_until: float = 1.0,
) -> Scene:
    """Read ``dataset.json``, ``metadata.json``, ``scene.json``, ``camera/`` and ``rgb/<n>x/``.

    World units are those of ``scene.json``: (position − center) · scale. The time of an image
    is its ``time_id`` (HyperNeRF), else its ``warp_id``, brought to [0, 1]. Images are
    undistorted. There is no static set: the images up to ``static_until`` stand in for one.

    Args:
        root: the scene's folder.
        name: short name; None takes the folder's.
        downscale: integer factor ≥ 1: images come from ``rgb/<downscale>x``, or from a larger
            folder and are made smaller.
        background: what is behind the mattes of RGBA images; RGB images are used as they are.
        bound_scale: "auto" (room for motion from silhouettes) or a number ≥ 1 by which the
            tightened canonical box is enlarged.
        near: distance in world units before which nothing is; None: what scene.json says.
        far: distance in world units behind which nothing is; None: what scene.json says.
        box: [[x, y, z], [x, y, z]] in world units; None: what the cameras look at, or, without
            mattes, all that they see between near and far.
        frames: keep so many times, evenly spread, first and last included; None: all.
        holdout: without ``val_ids``, one of so many images is held out.
        static_until: the latest time in [0, 1] of an image that counts as static.

    Raises:
        DevrfError: a file or an option is wrong; the message names it.
    """
    given_box = check_options(
        downscale=downscale,
        background=background,
        bound_scale=bound_scale,
        near=near,
        far=far,
        box=box,
        frames=frames,
        static_until=static_until,
    )
    check_count("data.holdout", holdout, 2)
    folder = scene_folder(root)
    world = _world(folder / SCENE)
    items, train, test = _items(folder / DATASET, holdout)
    images = image_folder(folder / "rgb", downscale, full="1x", reduced="{}x")
    transforms = _transforms(folder, items, images.path, world)
    layout = without_static_set(
        in_motion(transforms[train]), in_motion(transforms[test]), static_until
    )
    layout, _ = fewer(layout, None, frames)
    static, dynamic = load_layout(layout, folder, images.downscale)
    near, far = world.near if near is None else near, world.far if far is None else far
    if given_box is None and not static.train.has_alpha and 0 <= near < far:
        # Without mattes the backdrop is to be learned too.
        given_box = box_of_frusta(static.train.cameras, near, far)
    bounds = inward_bounds(
        static.train,
        dynamic.train,
        [static.train, static.test, dynamic.train, dynamic.test],
        bound_scale=bound_scale,
        near=near,
        far=far,
        box=given_box,
    )
    return Scene(name or folder.resolve().name, "inward", static, dynamic, bounds, background)


@dataclass(frozen=True)
class _World:
    """The frame of reference: (position − center) · scale; near and far are scaled already."""

    center: tuple[float, ...]
    scale: float
    near: float
    far: float


def _world(file: Path) -> _World:
    content = json_object(file, "it says where the scene is; set data.root to its folder")
    found = {}
    for key in ("scale", "near", "far"):
        value = number(content.get(key))
        if value is None or not 0 < value <= FARTHEST:
            raise scene_error(
                file,
                f"{key} is {abbreviated(content.get(key))}, expected a number above 0, and no "
                f"more than {FARTHEST:g}; correct it",
            )
        found[key] = value
    return _World(tuple(numbers(content, "center", 3, file)), **found)


def _items(file: Path, holdout: int) -> tuple[list[str], list[int], list[int]]:
    """The ids of the images, and the positions of those to learn from and those held out."""
    content = json_object(file, "it lists the images; add it")
    ids, train, val = (_ids(content, key, file) for key in ("ids", "train_ids", "val_ids"))
    count = content.get("count", len(ids))
    if ids and count != len(ids):
        raise scene_error(
            file, f'"count" is {abbreviated(count)}, but "ids" lists {len(ids)} images; correct it'
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


def _ids(content: dict[str, Any], key: str, file: Path) -> list[str]:
    values = content.get(key) or []
    known = isinstance(values, list) and all(isinstance(v, str | int) and v != "" for v in values)
    if not known or len(set(map(str, values))) < len(values):
        raise scene_error(file, f'expected a list of distinct ids as "{key}"; correct it')
    return [str(value) for value in values]


def _transforms(folder: Path, items: list[str], images: Path, world: _World) -> Transforms:
    file = folder / DATASET
    cameras = [read_camera(folder, item, world.center, world.scale) for item in items]
    return Transforms(
        file,
        tuple(intrinsics for _, intrinsics in cameras),
        tuple(listed_image(f"rgb/{images.name}/{item}", file, folder) for item in items),
        torch.stack([pose for pose, _ in cameras]),
        _times(folder / METADATA, items),
    )


def _times(file: Path, items: list[str]) -> tuple[float, ...]:
    """When each image was taken, from 0 (the first of all) to 1 (the last)."""
    content = json_object(file, "it says when each image was taken; add it")
    entries = []
    for item in items:
        entry = content.get(item)
        if not isinstance(entry, dict):
            raise scene_error(file, f"says nothing of image {abbreviated(item)}; add its warp_id")
        entries.append(entry)
    key = "time_id" if all("time_id" in entry for entry in entries) else "warp_id"
    ids = []
    for item, entry in zip(items, entries, strict=True):
        value = number(entry.get(key))
        if value is None:
            raise scene_error(
                file,
                f"{key} of image {abbreviated(item)} is {abbreviated(entry.get(key))}, "
                "expected a number",
            )
        ids.append(value)
    first, last = min(ids), max(ids)
    if first == last:
        raise scene_error(file, f"all images have the {key} {first:g}, expected at least two times")
    return tuple((value - first) / (last - first) for value in ids)
