"""The cameras and boxes of a scene: in perspective, and as a plan seen from above."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from torch import Tensor

from devrf.apps.inspection.layout import box_middle, box_points, common_up, horizontal_axes
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Scene, Views

TRAIN_COLOR, TEST_COLOR = "#d9601a", "#b3204d"
HALO = [withStroke(linewidth=3, foreground="white")]


class Lines(NamedTuple):
    """Segments (N, 2, 3) in world units that look alike, with their entry in the legend."""

    label: str
    ends: Tensor
    color: str
    width: float


def draw_cameras(scene: Scene, side: Any, plan: Axes) -> None:
    """Draw cameras and boxes, in perspective (an Axes3D) and from above.

    Axes are in world units, counted from the middle of the box, along east, north and up of
    the cameras.
    """
    axes, middle = compass(scene), box_middle(scene)
    groups = scene_lines(scene)
    shown = [(group.ends - middle) @ axes.T for group in groups]
    for group, ends in zip(groups, shown, strict=True):
        # One curve with a break after each segment.
        path = torch.cat([ends, torch.full_like(ends[:, :1], math.nan)], dim=1).reshape(-1, 3)
        x, y, z = path.T.tolist()
        side.plot(x, y, z, color=group.color, linewidth=group.width, clip_on=False)
        plan.plot(x, y, color=group.color, linewidth=group.width, label=group.label)
    for name, number, position, color in _fixed_views(scene):
        x, y, z = ((position - middle) @ axes.T).tolist()
        style: dict[str, Any] = {"color": color, "fontweight": "bold", "path_effects": HALO}
        side.text(x, y, z, f"  {number}", **style)
        if scene.kind == "inward":  # forward-facing cameras stand above one another
            outward = 26 / max(math.hypot(x, y), 1e-6)  # points
            style |= {"textcoords": "offset points", "ha": "center", "va": "center"}
            plan.annotate(f"{name} {number}", (x, y), xytext=(x * outward, y * outward), **style)
    points = torch.cat([ends.reshape(-1, 3) for ends in shown])
    low, high = points.amin(dim=0).tolist(), points.amax(dim=0).tolist()
    side.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    side.set_box_aspect([b - a for a, b in zip(low, high, strict=True)], zoom=1.15)
    side.locator_params(nbins=5)
    side.view_init(elev=20, azim=-55)
    plan.set_aspect("equal")
    plan.grid(color="0.92")


def compass(scene: Scene) -> Tensor:
    """Rows east, north, up (3, 3) in the world; forward-facing cameras look about north."""
    cameras = scene.static.train.cameras
    up = common_up(cameras)
    up = torch.tensor([0.0, 0.0, 1.0]) if up is None else up
    right = cameras.camera_to_world[:, :, 0].mean(dim=0) if scene.kind == "forward" else None
    return torch.stack([*horizontal_axes(up, right), up])


def scene_lines(scene: Scene) -> list[Lines]:
    """Boxes and cameras as lines; each fixed camera once, not once a frame."""
    size, bounds, endless = _camera_size(scene), scene.bounds, scene.kind == "forward"
    lines = [Lines("box" + endless * " (endless, cut off)", box_edges(scene, bounds.box), "0.2", 2)]
    if bounds.motion is not None:
        lines.append(Lines("room for motion", box_edges(scene, bounds.motion), "#1f9e6b", 2))
    sets = [
        ("static views", scene.static.train, "#4f7fd0", 1.0),
        ("held-out static", scene.static.test, "#7cc4ea", 1.0),
    ]
    if scene.moves:
        sets += [
            ("dynamic views", scene.dynamic.train, TRAIN_COLOR, 2.0),
            ("held-out dynamic", scene.dynamic.test, TEST_COLOR, 2.0),
        ]
    for label, views, color, width in sets:
        images = list(first_images(views).values())
        ends = frusta(views.cameras[images], size)
        lines.append(Lines(f"{label} ({len(images)})", ends, color, width))
    return lines


def first_images(views: Views) -> dict[int, int]:
    """The first image of each view, by the view's number, ascending."""
    first: dict[int, int] = {}
    for image, number in enumerate(views.view.tolist()):
        first.setdefault(number, image)
    return dict(sorted(first.items()))


def box_edges(scene: Scene, box: Box) -> Tensor:
    """The edges (12, 2, 3) of a box of the scene in world units; an NDC box is a frustum there."""
    corners = box_points(scene, box, (2, 2, 2))
    edges = [corners.unbind(axis) for axis in range(3)]
    return torch.cat([torch.stack([a.reshape(-1, 3), b.reshape(-1, 3)], dim=1) for a, b in edges])


def frusta(cameras: Cameras, depth: float) -> Tensor:
    """N cameras as pyramids ``depth`` high with a tick where up is: (10 · N, 2, 3), world units."""
    w, h = cameras.width, cameras.height
    corners = cameras.center.new_tensor(
        [[0, 0], [w, 0], [w, h], [0, h], [0.35 * w, 0], [0.5 * w, -0.2 * h], [0.65 * w, 0]]
    )
    x, y = ((corners - cameras.center[:, None]) / cameras.focal[:, None]).unbind(-1)
    local = depth * torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    pose = cameras.camera_to_world
    ends = local @ pose[:, :, :3].transpose(1, 2) + pose[:, None, :, 3]
    ends = torch.cat([pose[:, None, :, 3], ends], dim=1)  # 0 is the eye, 1 to 4 the corners
    pairs = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [5, 6], [6, 7]]
    return ends[:, pairs].reshape(-1, 2, 3)


def _fixed_views(scene: Scene) -> list[tuple[str, int, Tensor, str]]:
    """Name, number, position (3,) and colour of the dynamic views whose cameras stand still."""
    return [
        (name, number, views.cameras.positions[image], color)
        for name, views, color in (
            ("view", scene.dynamic.train, TRAIN_COLOR),
            ("test", scene.dynamic.test, TEST_COLOR),
        )
        if len(first := first_images(views)) < len(views)
        for number, image in first.items()
    ]


def _camera_size(scene: Scene) -> float:
    """Height of the drawn pyramids, world units: visible, and less than neighbours are apart."""
    positions = scene.static.train.cameras.positions
    distance = max(float((positions - box_middle(scene)).norm(dim=1).mean()), 1e-6)
    between = torch.cdist(positions, positions).fill_diagonal_(math.inf)
    apart = float(between.amin(dim=1).median()) if len(positions) > 1 else distance
    return min(0.13 * distance, max(0.8 * apart, 0.05 * distance))
