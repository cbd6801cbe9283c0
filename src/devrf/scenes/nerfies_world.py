"""``scene.json`` of Nerfies' layout: the world, and where in it the scene is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, TypeAdapter

from devrf.scenes.bounds import FALLBACK_BOUND_SCALE, axes_do_meet, box_of_frusta
from devrf.scenes.json_files import Positive, Vector3, read_json
from devrf.scenes.poses import FARTHEST
from devrf.scenes.reader import InwardReader
from devrf.scenes.scene import Capture, Scene

SCENE = "scene.json"

Length = Annotated[Positive, Field(le=FARTHEST)]


class World(BaseModel):
    """The frame of reference, (position − center) · scale.

    Attributes:
        center: of the world, in the cameras' units.
        scale: world units in one of the cameras'.
        near: distance before which nothing is, world units.
        far: distance behind which nothing is, world units.
    """

    center: Vector3
    scale: Length
    near: Length
    far: Length


_WORLD = TypeAdapter(World)


def read_world(folder: Path) -> World:
    """The world of the scene in ``folder``.

    Raises:
        DevrfError: the file is missing or wrong.
    """
    return read_json(
        folder / SCENE, _WORLD, "it says where the scene is; set data.root to its folder"
    )


def placed(
    reader: InwardReader, folder: Path, world: World, static: Capture, dynamic: Capture
) -> Scene:
    """The scene of two captures, near and far as the options or else the world have them.

    Without alpha masks the scene has no end, or, where the cameras look in nearly one direction,
    the box is all that they see between near and far.

    Args:
        reader: the options.
        folder: where the captures were read from.
        world: what ``scene.json`` says.
        static: the scene at rest.
        dynamic: the scene in motion.

    Raises:
        DevrfError: what :meth:`devrf.scenes.reader.InwardReader.scene` raises.
    """
    near = world.near if reader.near is None else reader.near
    far = world.far if reader.far is None else reader.far
    options, cameras = replace(reader, near=near, far=far), static.train.cameras
    wide = reader.box is None and not static.train.cut_out and 0 <= near < far
    if not wide or (reader.space != "world" and axes_do_meet(cameras)):
        return options.scene(folder, static, dynamic)
    # Without mattes the backdrop is to be learned too.
    seen = box_of_frusta(cameras, near, far)
    scale = FALLBACK_BOUND_SCALE if reader.bound_scale == "auto" else reader.bound_scale
    box = [seen.low, seen.high]
    options = replace(options, box=box, space="world", bound_scale=scale)
    scene = options.scene(folder, static, dynamic)
    why = "data.space=world" if reader.space == "world" else "the cameras look in one direction"
    bounds = replace(scene.bounds, reason=why, box_source="all that the cameras see up to far")
    return replace(scene, bounds=bounds)
