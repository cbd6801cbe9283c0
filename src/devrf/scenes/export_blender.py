"""A scene written to disk in the published inward-facing (Blender) layout."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import torch

from devrf.geometry.cameras import Cameras
from devrf.scenes.flow_files import write_flow
from devrf.scenes.new_folder import time_major, whole_folder
from devrf.scenes.scene import Capture, Scene, Views
from devrf.scenes.validation import scene_error

# The layout has a validation split, which nothing here learns from: a few test images again.
_VALIDATION_VIEWS = 4


def export_blender(scene: Scene, folder: Path) -> None:
    """Write ``scene`` as ``folder/static`` and ``folder/dynamic_<V>views``.

    Each holds ``transforms_{train,val,test}.json`` and images, RGBA where they have mattes; dynamic
    images are ordered time-major, and their flow, where there is one, goes to
    ``train_flow/<index>_bwd.npz``. Poses, times and images read back exactly.

    Args:
        scene: an inward-facing scene.
        folder: a new or an empty folder.

    Raises:
        DevrfError: the folder is in use or cannot be written, or the layout cannot hold the
            scene.
    """
    if scene.kind != "inward":
        raise scene_error(scene.name, "only inward-facing scenes fit the Blender layout")
    dynamic = Capture(time_major(scene.dynamic.train), time_major(scene.dynamic.test))
    count = len(set(dynamic.train.view.tolist()))
    with whole_folder(folder) as partial:
        _write_capture(scene.static, partial / "static")
        _write_capture(dynamic, partial / f"dynamic_{count}views")


def _write_capture(capture: Capture, folder: Path) -> None:
    few = torch.arange(min(_VALIDATION_VIEWS, len(capture.test)))
    _write_split(capture.train, "train", folder)
    _write_split(capture.test[few], "val", folder)
    _write_split(capture.test, "test", folder)
    if capture.train.flow is not None:
        # The first images of the views have no earlier one.
        later = (capture.train.times > 0).nonzero().flatten().tolist()
        write_flow(folder / "train_flow", capture.train.flow, later)


def _write_split(views: Views, split: str, folder: Path) -> None:
    (folder / split).mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for k, (pixels, pose, time) in enumerate(
        zip(views.pixels, views.cameras.camera_to_world, views.times.tolist(), strict=True)
    ):
        name = f"r_{k:03d}"
        iio.imwrite(folder / split / f"{name}.png", pixels.cpu().numpy())
        frames.append(
            {
                "file_path": f"./{split}/{name}",
                "time": time,
                # A float32 becomes the float64 of the same value, which JSON keeps digit for digit.
                "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
            }
        )
    content = {"camera_angle_x": _field_of_view(views.cameras), "frames": frames}
    text = json.dumps(content, indent=1)
    (folder / f"transforms_{split}.json").write_text(text + "\n", encoding="utf-8")


def _field_of_view(cameras: Cameras) -> float:
    """``camera_angle_x`` in radians, the only intrinsic that the layout has."""
    focal, center = cameras.focal.double(), cameras.center.double()
    middle = center.new_tensor([cameras.width / 2, cameras.height / 2])
    shared = float(focal[0, 0])
    if not torch.allclose(focal, focal.new_tensor(shared), rtol=1e-6, atol=0.0):
        raise scene_error("cameras", "one camera_angle_x cannot hold different focal lengths")
    if not torch.allclose(center, middle.expand_as(center), rtol=0.0, atol=1e-4):
        raise scene_error("cameras", "camera_angle_x needs principal points in the images' middle")
    return 2 * math.atan(cameras.width / 2 / shared)
