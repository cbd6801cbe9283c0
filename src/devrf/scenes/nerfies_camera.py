"""``camera/<id>.json``: one image's camera in Nerfies' layout, OpenCV axes."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import AliasChoices, BaseModel, Field, TypeAdapter
from torch import Tensor

from devrf.geometry.cameras import Distortion
from devrf.scenes.intrinsics import Intrinsics
from devrf.scenes.json_files import Number, Positive, Vector2, Vector3, read_json
from devrf.scenes.paths import inside
from devrf.scenes.poses import FARTHEST, in_reach, is_rotation
from devrf.scenes.validation import scene_error


class Camera(BaseModel):
    """What a camera file says; pixels are those of the full image.

    Attributes:
        orientation: rows of the world-to-camera rotation.
        position: of the camera, in the file's units.
        focal_length: pixels, horizontally.
        pixel_aspect_ratio: vertical over horizontal focal length.
        skew: pixels.
        image_size: width, height.
        principal_point: pixels.
        radial_distortion: k1, k2, k3.
        tangential_distortion: p1, p2; the example in Nerfies' documentation says "tangential".
    """

    orientation: tuple[Vector3, Vector3, Vector3]
    position: Vector3
    focal_length: Positive
    pixel_aspect_ratio: Positive = 1.0
    skew: Number = 0.0
    image_size: tuple[Positive, Positive]
    principal_point: Vector2
    radial_distortion: Vector3 = (0.0, 0.0, 0.0)
    tangential_distortion: Vector2 = Field(
        (0.0, 0.0), validation_alias=AliasChoices("tangential", "tangential_distortion")
    )


_CAMERA = TypeAdapter(Camera)


def read_camera(
    folder: Path, item: str, center: tuple[float, float, float], scale: float
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
        DevrfError: the file is missing, or a value in it is wrong.
    """
    file = inside(folder, folder / "camera", f"{item}.json", folder / "dataset.json")
    camera = read_json(file, _CAMERA, "every image needs its camera; add it")
    focal = camera.focal_length
    return _pose(camera, file, center, scale), Intrinsics(
        None,
        (focal, focal * camera.pixel_aspect_ratio),
        camera.principal_point,
        camera.image_size,
        Distortion((*camera.radial_distortion, 0.0), camera.tangential_distortion),
        camera.skew,
    )


def _pose(camera: Camera, file: Path, center: tuple[float, float, float], scale: float) -> Tensor:
    world_to_camera = torch.tensor(camera.orientation, dtype=torch.float64)
    if not bool(is_rotation(world_to_camera)):
        raise scene_error(
            file,
            "orientation is no rotation (scaled, sheared or mirrored axes); correct it",
        )
    # OpenCV's y points down and its z ahead; ours point up and back.
    axes = world_to_camera.T * world_to_camera.new_tensor([1, -1, -1])
    where = (axes.new_tensor(camera.position) - axes.new_tensor(center)) * scale
    if not bool(in_reach(where)):
        raise scene_error(
            file,
            f"position is farther than {FARTHEST:g} from the scene's center, in units of "
            "scene.json; correct it, or center and scale there",
        )
    return torch.cat([axes, where[:, None]], dim=1).float()
