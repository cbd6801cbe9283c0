"""The robot: rigid parts on joints that turn far and fast (articulated motion).

Canonically it stands with its arms stretched out, faces −y and has its left hand at +x. Lengths in
world units, angles in radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import Swing, rotation
from devrf.scenes.procedural.solids import Material, Paint, Rgb, Solid, SolidTable, Xyz

X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Joint:
    """A hinge: it turns by speed · swing(t) about ``axis`` through ``pivot``.

    Attributes:
        name: of the link that it moves.
        parent: the link that carries it, "" for the world.
        pivot: a point on the canonical axis.
        axis: unit direction of the canonical axis.
        swing: its angle over time.
    """

    name: str
    parent: str
    pivot: Xyz
    axis: Xyz
    swing: Swing


# A parent stands before its children.
JOINTS = (
    Joint("lean", "", (0, 0, -0.14), X, Swing(0.20, 2.0, 0.0)),
    Joint("torso", "lean", (0, 0, -0.14), Z, Swing(0.95, 1.2, -0.5)),
    Joint("nod", "torso", (0, 0, 0.44), Y, Swing(-0.3, 1.8, 0.0)),
    Joint("head", "nod", (0, 0, 0.44), Z, Swing(-0.7, 2.4, 0.0)),
    Joint("left shoulder", "torso", (0.34, 0, 0.3), Y, Swing(-0.9, 1.7, 0.1)),
    Joint("left swing", "left shoulder", (0.34, 0, 0.3), Z, Swing(-0.3, 1.6, -1.0)),
    Joint("left elbow", "left swing", (0.62, 0, 0.3), Y, Swing(-0.6, 2.2, -1.3)),
    Joint("right shoulder", "torso", (-0.34, 0, 0.3), Y, Swing(-0.9, 1.5, 0.0)),
    Joint("right swing", "right shoulder", (-0.34, 0, 0.3), Z, Swing(0.35, 1.8, -1.0)),
    Joint("right elbow", "right swing", (-0.62, 0, 0.3), Z, Swing(0.6, 2.2, -1.2)),
    Joint("right hip", "", (-0.17, 0, -0.32), X, Swing(-1.2, 1.3, 0.0)),
    Joint("right knee", "right hip", (-0.17, 0, -0.63), X, Swing(0.75, 2.2, -0.8)),
)

ORANGE: Rgb = (0.95, 0.47, 0.10)
CREAM: Rgb = (0.98, 0.90, 0.72)
TEAL: Rgb = (0.05, 0.55, 0.58)
NAVY: Rgb = (0.09, 0.16, 0.38)
SKY: Rgb = (0.38, 0.72, 0.95)
RED: Rgb = (0.86, 0.13, 0.16)
YELLOW: Rgb = (0.99, 0.82, 0.16)
GREEN: Rgb = (0.20, 0.62, 0.24)
LIME: Rgb = (0.72, 0.87, 0.25)
PURPLE: Rgb = (0.44, 0.20, 0.62)
PINK: Rgb = (0.96, 0.52, 0.68)
STEEL: Rgb = (0.42, 0.46, 0.52)
INK: Rgb = (0.08, 0.08, 0.12)


def _plain(color: Rgb) -> Paint:
    return Paint(color, color)


def _arm(side: float, name: str, upper: Paint, lower: Paint, hand: Paint) -> tuple[Solid, ...]:
    """An arm stretched out along x; ``side`` is +1 on the left, −1 on the right."""
    return (
        Solid((side * 0.34, 0, 0.3), (0.12, 0.12, 0.12), 0.12, _plain(STEEL), f"{name} swing"),
        Solid((side * 0.49, 0, 0.3), (0.18, 0.09, 0.09), 0.08, upper, f"{name} swing"),
        Solid((side * 0.76, 0, 0.3), (0.18, 0.105, 0.105), 0.08, lower, f"{name} elbow"),
        Solid((side * 0.98, 0, 0.3), (0.11, 0.08, 0.12), 0.07, hand, f"{name} elbow"),
    )


def _leg(side: float, thigh: str, shin: str, paint: Paint, foot: Paint) -> tuple[Solid, ...]:
    """A leg that stands along z, with its two links' names."""
    return (
        Solid((side * 0.17, 0, -0.47), (0.115, 0.115, 0.20), 0.09, paint, thigh),
        Solid((side * 0.17, 0, -0.77), (0.105, 0.105, 0.18), 0.08, paint, shin),
        Solid((side * 0.17, -0.06, -0.97), (0.13, 0.21, 0.085), 0.07, foot, shin),
    )


