"""Scenes computed instead of photographed: every pixel, depth and flow is known exactly."""

from devrf.scenes.procedural.builder import ProceduralScene
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.forward import ProceduralForwardScene
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.shape import Material, Shape
from devrf.scenes.procedural.truth import moved

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
