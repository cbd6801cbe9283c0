"""Captures that face a scene from one side, whatever layout they are from, as a scene in NDC."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch

from devrf.geometry.poses import average_pose, relative_to
from devrf.scenes.bounds import STILL
from devrf.scenes.forward_bounds import forward_bounds, reference_space
from devrf.scenes.scene import Background, Capture, Scene, Views

log = logging.getLogger(__name__)

# Where the room for motion comes from.
SEEN = "all that the cameras see (forward-facing)"


def one_sided_scene(
    name: str, static: Capture, dynamic: Capture, near: float, background: Background
) -> Scene:
    """The scene of two captures whose static cameras have the identity as their average pose.

    Its space is NDC of a camera at the origin that looks along −z.

    Args:
        name: the scene's name.
        static: the scene at rest.
        dynamic: the scene in motion; ``static`` itself where it is always at rest.
        near: distance of the near plane from the average camera, world units.
        background: what is behind alpha masks.

    Raises:
        DevrfError: a camera sees something that is not before the average camera.
    """
    space = reference_space(static.train.cameras, near)
    # The captures of a scene at rest, and of a video, share images.
    learned, held_out = (
        list({id(v): v for v in both}.values())
        for both in ((static.train, dynamic.train), (static.test, dynamic.test))
    )
    moves = dynamic.train is not static.train or len(set(dynamic.train.times.tolist())) > 1
    bounds = forward_bounds(learned, space, SEEN if moves else STILL)
    # The held-out cameras need not see inside the box, but they have to look the same way.
    forward_bounds(held_out, space, "")
    _warn_of_cameras_beyond(near, learned + held_out)
    return Scene(name, "forward", static, dynamic, bounds, background, space)


def centred(static: Capture, dynamic: Capture) -> tuple[Capture, Capture]:
    """Both captures in a world in which the static cameras' average pose is the identity."""
    both = (static.train, static.test)
    frame = average_pose(torch.cat([v.cameras.camera_to_world.double() for v in both]))
    moved: dict[int, Views] = {}
    for views in (*both, dynamic.train, dynamic.test):
        if id(views) not in moved:  # captures that share images go on sharing them
            poses = relative_to(frame, views.cameras.camera_to_world.double()).float()
            moved[id(views)] = replace(views, cameras=replace(views.cameras, camera_to_world=poses))
    first, second = (
        Capture(moved[id(one.train)], moved[id(one.test)]) for one in (static, dynamic)
    )
    return first, second


def _warn_of_cameras_beyond(near: float, everyone: list[Views]) -> None:
    """A camera beyond the near plane would look through what is behind it."""
    for views in everyone:
        beyond = (views.cameras.positions[:, 2] <= -near).nonzero().flatten()
        if len(beyond):
            log.warning(
                "%d cameras are beyond the near plane, %s the first of them; set data.near higher",
                len(beyond),
                views.names[int(beyond[0])],
            )
