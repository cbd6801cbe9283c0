"""A scene as lines in space: its cameras, its boxes, and the ground below them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from PIL import Image
from torch import Tensor

from devrf.artifacts.camera_advice import box_middle, box_points, common_up
from devrf.artifacts.drawing import Color, Lines, Projection, direction, draw
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Scene

PAPER: Color = (248, 249, 251)
GROUND: Color = (200, 207, 217)
BOX: Color = (58, 66, 80)
MOTION: Color = (34, 160, 107)
STATIC: Color = (88, 128, 205)
STATIC_TEST: Color = (140, 196, 232)
DYNAMIC: Color = (226, 112, 32)
DYNAMIC_TEST: Color = (196, 44, 96)

MARGIN = 34


@dataclass(frozen=True)
class Sketch:
    """A scene drawn from one side.

    Attributes:
        title: where it is seen from.
        image: the picture.
        projection: where points of the world fall on it.
    """

    title: str
    image: Image.Image
    projection: Projection


def sketches(scene: Scene, width: int, height: int) -> list[Sketch]:
    """The scene from the side and from above, ``width`` × ``height`` pixels each."""
    up, east, north = _compass(scene)
    things = _lines(scene)
    everything = torch.cat([group.ends.reshape(-1, 3) for group in things])
    things.insert(0, _ground(scene, everything, up, east, north))
    drawn = []
    # North is where forward-facing cameras look: they are seen over their shoulder.
    beside = 25.0 if scene.kind == "inward" else -40.0
    for title, azimuth, elevation in (("from the side", beside, 18.0), ("from above", -90.0, 80.0)):
        toward = direction(east, north, up, azimuth, elevation)
        projection = Projection.onto(everything, toward, up, width, height, MARGIN)
        drawn.append(Sketch(title, draw(things, projection, PAPER), projection))
    return drawn


def grid_step(scene: Scene) -> float:
    """Distance between the lines of the ground in world units: 1, 2 or 5 times a power of ten."""
    reach = _distance(scene) / 3
    power: float = 10 ** math.floor(math.log10(reach))
    return power * max(k for k in (1, 2, 5) if k * power <= reach * (1 + 1e-6))


def fixed_cameras(cameras: Cameras, view: Tensor) -> list[tuple[int, int]]:
    """(number, first image) of each view of N cameras, ``view`` (N,) saying which took which."""
    first: dict[int, int] = {}
    for image, number in enumerate(view.tolist()):
        first.setdefault(number, image)
    return sorted(first.items())


def box_edges(scene: Scene, motion: bool = False) -> Tensor:
    """The edges (12, 2, 3) of the scene's box, or its motion box, in world units.

    The box of a forward-facing scene is a frustum in the world, cut off before infinity.
    """
    box = scene.bounds.motion if motion else scene.bounds.box
    if box is None:
        return torch.zeros(0, 2, 3)
    corners = box_points(scene, box, (2, 2, 2))
    edges = [corners.unbind(axis) for axis in range(3)]
    return torch.cat([torch.stack([a.reshape(-1, 3), b.reshape(-1, 3)], dim=1) for a, b in edges])


def frusta(cameras: Cameras, depth: float) -> Tensor:
    """Cameras as pyramids with a tick where up is: segments (10 · N, 2, 3), world units.

    Args:
        cameras: N cameras.
        depth: height of the pyramids, world units.
    """
    w, h = cameras.width, cameras.height
    corners = cameras.center.new_tensor(
        [[0, 0], [w, 0], [w, h], [0, h], [0.35 * w, 0], [0.5 * w, -0.2 * h], [0.65 * w, 0]]
    )
    x, y = ((corners - cameras.center[:, None]) / cameras.focal[:, None]).unbind(-1)
    local = depth * torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    pose = cameras.camera_to_world
    ends = local @ pose[:, :, :3].transpose(1, 2) + pose[:, None, :, 3]
    eye = pose[:, :, 3]
    pairs = [(eye, ends[:, k]) for k in range(4)]
    pairs += [(ends[:, k], ends[:, (k + 1) % 4]) for k in range(4)]
    pairs += [(ends[:, 4], ends[:, 5]), (ends[:, 5], ends[:, 6])]
    return torch.stack([torch.stack(pair, dim=1) for pair in pairs], dim=1).reshape(-1, 2, 3)


def _lines(scene: Scene) -> list[Lines]:
    depth = _frustum_depth(scene)
    groups = [Lines(box_edges(scene), BOX, 2.0), Lines(box_edges(scene, motion=True), MOTION, 1.6)]
    for views, color, line in (
        (scene.static.train, STATIC, 1.2),
        (scene.static.test, STATIC_TEST, 1.2),
        (scene.dynamic.train, DYNAMIC, 2.4),
        (scene.dynamic.test, DYNAMIC_TEST, 2.4),
    ):
        if len(views):
            # Fixed cameras once, not once a frame.
            images = [image for _, image in fixed_cameras(views.cameras, views.view)]
            moving = len(images) == len(views) and len(views) > 12
            groups.append(
                Lines(frusta(views.cameras[images], depth), color, 1.2 if moving else line)
            )
    return groups


def _compass(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Directions up, east and north (3,) each; east is to the right of forward-facing cameras."""
    cameras = scene.static.train.cameras
    up = common_up(cameras)
    up = torch.tensor([0.0, 0.0, 1.0]) if up is None else up
    if scene.kind == "forward":
        guess = cameras.camera_to_world[:, :, 0].mean(dim=0)
    else:
        guess = torch.linalg.cross(torch.eye(3)[int(up.abs().argmin())], up)
    east = torch.nn.functional.normalize(guess - (guess @ up) * up, dim=0)
    return up, east, torch.linalg.cross(up, east)


def _ground(scene: Scene, points: Tensor, up: Tensor, east: Tensor, north: Tensor) -> Lines:
    """A square grid under the box that reaches below everything."""
    step = grid_step(scene)
    middle = box_middle(scene)
    edges = box_edges(scene).reshape(-1, 3)
    height = float((edges @ up).min())
    a, b = ((points - middle) @ axis for axis in (east, north))
    first = [math.floor(float(v.min()) / step) for v in (a, b)]
    last = [math.ceil(float(v.max()) / step) for v in (a, b)]
    origin = middle + (height - middle @ up) * up

    def at(i: int, j: int) -> Tensor:
        return origin + step * (i * east + j * north)

    lines = [(at(i, first[1]), at(i, last[1])) for i in range(first[0], last[0] + 1)]
    lines += [(at(first[0], j), at(last[0], j)) for j in range(first[1], last[1] + 1)]
    return Lines(torch.stack([torch.stack(line) for line in lines]), GROUND, 1.0)


def _distance(scene: Scene) -> float:
    """Mean distance of the static cameras from the middle of the box, world units."""
    offsets = scene.static.train.cameras.positions - box_middle(scene)
    return max(float(offsets.norm(dim=1).mean()), 1e-6)


def _frustum_depth(scene: Scene) -> float:
    """Large enough to be seen, and small enough for neighbours not to meet (world units)."""
    distance, positions = _distance(scene), scene.static.train.cameras.positions
    between = torch.cdist(positions, positions)
    between.fill_diagonal_(math.inf)
    apart = float(between.amin(dim=1).median()) if len(positions) > 1 else distance
    return min(0.13 * distance, max(0.8 * apart, 0.05 * distance))
