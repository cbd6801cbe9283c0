"""The space of a scene's fields (world, contracted, NDC), and its bounds there."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Literal

import torch

from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.poses import average_pose, relative_to
from devrf.geometry.space import WORLD, Space
from devrf.scenes.bounds import (
    COMMON_VIEW,
    NO_MOTION,
    box_from_cameras,
    forward_bounds,
    inward_bounds,
    reference_space,
)
from devrf.scenes.scene import (
    Background,
    Bounds,
    Capture,
    GivenBounds,
    Scene,
    Views,
    both_mapped,
)
from devrf.scenes.silhouettes import SEARCH, motion_box
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

SpaceChoice = Literal["auto", "world", "contracted"]

# Thickness of the shell in half edges of the inner box, as in the paper of contraction. Walls are a
# voxel or two deep in a thinner one, and are learned as fog before them (measured).
SHELL = 1.0
# The near plane, as a share of a camera's distance to the middle of the scene. If it is nearer, fog
# before each lens explains its picture and spoils those of others (measured).
NEAR_SHARE = 0.25


def inward_space(
    choice: SpaceChoice,
    static: Views,
    dynamic: Views | None,
    everyone: list[Views],
    given: GivenBounds,
) -> tuple[Space, Bounds]:
    """The space of an inward-facing scene, and its bounds there.

    Args:
        choice: the space, or ``auto``: contracted without alpha masks and a box, else the world.
        static: static training views, whose cameras give the box.
        dynamic: dynamic training views; None: the scene never moves.
        everyone: all views, test included.
        given: what options or files say of the bounds.

    Raises:
        DevrfError: the cameras do not determine the bounds, or near is not before far.
    """
    box = given.box
    box_given = "data.box is given" if box else ""
    where = box_given or COMMON_VIEW
    masks = "the images have alpha masks" if static.cut_out else "the images have no alpha masks"
    if choice == "world" or (choice == "auto" and (static.cut_out or box)):
        bounds = inward_bounds(static, dynamic, everyone, given)
        why = "data.space=world" if choice == "world" else box_given or masks
        return WORLD, replace(bounds, reason=why)
    inner = box or box_from_cameras(static.cameras)
    if box is None:
        motion = None
        if dynamic is not None and dynamic.cut_out:
            motion = motion_box(dynamic, inner.scaled(SEARCH))
        if motion is not None:
            inner = inner.union(motion)
            where += ", and the silhouettes' motion"
    if given.scale != "auto":
        inner = inner.scaled(float(given.scale))
        where += f" x {float(given.scale):g}"
    space = ContractedSpace(inner.low, inner.high, SHELL)
    near = given.near
    if near is None:
        middle = static.cameras.positions.new_tensor(inner.middle)
        distances = [(views.cameras.positions - middle).norm(dim=1).min() for views in everyone]
        near = NEAR_SHARE * float(min(distances))
    if not 0 <= near < math.inf:
        raise scene_error("data.near", f"expected a distance of 0 or more, not {near:g}")
    why = "data.space=contracted" if choice == "contracted" else f"{masks}, data.box is not given"
    return space, Bounds(
        box=space.box,
        near=near,
        far=math.inf,
        motion=None,
        scale=1.0,
        source="the box",
        given=given,
        reason=why,
        box_source=where,
    )


# The source of the room for motion.
SEEN = "all that the cameras see (forward-facing)"


def forward_facing_scene(
    name: str, static: Capture, dynamic: Capture, near: float, background: Background
) -> Scene:
    """The scene of two captures whose static cameras have the identity as their average pose.

    Its space is NDC of a camera at the origin that looks along −z, with the near plane ``near``
    world units before it. DevrfError if a camera sees points that are not before that one.
    """
    space = reference_space(static.train.cameras, near)
    # The captures of a static scene, and of a video, share images.
    learned = list({id(views): views for views in (static.train, dynamic.train)}.values())
    held_out = list({id(views): views for views in (static.test, dynamic.test)}.values())
    moves = dynamic.train is not static.train or len(set(dynamic.train.times.tolist())) > 1
    bounds = forward_bounds(learned, space, SEEN if moves else NO_MOTION)
    # The held-out cameras need not see inside the box, but they have to look the same way.
    forward_bounds(held_out, space, "")
    foremost = max(-float(v.cameras.positions[:, 2].min()) for v in learned + held_out)
    for views in learned + held_out:
        beyond = (views.cameras.positions[:, 2] <= -near).nonzero().flatten()
        if len(beyond):  # they would look through the scene
            log.warning(
                "%d cameras are beyond the near plane, %s the first of them; set data.near=%.3g",
                len(beyond),
                views.names[int(beyond[0])],
                1.05 * foremost,
            )
    return Scene(name, "forward", static, dynamic, bounds, background, space)


def centred(static: Capture, dynamic: Capture) -> tuple[Capture, Capture]:
    """Both captures in a world in which the static cameras' average pose is the identity."""
    both = (static.train, static.test)
    frame = average_pose(torch.cat([v.cameras.camera_to_world.double() for v in both]))

    def in_frame(views: Views) -> Views:
        poses = relative_to(frame, views.cameras.camera_to_world.double()).float()
        return replace(views, cameras=replace(views.cameras, camera_to_world=poses))

    return both_mapped(static, dynamic, in_frame)


def dynamic_only(scene: Scene) -> Scene:
    """The scene without its static set: the dynamic images of time 0 stand in for it.

    Bounds from the static cameras are replaced by bounds from the dynamic training cameras alone;
    DevrfError if these do not determine them. The bounds of a video stay, those with a given box,
    and all that is given.
    """
    views = scene.dynamic.train
    held_out = scene.dynamic.test
    static = Capture(train=earliest(views), test=earliest(held_out))
    if isinstance(scene.space, NormalizedDevice):
        bounds = forward_bounds([views], scene.space, "all that the dynamic cameras see")
        return replace(scene, static=static, bounds=bounds)
    if scene.is_monocular or scene.bounds.given.box:
        return replace(scene, static=static)
    choice: SpaceChoice = "world" if scene.space.is_linear else "contracted"
    space, bounds = inward_space(choice, views, views, [views, held_out], scene.bounds.given)
    return replace(scene, static=static, bounds=bounds, space=space)


def earliest(views: Views) -> Views:
    """Those of the views that were taken first."""
    return views[(views.times == views.times.min()).nonzero()[:, 0]]
