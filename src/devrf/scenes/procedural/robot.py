"""The robot: rigid parts on joints that turn far and fast (articulated motion)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import rotation
from devrf.scenes.procedural.robot_body import JOINTS, SOLIDS
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.solids import SolidTable

_TABLE = SolidTable(SOLIDS)


@lru_cache(maxsize=256)
def solid_motions(speed: float, time: float) -> Tensor:
    """M_k(time), world ← rest, of the K solids: (K, 3, 4) float64; identity at time 0."""
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
    """An articulated :class:`~devrf.scenes.procedural.shape.Shape`; its parts are its solids.

    The distance at t is min_k sdf_k(M_k(t)⁻¹ x).

    Attributes:
        speed: scales every joint's angle.
    """

    speed: float = 1.0

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
        return _TABLE.painted.color(material)

    def outline(self) -> Material:
        """Points around the solids: rigid motion keeps a solid inside of its box."""
        return _TABLE.outline()

    def _distances(self, points: Tensor, time: float) -> Tensor:
        """Distance (K, M) to each solid."""
        matrix, offset = _into_solids(self.speed, time)
        local = torch.addmm(offset.to(points), matrix.to(points), points.T)
        return _TABLE.distances(*local.view(3, len(SOLIDS), -1))
