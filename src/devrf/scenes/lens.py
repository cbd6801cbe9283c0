"""The inner numbers of a camera, as files give them: focal lengths, middle, skew, distortion."""

from __future__ import annotations

from dataclasses import dataclass

from devrf.geometry.cameras import Distortion

# Focal lengths as shares of the image's longer side: a view of 0.0006 to 178.9 degrees.
LEAST_FOCAL = 0.01
MOST_FOCAL = 1e5
# How far from the image its principal point, or its skew, may be: images are cropped.
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
        (fx, fy), (cx, cy) = self.focal, self.center
        return Lens((fx * x, fy * y), (cx * x, cy * y), self.distortion, self.skew * x)
