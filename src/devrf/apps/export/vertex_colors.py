"""Colours of a surface's vertices: what a short ray into the field sees."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.rendering.surface_field import SurfaceField

# Vertices whose colour is found at once.
CHUNK = 2**13
# Where a ray begins and ends, in voxels behind the vertex, and how far its samples are apart.
BEFORE, BEHIND, STEP = -1.0, 3.0, 0.25
# Samples with a smaller share of what is seen are left out.
SIGNIFICANT = 0.01
# Directions over which colours are averaged, and the widest, in degrees off the normal.
DIRECTIONS, WIDEST = 16, 60.0


def vertex_colors(
    field: SurfaceField, points: Tensor, faces: Tensor, normals: Tensor, *, averaged: bool
) -> Tensor:
    """RGB (V, 3) in [0, 1] of vertices.

    A vertex lies where matter begins, and there the field's colours are not yet learned: its own
    is that of a ray that goes straight in, Σ w_i c_i / Σ w_i (docs/method.md#compositing).

    Args:
        field: at rest, on the host.
        points: (V, 3) in the fields' space.
        faces: (F, 3) int64, counter-clockwise from outside in that space.
        normals: (V, 3) unit normals, outward in the world.
        averaged: over directions up to 60 degrees off the normal; False: along the normal.
    """
    box = field.box
    low, _ = box.corners(points)
    voxel = points.new_tensor(box.size) / (points.new_tensor(field.shape) - 1)
    inward = -voxel * vertex_normals((points - low) / voxel, faces)
    eyes = _cap(DIRECTIONS, math.radians(WIDEST)) if averaged else torch.eye(3)[2:]
    found = [
        _seen(field, points[k : k + CHUNK], inward[k : k + CHUNK], normals[k : k + CHUNK], eyes)
        for k in range(0, len(points), CHUNK)
    ]
    return torch.cat(found).clamp(0, 1)


def _seen(
    field: SurfaceField, points: Tensor, inward: Tensor, normals: Tensor, toward_eyes: Tensor
) -> Tensor:
    """RGB (V, 3), the mean over the directions (K, 3), each weighted by its cosine."""
    way = torch.arange(BEFORE, BEHIND + STEP / 2, STEP)
    samples = points[:, None] + way[:, None] * inward[:, None]
    depth = STEP * field.optical_depth(samples.reshape(-1, 3)).view(samples.shape[:2])
    weight = torch.exp(depth - depth.cumsum(dim=1)) * -torch.expm1(-depth)
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-9)
    vertex, sample = (weight > SIGNIFICANT).nonzero(as_tuple=True)
    share, where = weight[vertex, sample, None], samples[vertex, sample]
    frames = _frames(normals)
    seen, total = torch.zeros_like(points), toward_eyes[:, 2].sum()
    for direction in toward_eyes:
        viewdirs = -(frames @ direction)
        color = field.color(where, viewdirs[vertex])
        seen.index_add_(0, vertex, share * color * (direction[2] / total))
    kept = torch.zeros(len(points)).index_add_(0, vertex, share[:, 0])
    return seen / kept.clamp(min=1e-9)[:, None]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V, 3): the means over the faces (F, 3) around, weighted by area."""
    a, b, c = vertices[faces].unbind(dim=1)
    across, normals = torch.linalg.cross(b - a, c - a), torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, faces[:, corner], across)
    return normalize(normals, dim=1)


def _cap(count: int, widest: float) -> Tensor:
    """Unit vectors (K, 3), evenly spread over the cap of ``widest`` radians about +z."""
    k = torch.arange(count) + 0.5
    z = 1 - (1 - math.cos(widest)) * k / count
    around = math.pi * (1 + math.sqrt(5)) * k
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * around.cos(), radius * around.sin(), z], dim=1)


def _frames(normals: Tensor) -> Tensor:
    """Rotations (V, 3, 3) that lead +z to the normals."""
    x, _, z = torch.eye(3)
    helper = torch.where(normals[:, 2:].abs() < 0.9, z, x)
    right = normalize(torch.linalg.cross(helper, normals), dim=1)
    return torch.stack([right, torch.linalg.cross(normals, right), normals], dim=2)
