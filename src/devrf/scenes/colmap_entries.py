"""What COLMAP's models list: cameras and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.geometry.cameras import Distortion
from devrf.scenes.intrinsics import Intrinsics
from devrf.scenes.validation import LARGEST, scene_error

# Parameters of each camera model that can be read, in the order of the file.
PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


@dataclass(frozen=True)
class ModelCamera:
    """An entry of ``cameras``.

    Attributes:
        model: one of :data:`PARAMETERS`.
        size: width and height of its images in pixels.
        parameters: in the order of :data:`PARAMETERS`, pixels; (0, 0) is the outer corner of the
            first pixel.
    """

    model: str
    size: tuple[int, int]
    parameters: tuple[float, ...]

    @property
    def keys(self) -> dict[str, float]:
        """The camera as a frame of a transforms file has it: ``fl_x``, ``cx``, ``k1``."""
        given = dict(zip(PARAMETERS[self.model], self.parameters, strict=True))
        fx, fy = (given.pop(name, given.get("f", 0.0)) for name in ("fx", "fy"))
        given.pop("f", None)
        return {"fl_x": fx, "fl_y": fy, "w": self.size[0], "h": self.size[1], **given}

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera as the readers have it."""
        keys = self.keys
        return Intrinsics(
            None,
            (keys["fl_x"], keys["fl_y"]),
            (keys["cx"], keys["cy"]),
            (float(self.size[0]), float(self.size[1])),
            Distortion(
                (keys.get("k1", 0.0), keys.get("k2", 0.0), 0.0, 0.0),
                (keys.get("p1", 0.0), keys.get("p2", 0.0)),
            ),
        )


@dataclass(frozen=True)
class ModelImage:
    """An entry of ``images``.

    Attributes:
        name: relative to the folder of images.
        camera: number of its camera.
        quaternion: w, x, y, z of the world-to-camera rotation, x right, y down, z ahead.
        translation: of the same.
        points: (K,) int64, numbers of the points that it shows.
    """

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    points: npt.NDArray[np.int64]


def checked_camera(
    file: Path, model: object, size: tuple[int, int], parameters: tuple[float, ...]
) -> ModelCamera:
    """An entry of ``cameras``.

    Raises:
        DevrfError: its model is not supported, or a number is wrong.
    """
    if model not in PARAMETERS:
        raise scene_error(
            file,
            f"camera model {model} is not supported, only {', '.join(PARAMETERS)}; run COLMAP's "
            "image_undistorter, and give its folder",
        )
    name = str(model)
    if len(parameters) != len(PARAMETERS[name]):
        raise scene_error(
            file,
            f"a camera of model {name} has {len(parameters)} parameters, expected "
            f"{len(PARAMETERS[name])}; write it again",
        )
    if (
        min(size) < 1
        or max(size) >= LARGEST
        or not np.isfinite(parameters).all()
        or parameters[0] <= 0
    ):
        raise scene_error(
            file, f"a camera has size {size} and parameters {parameters}; write it again"
        )
    return ModelCamera(name, size, parameters)
