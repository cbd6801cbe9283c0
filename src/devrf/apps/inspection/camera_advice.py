"""Problems with the cameras' positions and directions."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from devrf.apps.inspection.advice import Advice, images_where, listed
from devrf.apps.inspection.layout import box_middle, box_points, widest_gap
from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.scene import Scene, Views

# Largest gap between neighbouring static views, as seen from the box's middle, in degrees.
WIDEST_GAP = 120.0
# Two cameras are the same when their axes differ by less than this (radians, about), and their
# positions by less than this share of the distance to the scene.
SAME = 1e-4


def camera_advice(scene: Scene) -> list[Advice]:
    """Problems that the cameras alone show."""
    return [*_held_out(scene), *_looking_away(scene), *_box_unknown(scene), *_one_side(scene)]


def _held_out(scene: Scene) -> Iterator[Advice]:
    for name, capture in scene.captures.items():
        if len(capture.test) == 0:
            yield Advice(
                f"{name} test set",
                "holds no view, so nothing can be scored",
                "hold out some images of the capture",
            )
        elif twins := _twins(capture.test, capture.train, box_middle(scene)):
            yield Advice(
                f"{name} test set",
                f"{listed(twins)}: the same camera and time as a training view, so the score "
                "measures memory of that view",
                "hold out other views",
            )


def _twins(test: Views, train: Views, middle: Tensor) -> list[str]:
    """Names of the test views that have the camera and the time of a training view."""
    reach = float((train.cameras.positions - middle).norm(dim=1).mean())
    poses = train.cameras.camera_to_world
    names = []
    for k, pose in enumerate(test.cameras.camera_to_world):
        turned = (poses[:, :, :3] - pose[:, :3]).abs().amax(dim=(1, 2))
        moved = (poses[:, :, 3] - pose[:, 3]).norm(dim=1) / max(reach, 1e-9)
        apart = (train.times - test.times[k]).abs()
        if bool(((turned < SAME) & (moved < SAME) & (apart <= FrameClock.TOLERANCE)).any()):
            names.append(test.names[k])
    return names


def _looking_away(scene: Scene) -> Iterator[Advice]:
    points = box_points(scene, scene.bounds.box, (9, 9, 9))

    def away(views: Views, k: int) -> bool:
        return float(views.cameras.project_into(k, points[4, 4, 4:5])[1]) <= 0

    def beside(views: Views, k: int) -> bool:
        pixels, depth = views.cameras.project_into(k, points.reshape(-1, 3))
        size = pixels.new_tensor([views.width, views.height])
        seen = (depth > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=1)
        return not away(views, k) and not bool(seen.any())

    remedy = "check the pose (camera-to-world, x right, y up, looking along -z), or set data.box"
    if names := images_where(scene, away):
        yield Advice(listed(names), "looks away from the middle of the box", remedy)
    if names := images_where(scene, beside):
        yield Advice(listed(names), "does not have the box in the picture", remedy)


def _box_unknown(scene: Scene) -> Iterator[Advice]:
    views, box = scene.static.train, scene.bounds.box
    if scene.kind != "inward" or not scene.space.straight or views.has_alpha:
        return
    try:
        guessed = box_from_cameras(views.cameras)
    except DevrfError:
        return  # the cameras tell no box: it was given
    corners, guess = (torch.tensor([*b.low, *b.high]) for b in (box, guessed))
    if float((corners - guess).abs().max()) <= 1e-4 * guessed.longest:
        yield Advice(
            "static training set",
            "has no alpha masks, and the box is only what the cameras all see",
            "set data.box=[[x,y,z],[x,y,z]] around the object, or give the images alpha (RGBA)",
        )


def _one_side(scene: Scene) -> Iterator[Advice]:
    if scene.kind != "inward":
        return
    gap = widest_gap(scene.static.train.cameras, box_middle(scene))
    if gap is not None and gap > WIDEST_GAP:
        yield Advice(
            "static training set",
            f"no view from a sector of {gap:.0f} degrees, seen from above",
            "expect fog on that side, or add views there "
            "(data=forward is for scenes from one side)",
        )
