"""The flower's parts as data, at rest: stem on the z axis, petals in two whorls around it.

Lengths in world units, angles in radians.
"""

from __future__ import annotations

from devrf.scenes.procedural.blades import Leaf, Whorl
from devrf.scenes.procedural.texture import Paint, Rgb

BASE = -0.66  # height at which the stem leaves the soil: the centre of the bending
HEAD = 0.30  # height of the blossom's middle
STEM_RADIUS = 0.055
HEART = 0.14  # radius of the ball in the blossom's middle
POT_CENTER, POT_RADIUS, POT_HALF_HEIGHT, POT_ROUNDING = -0.83, 0.34, 0.19, 0.06

# Part numbers: pot, stem, heart, then the leaves, then the petals.
POT, FIRST_LEAF, FIRST_PETAL = 0, 3, 6

MAGENTA: Rgb = (0.84, 0.10, 0.45)
ROSE: Rgb = (0.98, 0.62, 0.75)
VIOLET: Rgb = (0.42, 0.22, 0.70)
LILAC: Rgb = (0.80, 0.70, 0.97)
GOLD: Rgb = (1.00, 0.80, 0.18)
AMBER: Rgb = (0.96, 0.50, 0.08)
CREAM: Rgb = (1.00, 0.94, 0.76)
BROWN: Rgb = (0.35, 0.17, 0.08)
LEAF_GREEN: Rgb = (0.12, 0.48, 0.20)
SPRING: Rgb = (0.62, 0.82, 0.28)
TERRACOTTA: Rgb = (0.78, 0.36, 0.20)
BLUE: Rgb = (0.13, 0.35, 0.62)

# A petal's paint starts at its hinge: cos is 1 there, so that the accent glows at the heart.
OUTER = Whorl(
    first_part=FIRST_PETAL,
    count=8,
    height=HEAD,
    hinge=0.10,
    elevation=0.62,
    opening=0.8,
    half_length=0.3,
    half_width=0.145,
    thickness=0.022,
    paints=(Paint(MAGENTA, ROSE, (0.3, 0, 0), 0.1, 5), Paint(VIOLET, LILAC, (0.3, 0, 0), 0.1, 5)),
)
INNER = Whorl(
    first_part=FIRST_PETAL + OUTER.count,
    count=6,
    height=HEAD,
    hinge=0.07,
    elevation=1.05,
    opening=0.5,
    half_length=0.19,
    half_width=0.095,
    thickness=0.02,
    paints=(Paint(AMBER, CREAM, (0.34, 0, 0), 0.2, 4), Paint(GOLD, CREAM, (0.34, 0, 0), 0.2, 4)),
)
WHORLS = (OUTER, INNER)

LEAVES = (
    Leaf(-0.50, 0.5, 0.55, 0.27, 0.12, 0.02, Paint(LEAF_GREEN, SPRING, (0.22, 0, 0), 0.2)),
    Leaf(-0.32, 3.4, 0.60, 0.25, 0.11, 0.02, Paint(SPRING, LEAF_GREEN, (0, 0.2, 0), 0.2)),
    Leaf(-0.16, 1.9, 0.65, 0.20, 0.10, 0.02, Paint(LEAF_GREEN, SPRING, (0.18, 0, 0), 0.1)),
)

POT_PAINT = Paint(TERRACOTTA, CREAM, (0, 0, 0.26), 0.3)
STEM_PAINT = Paint(LEAF_GREEN, SPRING, (0, 0, 0.24), 0.0)
HEART_PAINT = Paint(BROWN, GOLD, (0.14, 0.14, 0), 0.2, 5)
