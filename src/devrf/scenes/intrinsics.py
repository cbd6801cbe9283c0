"""Inner numbers of cameras in transforms files: pixels or an angle, shared or of one frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from devrf.geometry.distortion import Distortion
from devrf.scenes.lens import MOST_FOCAL, Lens
from devrf.scenes.validation import abbreviated, number, same_shape, scene_error

# Models of the one equation that Distortion states; the simpler ones leave coefficients out.
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
KEYS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "camera_angle_x",
    "camera_model",
    "is_fisheye",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
)
_LEAST_ANGLE = 1 / MOST_FOCAL


@dataclass(frozen=True)
class Intrinsics:
    """A camera's inner numbers, for images of any size where an angle gives them.

    Attributes:
        angle_x: horizontal field of view in radians, or None when ``focal`` is given.
        focal: (fx, fy) in pixels, or None.
        center: (cx, cy) in pixels; None means the image's middle.
        size: (width, height) of the image that pixels are counted in; None: the file's.
        distortion: of the lens.
        skew: pixels; 0 where the sensor's axes are square to one another.
    """

    angle_x: float | None
    focal: tuple[float, float] | None
    center: tuple[float | None, float | None]
    size: tuple[float, float] | None = None
    distortion: Distortion = Distortion()
    skew: float = 0.0

    def lens(self, width: int, height: int, where: object) -> Lens:
        """The lens in pixels of a file of ``width`` × ``height`` pixels.

        Raises:
            DevrfError: ``where``, the file, has another shape than its camera, or a camera of
                which it can show nothing.
        """
        w, h = (width, height) if self.size is None else self.size
        if not same_shape((width, height), (w, h)):
            raise scene_error(
                where,
                f"{width}x{height} px, but its camera is one for {w:g}x{h:g} px; crop or "
                "turn the image back, or correct the camera's size",
            )
        if self.focal is not None:
            focal = self.focal
        else:
            assert self.angle_x is not None  # read_intrinsics asks for one of the two
            square = w / 2 / math.tan(self.angle_x / 2)
            focal = (square, square)
        cx, cy = self.center
        center = (w / 2 if cx is None else cx, h / 2 if cy is None else cy)
        lens = Lens(focal, center, self.distortion, self.skew).scaled(width / w, height / h)
        if not lens.fits(width, height):
            (fx, fy), (x, y) = lens.focal, lens.center
            raise scene_error(
                where,
                f"its camera cannot be one of {width}x{height} px: focal lengths {fx:g} and "
                f"{fy:g} px, middle {x:g}, {y:g}, skew {lens.skew:g}; correct them",
            )
        return lens


def read_intrinsics(content: dict[str, Any], where: object) -> Intrinsics:
    """The intrinsics among the keys of a transforms file, or of one of its frames.

    ``fl_x``, ``fl_y``, ``cx``, ``cy`` in pixels of an image of ``w`` × ``h``, or
    ``camera_angle_x`` in radians; ``k1`` to ``k4``, ``p1``, ``p2``; ``camera_model``.

    Raises:
        DevrfError: no focal length, a value that is none, or a model that is not supported.
    """

    def pixels(key: str) -> float | None:
        if key not in content:
            return None
        value = number(content[key])
        if value is None or value <= 0:
            raise scene_error(
                where, f"{key} is {abbreviated(content[key])}, expected pixels > 0; correct it"
            )
        return value

    def coefficient(key: Literal["k1", "k2", "k3", "k4", "p1", "p2"]) -> float:
        value = number(content.get(key, 0.0))
        if value is None:
            raise scene_error(
                where, f"{key} is {abbreviated(content[key])}, expected a number; correct it"
            )
        return value

    _check_model(content, where)
    distortion = Distortion(
        (coefficient("k1"), coefficient("k2"), coefficient("k3"), coefficient("k4")),
        (coefficient("p1"), coefficient("p2")),
    )
    center = pixels("cx"), pixels("cy")
    fx, fy, w, h = pixels("fl_x"), pixels("fl_y"), pixels("w"), pixels("h")
    size = None if w is None or h is None else (w, h)
    if fx is not None:
        return Intrinsics(None, (fx, fx if fy is None else fy), center, size, distortion)
    if "camera_angle_x" not in content:
        raise scene_error(
            where, 'has no "camera_angle_x" (radians) and no "fl_x" (pixels); add one'
        )
    angle = number(content["camera_angle_x"])
    if angle is None or not _LEAST_ANGLE <= angle < math.pi:
        raise scene_error(
            where,
            f"camera_angle_x is {abbreviated(content['camera_angle_x'])}, expected radians "
            "between 0 and pi; correct it",
        )
    return Intrinsics(angle, None, center, size, distortion)


def frame_intrinsics(
    shared: dict[str, Any], frame: dict[str, Any], where: object
) -> Intrinsics | None:
    """The intrinsics of a frame that brings its own, over the shared ones; None: it brings none.

    Raises:
        DevrfError: what :func:`read_intrinsics` raises.
    """
    own = {key: frame[key] for key in KEYS if key in frame}
    if not own:
        return None
    merged = {key: shared[key] for key in KEYS if key in shared} | own
    if "camera_angle_x" in own and "fl_x" not in own:
        # Its angle stands against focal lengths of other images.
        merged = {key: value for key, value in merged.items() if key not in ("fl_x", "fl_y")}
    return read_intrinsics(merged, where)


def _check_model(content: dict[str, Any], where: object) -> None:
    model = content.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS or content.get("is_fisheye"):
        kind = "a fisheye" if content.get("is_fisheye") else abbreviated(model)
        raise scene_error(
            where,
            f"camera model {kind} is not supported, only {', '.join(CAMERA_MODELS)}; "
            "undistort the images and list them as PINHOLE",
        )
