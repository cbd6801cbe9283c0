"""The cushion: a large body of fine texture that turns, bends and twists (non-rigid motion).

It fills a third of a picture. It misleads structure from motion that takes it for the world.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.scenes.procedural.assembled import Assembled, Part
from devrf.scenes.procedural.motion import Swing
from devrf.scenes.procedural.solids import Material, Paint, Rgb, Xyz
from devrf.scenes.procedural.surroundings import WAVES, WEAVE, mural

# Its base; x right, y up, the cameras look along −z from about the origin.
BASE: Xyz = (0.0, -0.70, -2.7)
# Half edges across (x), deep (z) and upright (y).
HALF: Xyz = (0.78, 0.45, 0.72)
MIDDLE: Xyz = (BASE[0], BASE[1] + HALF[2], BASE[2])
# Radius of a ball about the middle that holds it at all times, at speeds of up to 2.
REACH = 1.6
# Factors of the wall's paint.
_TINT: Rgb = (1.0, 0.72, 0.5)
# Radians at time 1 and speed 1: it turns by 50 degrees, and its top by 20 more.
_TURN = Swing(0.87, 1.57, 0.0)
_TWIST = Swing(0.35, 3.0, -0.5)
_BEND = Swing(0.20, 4.0, 0.0)


class Cushion(Assembled):
    """A body of one part, painted as finely as the wall."""

    def __init__(self, speed: float = 1.0) -> None:
        """``speed`` scales turning, bending and twisting."""
        # Columns: the part's x, y and z are the world's x, −z and y.
        axes = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
        part = Part(
            kind="box",
            half=HALF,
            parent=-1,
            base=torch.tensor(BASE, dtype=torch.float64),
            axes=axes,
            hinge=(0.0, 1.0, 0.0),
            paint=Paint(_TINT, _TINT),
            swing=_TURN,
            bend=_BEND,
            twist=_TWIST,
        )
        super().__init__((part,), speed)

    def color(self, material: Material) -> Tensor:
        """The wall's paint, tinted, at the canonical positions."""
        return mural(material.canonical, (*WAVES, *WEAVE)) * material.canonical.new_tensor(_TINT)
