"""A captured scene as nerfstudio's ``transforms.json``, with a time on each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from devrf.scenes.nerfstudio import FILE
from devrf.scenes.normalisation import World
from devrf.system.files import write_json

# Below the scene's folder.
IMAGES = "images"


@dataclass(frozen=True)
class Shot:
    """One image of the scene.

    Attributes:
        name: of its file, relative to the folder of images.
        pose: (3, 4) camera-to-world, OpenGL axes, world units.
        lens: ``fl_x``, ``cx``, ``k1`` … in pixels of the image.
        time: in [0, 1], 0 at rest.
        held_out: whether it is scored instead of learned from.
    """

    name: str
    pose: Tensor
    lens: dict[str, float]
    time: float
    held_out: bool


def write_scene(
    folder: Path, shots: Sequence[Shot], world: World, model: str, *, cut_out: bool = False
) -> Path:
    """Write ``transforms.json``; the images are there already.

    Args:
        folder: the scene's.
        shots: all images.
        world: where the scene is.
        model: the lenses' camera model.
        cut_out: whether the images have mattes: there is nothing around what they cut out, and
            the reader finds its box.

    Returns:
        The file.
    """
    path = folder / FILE
    bounds: dict[str, Any] = {"space": world.space, "near": world.near, "far": world.far}
    if world.box is not None:
        bounds["box"] = world.box
    if cut_out and world.space == "contracted":
        bounds = {"space": "world"}
    write_json(
        path,
        {
            "camera_model": model,
            "scene_bounds": bounds,
            "frames": [_frame(shot) for shot in shots],
            "train_filenames": [f"{IMAGES}/{one.name}" for one in shots if not one.held_out],
            "test_filenames": [f"{IMAGES}/{one.name}" for one in shots if one.held_out],
        },
    )
    return path


def _frame(shot: Shot) -> dict[str, Any]:
    matrix = [*shot.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return {
        "file_path": f"{IMAGES}/{shot.name}",
        "time": shot.time,
        **shot.lens,
        "transform_matrix": matrix,
    }
