"""``camera/<id>.json``: one image's camera in Nerfies' layout, OpenCV axes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from devrf.geometry.distortion import Distortion
from devrf.scenes.intrinsics import Intrinsics
from devrf.scenes.json_files import json_object, numbers
from devrf.scenes.paths import inside
from devrf.scenes.poses import FARTHEST, in_reach, is_rotation
from devrf.scenes.validation import abbreviated, number, scene_error


def read_camera(
    folder: Path, item: str, center: Sequence[float], scale: float
) -> tuple[Tensor, Intrinsics]:
    """The camera of image ``item``.

    Args:
        folder: the scene's folder.
        item: the image's id.
        center: x, y, z of the world's origin, in the file's units.
        scale: world units in one of the file's.

    Returns:
        The camera-to-world transform (3, 4) float32 in OpenGL axes, world units, and the
        intrinsics in pixels of the full image.

    Raises:
        DevrfError: the file is missing or a value in it is none.
    """
    file = inside(folder, folder / "camera", f"{item}.json", folder / "dataset.json")
    content = json_object(file, "every image needs its camera; add it")
    return _pose(content, file, center, scale), _intrinsics(content, file)


def _pose(content: dict[str, Any], file: Path, center: Sequence[float], scale: float) -> Tensor:
    rows = content.get("orientation")
    if not isinstance(rows, list) or len(rows) != 3:
        raise scene_error(file, 'expected 3 rows of 3 numbers as "orientation" (world to camera)')
    listed = [numbers({"orientation": row}, "orientation", 3, file) for row in rows]
    world_to_camera = torch.tensor(listed, dtype=torch.float64)
    if not bool(is_rotation(world_to_camera)):
        raise scene_error(file, "orientation is no rotation (scaled, sheared or mirrored axes)")
    position = numbers(content, "position", 3, file)
    # OpenCV's y points down and its z ahead; ours point up and back.
    axes = world_to_camera.T * world_to_camera.new_tensor([1, -1, -1])
    where = (axes.new_tensor(position) - axes.new_tensor(list(center))) * scale
    if not bool(in_reach(where)):
        raise scene_error(
            file,
            f"position is farther than {FARTHEST:g} from the scene's center, in units of "
            "scene.json; correct it, or center and scale there",
        )
    return torch.cat([axes, where[:, None]], dim=1).float()


def _intrinsics(content: dict[str, Any], file: Path) -> Intrinsics:
    focal = _positive(content, "focal_length", file)
    aspect = _positive({"pixel_aspect_ratio": 1.0} | content, "pixel_aspect_ratio", file)
    skew = number(content.get("skew", 0.0))
    if skew is None:
        raise scene_error(
            file, f"skew is {abbreviated(content['skew'])}, expected pixels; correct it"
        )
    width, height = numbers(content, "image_size", 2, file)
    if min(width, height) <= 0:
        raise scene_error(file, f"image_size is {width:g}, {height:g}, expected pixels > 0")
    cx, cy = numbers(content, "principal_point", 2, file)
    # The example in Nerfies' own documentation says "tangential".
    tangential = "tangential" if "tangential" in content else "tangential_distortion"
    k1, k2, k3 = numbers({"radial_distortion": [0.0] * 3} | content, "radial_distortion", 3, file)
    p1, p2 = numbers({tangential: [0.0] * 2} | content, tangential, 2, file)
    return Intrinsics(
        None,
        (focal, focal * aspect),
        (cx, cy),
        (width, height),
        Distortion((k1, k2, k3, 0.0), (p1, p2)),
        skew,
    )


def _positive(content: dict[str, Any], key: str, file: Path) -> float:
    value = number(content.get(key))
    if value is None or value <= 0:
        raise scene_error(
            file, f"{key} is {abbreviated(content.get(key))}, expected a number > 0; correct it"
        )
    return value
