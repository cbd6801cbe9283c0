"""Which space an inward-facing scene is learned in, and where it is there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.space import WORLD, Space
from devrf.scenes.bounds import box_from_cameras, inward_bounds
from devrf.scenes.scene import Bounds, Views
from devrf.scenes.silhouettes import motion_box
from devrf.scenes.validation import scene_error

SpaceChoice = Literal["auto", "world", "contracted"]

# Thickness of the shell in half edges of the inner box, as in the paper of contraction. In a
# thinner one walls are a voxel or two deep, and are learned as fog before them (measured).
SHELL = 1.0
# Nothing is nearer to a camera than this share of its distance to what it looks at. With less, fog
# before each lens explains its picture and spoils those of others (measured).
NEAR_SHARE = 0.25


def inward_space(
    choice: SpaceChoice,
    static: Views,
    dynamic: Views | None,
    everyone: list[Views],
    *,
    bound_scale: float | str = "auto",
    near: float | None = None,
    far: float | None = None,
    box: Box | None = None,
) -> tuple[Space, Bounds]:
    """The space of a scene that its cameras look in at, and its bounds there.

    Args:
        choice: the space, or ``auto``: contracted without mattes and ``box``, else the world.
        static: training views at rest, whose cameras give the box.
        dynamic: training views in motion; None: the scene is at rest.
        everyone: all views, test included.
        bound_scale: as for :func:`~devrf.scenes.bounds.inward_bounds`; a number makes the inner
            box of contracted space so much larger, unless it is given.
        near: distance in world units, or None for the cameras to say.
        far: distance in world units, or None; contracted space has no end.
        box: the scene's box, or None.

    Raises:
        DevrfError: the cameras do not say where the scene is, or near is not before far.
    """
    given = "data.box is given" if box else ""
    mattes = "the images have mattes" if static.cut_out else "the images have no mattes"
    if choice == "world" or (choice == "auto" and (static.cut_out or box)):
        bounds = inward_bounds(
            static, dynamic, everyone, bound_scale=bound_scale, near=near, far=far, box=box
        )
        why = "data.space=world" if choice == "world" else given or mattes
        where = given or "what the static cameras all see"
        return WORLD, _because(bounds, why, where)
    inner, where = box or box_from_cameras(static.cameras), given
    if box is None:
        where = "what the static cameras all see"
        motion = motion_box(dynamic, inner) if dynamic is not None and dynamic.cut_out else None
        if motion is not None:
            inner, where = inner.union(motion), where + ", and where the silhouettes move"
        if bound_scale != "auto":
            inner, where = inner.scaled(float(bound_scale)), where + f" x {float(bound_scale):g}"
    space = ContractedSpace(inner.low, inner.high, SHELL)
    if near is None:
        middle = static.cameras.positions.new_tensor(inner.middle)
        distances = [(views.cameras.positions - middle).norm(dim=1).min() for views in everyone]
        near = NEAR_SHARE * float(min(distances))
    if not 0 <= near < math.inf:
        raise scene_error("data.near", f"expected a distance of 0 or more, not {near:g}")
    bounds = Bounds(space.box, near, math.inf, None, 1.0, "the box")
    why = "data.space=contracted" if choice == "contracted" else f"{mattes}, data.box is not given"
    return space, _because(bounds, why, where)


def _because(bounds: Bounds, why: str, where: str) -> Bounds:
    return replace(bounds, reason=why, box_source=where)
