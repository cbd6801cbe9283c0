"""A coloured mesh of a scene at rest, of a wanted size."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.apps.export.geometry import ExportSettings, Surface, halfway, vertex_normals
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import Space
from devrf.rendering.renderable import Renderable
from devrf.rendering.view import SurfaceField

# Points at which a field is evaluated at once.
CHUNK = 2**18
# The least optical depth of a voxel, so that its logarithm is finite.
LEAST = 1e-6
# Rays of each camera, along each side of its image, that say where empty space begins.
ENTRIES = 16

Mesh = tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]


def isosurface(
    field: SurfaceField, device: torch.device, outside: Tensor, threshold: float, side: int | None
) -> Mesh:
    """Marching cubes on a field, as if solid wherever no empty way leads from ``outside``.

    Density is learned where images show it: behind a surface it often falls to nothing again. No
    camera would see a second surface there.

    s = log(eᵗ − 1), t the optical depth, is interpolated between grid points: for a density
    softplus(v + b) it is v + b, which DeVRF interpolates, too (docs/method.md#density).

    Args:
        field: the scene's.
        device: of the field's evaluation.
        outside: (K, 3) points of the fields' space that cameras see through.
        threshold: opacity of one voxel on the surface, in (0, 1).
        side: grid points along the box's longest edge; None: those of the field.

    Returns:
        vertices (V, 3) in the fields' space, and faces (F, 3), counter-clockwise from outside if
        that space is right-handed.

    Raises:
        DevrfError: no point of the field has that opacity, or all have.
    """
    from skimage import measure  # an extra

    box = field.box
    shape = field.shape
    if side is not None:
        x, y, z = (max(2, round(edge / box.longest * (side - 1)) + 1) for edge in box.size)
        shape = (x, y, z)
    points = torch.split(box.grid_points(shape, torch.empty(0)).view(-1, 3), CHUNK)
    depth = torch.cat([_optical_depth(field, device, part) for part in points]).view(shape)
    level = _logit(torch.tensor(-math.log1p(-threshold))).item()
    values = _logit(depth).numpy()
    empty = values < level
    if empty.all():
        max_opacity = -math.expm1(-float(depth.max()))
        raise DevrfError(
            f"export.threshold: the field is empty: no voxel has the opacity {threshold:g}, the "
            f"most is {max_opacity:.2g}; give a lower threshold, or learn for longer"
        )
    if not empty.any():
        raise DevrfError(
            f"export.threshold: all of the field has the opacity {threshold:g}; give a higher one"
        )
    hidden = empty & ~_reached(empty, box, outside)
    values[hidden] = 2 * abs(level) + values.max()
    vertices, faces, _, _ = measure.marching_cubes(values, level, gradient_direction="ascent")
    low = np.array(box.low)
    size = np.array(box.size)
    points = low + vertices * (size / (np.array(shape) - 1))
    return points.astype(np.float32), faces.astype(np.int64)


def entries(model: Renderable, box: Box, cameras: Cameras) -> Tensor:
    """Points (K, 3) in the fields' space at which rays of the cameras enter ``box``."""
    space = model.space
    near, far = model.depth_limits
    points = []
    for camera in range(len(cameras)):
        rays = space.rays(cameras.single(camera).resized(ENTRIES, ENTRIES).image_rays(0))
        entry, leave = box.crossing(rays, near, far)
        met = (entry < leave).nonzero()[:, 0]
        points.append(rays.at(met, entry[met]))
    return torch.cat(points)


def _optical_depth(field: SurfaceField, device: torch.device, points: Tensor) -> Tensor:
    """τ (M,) at ``points`` (M, 3), both on the host."""
    return field.optical_depth(points.to(device)).cpu()


def _logit(depth: Tensor) -> Tensor:
    depth = depth.clamp(min=LEAST)
    return depth + torch.log(-torch.expm1(-depth))


def _reached(empty: npt.NDArray[np.bool_], box: Box, outside: Tensor) -> npt.NDArray[np.bool_]:
    """The empty cells that are connected, face to face, with a point of ``outside``."""
    from skimage import measure

    labels = measure.label(empty, connectivity=1)
    shape = torch.tensor(empty.shape)
    cells = box.to_grid(outside, empty.shape).round().long()
    inside = ((cells >= 0) & (cells < shape)).all(dim=1)
    seeds = np.unique(labels[tuple(cells[inside].t().numpy())])
    reached: npt.NDArray[np.bool_] = np.isin(labels, seeds[seeds > 0])
    # If all cameras stand in fog, nothing tells which empty cells are outside.
    return reached if reached.any() else empty


def surface_of(
    model: Renderable, field: SurfaceField, cameras: Cameras, settings: ExportSettings
) -> Surface:
    """The surface of a model's field, as ``cameras`` on the host saw it, decimated and coloured.

    Raises:
        DevrfError: there is no surface at that threshold, or none within reach.
    """
    import trimesh  # an extra

    space = model.space
    device = model.device
    outside = entries(model, field.box, cameras)
    points, faces = isosurface(field, device, outside, settings.threshold, settings.side)
    mesh = trimesh.Trimesh(points, faces, process=False)
    # Unbounded spaces reach to infinity: all vertices of a face have to be near enough.
    away = (space.to_world(torch.from_numpy(points)) - cameras.positions.mean(dim=0)).norm(dim=1)
    near = (away <= settings.reach * away.median()).numpy()[faces].all(axis=1)
    if not near.any():
        raise DevrfError(
            "export.reach: no face of the surface is within reach; give a larger number"
        )
    mesh.update_faces(near)
    piece = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    sizes = np.bincount(piece)
    mesh.update_faces((sizes >= settings.pieces * sizes.max())[piece])
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) > settings.faces:
        mesh = mesh.simplify_quadric_decimation(face_count=settings.faces)
    vertices = torch.from_numpy(np.array(mesh.vertices, np.float32))
    triangles = torch.from_numpy(np.array(mesh.faces, np.int64))
    outward = triangles.flip(1) if _mirrors(space, field.box) else triangles
    normals = vertex_normals(space.to_world(vertices), outward)
    averaged = settings.colors == "mean"
    colors = vertex_colors(field, device, vertices, triangles, normals, averaged=averaged)
    return Surface(vertices, outward, colors)


