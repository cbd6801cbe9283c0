"""Lenses of cameras: focal lengths, principal point, skew, distortion, and how files state them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel

from devrf.geometry.cameras import Distortion
from devrf.scenes.files import Number, Positive
from devrf.scenes.validation import same_shape, scene_error
from devrf.system.options import abbreviated

# Focal lengths as shares of the image's longer side: a view of 0.0006 to 178.9 degrees.
LEAST_FOCAL = 0.01
MOST_FOCAL = 1e5
# Largest distance of the principal point from the image, and largest skew: images are cropped.
MOST_OFFSET = 1e3


@dataclass(frozen=True)
class Lens:
    """One image's lens, in pixels of an image of one size.

    A direction (x, y, 1), x right and y down, falls on the pixel
    (fx·x' + skew·y' + cx, fy·y' + cy), where (x', y') is (x, y) after the distortion.

    Attributes:
        focal: (fx, fy) in pixels.
        center: (cx, cy) in pixels; (0, 0) is the outer corner of the top-left pixel.
        distortion: of the directions; none for a pinhole.
        skew: pixels; 0 where the sensor's axes are square to one another.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    distortion: Distortion = Distortion()
    skew: float = 0.0

    @property
    def pinhole(self) -> bool:
        """Whether the image is already that of a pinhole camera."""
        return self.distortion.none and self.skew == 0

    def fits(self, width: int, height: int) -> bool:
        """Whether it can be the lens of an image of ``width`` × ``height`` pixels."""
        side = max(width, height)
        # NaN compares false.
        return all(LEAST_FOCAL * side <= f <= MOST_FOCAL * side for f in self.focal) and all(
            abs(offset) <= MOST_OFFSET * side for offset in (*self.center, self.skew)
        )

    def scaled(self, x: float, y: float) -> Lens:
        """The same lens for an image whose sides are ``x`` and ``y`` times as long."""
        fx, fy = self.focal
        cx, cy = self.center
        return Lens((fx * x, fy * y), (cx * x, cy * y), self.distortion, self.skew * x)


# Models of the one equation that Distortion states; the simpler ones leave coefficients out.
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_LEAST_ANGLE = 1 / MOST_FOCAL
_UNDISTORT = "undistort the images and list them as PINHOLE"


def _supported(model: object) -> object:
    if model not in CAMERA_MODELS:
        raise ValueError(
            f"{abbreviated(model)} is not supported, only {', '.join(CAMERA_MODELS)}; {_UNDISTORT}"
        )
    return model


def _no_fisheye(value: object) -> object:
    if value:
        raise ValueError(f"a fisheye is not supported; {_UNDISTORT}")
    return value


class CameraKeys(BaseModel):
    """The keys of a camera, in a transforms file or in one of its frames.

    Attributes:
        fl_x: focal length in pixels of an image of ``w`` × ``h``; None: that of the angle.
        fl_y: as ``fl_x``; without an angle, too, pixels are square.
        cx: principal point in pixels, outside a cropped image; None: the image's middle.
        cy: as ``cx``.
        w: width of the image that pixels are measured in; None: the file's.
        h: as ``w``.
        camera_angle_x: horizontal field of view in radians.
        camera_angle_y: vertical field of view in radians.
        camera_model: one of :data:`CAMERA_MODELS`.
        is_fisheye: must be false.
        k1: with ``k2`` to ``k4``, radial distortion.
        p1: with ``p2``, tangential distortion.
    """

    fl_x: Positive | None = None
    fl_y: Positive | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Positive | None = None
    h: Positive | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    camera_model: Annotated[Any, AfterValidator(_supported)] = "OPENCV"
    is_fisheye: Annotated[Any, AfterValidator(_no_fisheye)] = False
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0


KEYS = set(CameraKeys.model_fields)
FOCAL = {"fl_x", "fl_y"}
ANGLES = {"camera_angle_x", "camera_angle_y"}


@dataclass(frozen=True)
class Intrinsics:
    """A camera's intrinsics, for images of any size where an angle gives them.

    Attributes:
        focal: (fx, fy) in pixels, None where an angle gives it, or the other one.
        center: (cx, cy) in pixels; None means the image's middle.
        size: (width, height) of the image that pixels are measured in; None: the file's.
        distortion: of the lens.
        skew: pixels; 0 where the sensor's axes are square to one another.
        angles: fields of view in radians, horizontal and vertical; None: unknown.
    """

    focal: tuple[float | None, float | None]
    center: tuple[float | None, float | None]
    size: tuple[float, float] | None = None
    distortion: Distortion = Distortion()
    skew: float = 0.0
    angles: tuple[float | None, float | None] = (None, None)

    def lens(self, width: int, height: int, where: object) -> Lens:
        """The lens in pixels of a file of ``width`` × ``height`` pixels.

        DevrfError if ``where``, the file, has another shape than its camera, or a camera that
        cannot be an image's.
        """
        w, h = (width, height) if self.size is None else self.size
        if not same_shape((width, height), (w, h)):
            raise scene_error(
                where,
                f"{width}x{height} px, but its camera is one for {w:g}x{h:g} px; correct one",
            )
        fx, fy = (
            side / 2 / math.tan(angle / 2) if focal is None and angle is not None else focal
            for focal, angle, side in zip(self.focal, self.angles, (w, h), strict=True)
        )
        square = fx or fy
        assert square is not None  # intrinsics_of asks for one
        cx, cy = self.center
        center = (w / 2 if cx is None else cx, h / 2 if cy is None else cy)
        lens = Lens((square, fy or square), center, self.distortion, self.skew)
        lens = lens.scaled(width / w, height / h)
        if not lens.fits(width, height):
            fx, fy = lens.focal
            x, y = lens.center
            raise scene_error(
                where,
                f"its camera cannot be one of {width}x{height} px: focal lengths {fx:g} and "
                f"{fy:g} px, middle {x:g}, {y:g}, skew {lens.skew:g}; correct them",
            )
        return lens


def intrinsics_of(camera: CameraKeys, where: object) -> Intrinsics:
    """The intrinsics that the keys of a file, or of one of its frames, state.

    A focal length counts before the angle of its axis. DevrfError if ``where`` has neither, an
    angle out of range, or one side of the image alone.
    """
    c = camera
    distortion = Distortion((c.k1, c.k2, c.k3, c.k4), (c.p1, c.p2))
    size = None if c.w is None or c.h is None else (c.w, c.h)
    if size is None and (c.w or c.h):
        raise scene_error(where, '"w" and "h" go together, and one of them is missing; add it')
    focal = (c.fl_x, c.fl_y)
    angles = (c.camera_angle_x, c.camera_angle_y)
    if c.fl_x is None and angles == (None, None):
        raise scene_error(
            where, 'has no "camera_angle_x" (radians) and no "fl_x" (pixels); add one'
        )
    for axis, length, angle in zip("xy", focal, angles, strict=True):
        if length is None and angle is not None and not _LEAST_ANGLE <= angle < math.pi:
            key = f"camera_angle_{axis}"
            raise scene_error(
                where, f"{key} is {angle}, expected radians between 0 and pi; correct it"
            )
    return Intrinsics(focal, (c.cx, c.cy), size, distortion, angles=angles)


def frame_intrinsics(shared: CameraKeys, frame: CameraKeys, where: object) -> Intrinsics | None:
    """The intrinsics of a frame that brings its own, over the shared ones; else None."""
    own = frame.model_dump(include=KEYS, exclude_unset=True)
    if not own:
        return None
    # A frame's own focal length replaces the file's angles; its own angle, focal lengths, too.
    others = ANGLES if "fl_x" in own else FOCAL | ANGLES if own.keys() & ANGLES else set()
    merged = shared.model_dump(include=KEYS - others, exclude_unset=True) | own
    return intrinsics_of(CameraKeys.model_construct(**merged), where)
