"""The plush toy's body as data: rounded boxes, relative to its base, in world units."""

from __future__ import annotations

from devrf.scenes.procedural.solids import Solid, Xyz
from devrf.scenes.procedural.texture import Paint, Rgb

# Where the toy stands: x right, y up, the cameras look along −z from about the origin.
BASE: Xyz = (0.0, -0.72, -2.6)
# Radius of a ball about the base that holds the toy at rest.
REACH = 1.5


ROSE: Rgb = (0.93, 0.55, 0.62)
CREAM: Rgb = (0.98, 0.91, 0.78)
WINE: Rgb = (0.55, 0.12, 0.26)
INK: Rgb = (0.08, 0.07, 0.12)
SKY: Rgb = (0.30, 0.60, 0.90)
LEMON: Rgb = (0.98, 0.85, 0.25)
MINT: Rgb = (0.35, 0.75, 0.55)

_FUR = Paint(ROSE, CREAM, (0.30, 0.30, 0.30), 0.25)
_SLEEVE = Paint(LEMON, MINT, (0.16, 0, 0))
_SOLE = Paint(WINE, ROSE, (0.22, 0, 0.22), 0.3)
_EAR = Paint(WINE, ROSE, (0, 0.24, 0), 0.1)
_EYE = Paint(INK, INK)


def _pair(center: Xyz, half: Xyz, rounding: float, paint: Paint) -> tuple[Solid, Solid]:
    """The same solid on the right and, mirrored, on the left."""
    x, y, z = center
    return Solid(center, half, rounding, paint), Solid((-x, y, z), half, rounding, paint)


SOLIDS = (
    Solid((0, 0.42, 0), (0.34, 0.40, 0.27), 0.24, Paint(SKY, LEMON, (0, 0.26, 0))),
    Solid((0, 0.98, 0.02), (0.30, 0.26, 0.26), 0.23, _FUR),
    Solid((0, 0.92, 0.28), (0.13, 0.09, 0.08), 0.08, Paint(WINE, CREAM, (0.13, 0, 0), -0.2)),
    *_pair((0.25, 1.25, 0), (0.10, 0.15, 0.06), 0.06, _EAR),
    *_pair((0.11, 1.06, 0.25), (0.045, 0.05, 0.045), 0.045, _EYE),
    *_pair((0.46, 0.62, 0.06), (0.21, 0.095, 0.095), 0.09, _SLEEVE),
    *_pair((0.20, 0.09, 0.16), (0.13, 0.09, 0.18), 0.08, _SOLE),
)