def _mirrors(space: Space, box: Box) -> bool:
    """Whether the way to the world turns right-handed axes into left-handed ones."""
    corner = torch.tensor(box.middle)
    steps = torch.diag(torch.tensor(box.size) / 100)
    way = space.to_world(corner + steps) - space.to_world(corner)
    return bool(torch.linalg.det(way / way.norm(dim=1, keepdim=True)) < 0)


# Vertices whose colour is found at once.
VERTICES = 2**13
# Start and end of a ray behind the vertex, and the distance of its samples, in voxels.
BEFORE = -1.0
BEHIND = 3.0
STEP = 0.25
# Samples with a smaller weight are left out.
SIGNIFICANT = 0.01
# Directions over which colours are averaged, and their largest angle to the normal in degrees.
DIRECTIONS = 16
WIDEST = 60.0


def vertex_colors(
    field: SurfaceField,
    device: torch.device,
    points: Tensor,
    faces: Tensor,
    normals: Tensor,
    *,
    averaged: bool,
) -> Tensor:
    """RGB (V, 3) in [0, 1] of vertices (V, 3) in the fields' space, seen from outside.

    A vertex lies where occupied space begins, and there the field's colours are not yet learned:
    its own is that of a ray that goes straight in, Σ w_i c_i / Σ w_i (docs/method.md#compositing),
    along its unit normal (V, 3) of the world, or ``averaged`` over directions up to 60 degrees off.
    Faces (F, 3) are counter-clockwise from outside in the fields' space.
    """
    low, _ = field.box.corners(points)
    voxel = points.new_tensor(field.box.size) / (points.new_tensor(field.shape) - 1)
    inward = -voxel * vertex_normals((points - low) / voxel, faces)
    eyes = _cap(DIRECTIONS, math.radians(WIDEST)) if averaged else torch.eye(3)[2:]
    blocks = zip(
        torch.split(points, VERTICES),
        torch.split(inward, VERTICES),
        torch.split(normals, VERTICES),
        strict=True,
    )
    return torch.cat([_seen(field, device, p, way, n, eyes) for p, way, n in blocks]).clamp(0, 1)


def _seen(
    field: SurfaceField,
    device: torch.device,
    points: Tensor,
    inward: Tensor,
    normals: Tensor,
    toward_eyes: Tensor,
) -> Tensor:
    """RGB (V, 3), the mean over the directions (K, 3), each weighted by its cosine."""
    way = torch.arange(BEFORE, BEHIND + STEP / 2, STEP)
    samples = points[:, None] + way[:, None] * inward[:, None]
    depth = STEP * _optical_depth(field, device, samples.reshape(-1, 3)).view(samples.shape[:2])
    weight = torch.exp(depth - depth.cumsum(dim=1)) * -torch.expm1(-depth)
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-9)
    vertex, sample = (weight > SIGNIFICANT).nonzero(as_tuple=True)
    share = weight[vertex, sample, None]
    where = samples[vertex, sample]
    axes = halfway(normals)  # of half turns that lead +z to the normals
    colors = torch.zeros_like(points)
    total = toward_eyes[:, 2].sum()
    for direction in toward_eyes:
        turned = 2 * (axes @ direction)[:, None] * axes - direction
        color = field.color(where.to(device), -turned[vertex].to(device)).cpu()
        colors.index_add_(0, vertex, share * color * (direction[2] / total))
    weight_sum = torch.zeros(len(points)).index_add_(0, vertex, share[:, 0])
    return colors / weight_sum.clamp(min=1e-9)[:, None]


def _cap(count: int, widest: float) -> Tensor:
    """Unit vectors (K, 3), evenly spread over the cap of ``widest`` radians about +z."""
    k = torch.arange(count) + 0.5
    z = 1 - (1 - math.cos(widest)) * k / count
    around = math.pi * (1 + math.sqrt(5)) * k
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * around.cos(), radius * around.sin(), z], dim=1)