_BODY = (
    Solid((0, 0, -0.25), (0.29, 0.19, 0.12), 0.08, Paint(NAVY, SKY, (0.28, 0, 0), 0.3)),
    Solid((0, 0, 0.15), (0.31, 0.21, 0.29), 0.09, Paint(ORANGE, CREAM, (0, 0, 0.28), 0.2), "torso"),
    Solid((0, -0.20, 0.17), (0.17, 0.05, 0.14), 0.04, Paint(NAVY, YELLOW, (0.3, 0, 0.26)), "torso"),
    Solid((0, 0.25, 0.16), (0.22, 0.11, 0.22), 0.07, Paint(PURPLE, PINK, (0.28, 0, 0.28)), "torso"),
)
_HEAD = (
    Solid((0, 0, 0.64), (0.26, 0.22, 0.19), 0.09, Paint(TEAL, LIME, (0.32, 0.32, 0), 0.35), "head"),
    Solid((0, -0.20, 0.66), (0.20, 0.05, 0.10), 0.05, _plain(CREAM), "head"),
    Solid((0.09, -0.23, 0.66), (0.06, 0.05, 0.06), 0.05, _plain(INK), "head"),
    Solid((-0.09, -0.23, 0.66), (0.06, 0.05, 0.06), 0.05, _plain(INK), "head"),
    Solid((0, 0, 0.88), (0.035, 0.035, 0.09), 0.035, _plain(STEEL), "head"),
    Solid((0, 0, 0.99), (0.08, 0.08, 0.08), 0.08, _plain(RED), "head"),
)

SOLIDS = (
    *_BODY,
    *_HEAD,
    *_arm(1, "left", Paint(YELLOW, RED, (0.2, 0, 0)), Paint(SKY, NAVY, (0.22, 0, 0)), _plain(RED)),
    *_arm(
        -1,
        "right",
        Paint(CREAM, GREEN, (0.2, 0, 0)),
        Paint(PINK, PURPLE, (0.22, 0, 0)),
        _plain(GREEN),
    ),
    *_leg(1, "", "", Paint(SKY, TEAL, (0, 0, 0.22)), Paint(ORANGE, RED, (0, 0.3, 0))),
    *_leg(
        -1,
        "right hip",
        "right knee",
        Paint(LIME, GREEN, (0, 0, 0.22)),
        Paint(YELLOW, PURPLE, (0, 0.3, 0)),
    ),
)


_TABLE = SolidTable(SOLIDS)
# Points whose distances are computed at once: more leave the cache, and take memory.
AT_ONCE = 8192


@lru_cache(maxsize=256)
def solid_motions(speed: float, time: float) -> Tensor:
    """M_k(time), world ← canonical, of the K solids: (K, 3, 4) float64; identity at time 0."""
    links = {"": torch.eye(4, dtype=torch.float64)}
    for joint in JOINTS:
        pivot = torch.tensor(joint.pivot, dtype=torch.float64)
        hinge = torch.eye(4, dtype=torch.float64)
        hinge[:3, :3] = rotation(joint.axis, joint.swing(speed, time))
        hinge[:3, 3] = pivot - hinge[:3, :3] @ pivot
        links[joint.name] = links[joint.parent] @ hinge
    return torch.stack([links[solid.link][:3] for solid in SOLIDS])


@lru_cache(maxsize=256)
def _into_solids(speed: float, time: float) -> tuple[Tensor, Tensor]:
    """Matrix (3·K, 3) and offset (3·K, 1), float32, from the world to the solids' centres.

    All the x rows come first, then all y, then all z: one product serves every solid.
    """
    motion = solid_motions(speed, time)
    backward = motion[:, :, :3].transpose(1, 2)
    offset = -(backward @ motion[:, :, 3:]).squeeze(-1) - _TABLE.center
    matrix = backward.transpose(0, 1).reshape(-1, 3)
    return matrix.float(), offset.T.reshape(-1, 1).float()


@dataclass(frozen=True)
class Robot:
    """An articulated :class:`~devrf.scenes.procedural.solids.Shape`; its parts are its solids.

    The distance at t is min_k sdf_k(M_k(t)⁻¹ x).

    Attributes:
        speed: scales every joint's angle.
    """

    speed: float = 1.0

    def distance(self, points: Tensor, time: float) -> Tensor:
        """Exact distance (M,) outside of the nearest solid."""
        some = torch.split(points, AT_ONCE)
        return torch.cat([self._distances(each, time).amin(dim=0) for each in some])

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest solid's material: M_k(t)⁻¹ x."""
        part = self._distances(points, time).argmin(dim=0)
        motion = solid_motions(self.speed, time).to(points)[part]
        canonical = torch.einsum("mji,mj->mi", motion[:, :, :3], points - motion[:, :, 3])
        return Material(canonical, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """M_k(t) x of each point's own solid."""
        motion = solid_motions(self.speed, time).to(material.canonical)[material.part]
        return torch.einsum("mij,mj->mi", motion[:, :, :3], material.canonical) + motion[:, :, 3]

    def color(self, material: Material) -> Tensor:
        """The solids' paints."""
        return _TABLE.painted.color(material)

    def outline(self) -> Material:
        """Points around the solids: rigid motion keeps a solid inside of its box."""
        return _TABLE.outline()

    def _distances(self, points: Tensor, time: float) -> Tensor:
        """Distance (K, M) to each solid."""
        matrix, offset = _into_solids(self.speed, time)
        local = torch.addmm(offset.to(points), matrix.to(points), points.T)
        x, y, z = local.view(3, len(SOLIDS), -1)
        return _TABLE.distances(x, y, z)
