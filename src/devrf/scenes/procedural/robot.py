"""The robot: rigid parts on joints that turn far and fast (articulated motion)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import rotation
from devrf.scenes.procedural.robot_body import JOINTS, SOLIDS
from devrf.scenes.procedural.sdf import rounded_box
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.texture import PaintedParts

# (3, K, 1) and (K, 1): they broadcast against coordinates (K, M).
_HALF = torch.tensor([s.half for s in SOLIDS]).T[..., None]
_ROUNDING = torch.tensor([s.rounding for s in SOLIDS])[:, None]


@lru_cache(maxsize=256)
def solid_motions(speed: float, time: float) -> Tensor:
    """M_k(time), world ← rest, of the K solids: (K, 3, 4) float64; identity at time 0."""
    links = {"": torch.eye(4, dtype=torch.float64)}
    for joint in JOINTS:
        angle = speed * joint.amplitude * joint.swing(time)
        pivot = torch.tensor(joint.pivot, dtype=torch.float64)
        hinge = torch.eye(4, dtype=torch.float64)
        hinge[:3, :3] = rotation(joint.axis, angle)
        hinge[:3, 3] = pivot - hinge[:3, :3] @ pivot
        links[joint.name] = links[joint.parent] @ hinge
    return torch.stack([links[solid.link][:3] for solid in SOLIDS])


@lru_cache(maxsize=256)
def _into_solids(speed: float, time: float) -> tuple[Tensor, Tensor]:
    """Matrix (3·K, 3) and offset (3·K, 1), float32, from the world to the solids' centres.

    All the x rows come first, then all y, then all z: one product serves every solid.
    """
    motion = solid_motions(speed, time)
    center = torch.tensor([solid.center for solid in SOLIDS], dtype=torch.float64)
    backward = motion[:, :, :3].transpose(1, 2)
    offset = -(backward @ motion[:, :, 3:]).squeeze(-1) - center
    matrix = backward.transpose(0, 1).reshape(-1, 3)
    return matrix.float(), offset.T.reshape(-1, 1).float()


@dataclass(frozen=True)
class Robot:
    """An articulated :class:`~devrf.scenes.procedural.shape.Shape`; its parts are its solids.

    The distance at t is min_k sdf_k(M_k(t)⁻¹ x).

    Attributes:
        speed: scales every joint's angle.
    """

    speed: float = 1.0
    _paints: PaintedParts = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        center = torch.tensor([s.center for s in SOLIDS], dtype=torch.float64)
        upright = torch.eye(3, dtype=torch.float64).repeat(len(SOLIDS), 1, 1)
        paints = PaintedParts.of([s.paint for s in SOLIDS], upright, center)
        object.__setattr__(self, "_paints", paints)

    def distance(self, points: Tensor, time: float) -> Tensor:
        """Exact distance (M,) outside of the nearest solid."""
        return self._distances(points, time).amin(dim=0)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest solid's material: M_k(t)⁻¹ x."""
        part = self._distances(points, time).argmin(dim=0)
        motion = solid_motions(self.speed, time).to(points)[part]
        rest = torch.einsum("mji,mj->mi", motion[:, :, :3], points - motion[:, :, 3])
        return Material(rest, part)

    def forward(self, material: Material, time: float) -> Tensor:
        """M_k(t) x of each point's own solid."""
        motion = solid_motions(self.speed, time).to(material.rest)[material.part]
        return torch.einsum("mij,mj->mi", motion[:, :, :3], material.rest) + motion[:, :, 3]

    def color(self, material: Material) -> Tensor:
        """The solids' paints."""
        return self._paints.color(material.rest, material.part)

    def outline(self) -> Material:
        """The solids' eight corners each: rigid motion keeps a solid inside of its corners."""
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
        center = torch.tensor([s.center for s in SOLIDS])
        corners = center[:, None] + signs * _HALF.permute(1, 2, 0)
        part = torch.arange(len(SOLIDS))[:, None].expand(-1, 8)
        return Material(corners.reshape(-1, 3), part.reshape(-1))

    def _distances(self, points: Tensor, time: float) -> Tensor:
        """Distance (K, M) to each solid."""
        matrix, offset = _into_solids(self.speed, time)
        local = torch.addmm(offset.to(points), matrix.to(points), points.T)
        x, y, z = local.view(3, len(SOLIDS), -1)
        width, depth, height = _HALF.to(points)
        return rounded_box(x, y, z, (width, depth, height), _ROUNDING.to(points))
