"""Scenes computed instead of photographed: every pixel, depth and flow is known exactly."""

from devrf.scenes.procedural.filming import moved
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.recipe import ProceduralForwardScene, ProceduralScene
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.solids import Material, Shape

__all__ = [
    "Flower",
    "Material",
    "Plush",
    "ProceduralForwardScene",
    "ProceduralScene",
    "Robot",
    "Shape",
    "moved",
]
