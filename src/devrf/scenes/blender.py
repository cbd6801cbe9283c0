"""Inward-facing scenes on disk: DeVRF's static + dynamic folders, and D-NeRF's single folder."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from devrf.scenes.bounds import inward_bounds
from devrf.scenes.capture_folders import chosen_dynamic, dynamic_folders
from devrf.scenes.flow_files import read_flow
from devrf.scenes.image_files import image_size
from devrf.scenes.layout import Layout, fewer, load_layout, without_static_set
from devrf.scenes.options import check_options
from devrf.scenes.paths import existing_folder, scene_folder
from devrf.scenes.scene import Background, Scene, Views
from devrf.scenes.splits import Split, dynamic_split, static_split
from devrf.scenes.validation import check_choice, scene_error

log = logging.getLogger(__name__)

FlowSource = Literal["files", "none"]


def read_blender(
    root: str | Path,
    *,
    name: str | None = None,
    dynamic: str | None = None,
    downscale: int = 1,
    background: Background = "white",
    bound_scale: float | str = "auto",
    near: float | None = None,
    far: float | None = None,
    box: list[list[float]] | None = None,
    flow: FlowSource = "files",
    train_views: int | None = None,
    frames: int | None = None,
    static_until: float = 1.0,
) -> Scene:
    """Read a scene that cameras look in at, from ``transforms_{train,test}.json`` and images.

    Two layouts: ``static/`` next to ``dynamic_<V>views/``, or (D-NeRF) the JSON files in
    ``root`` itself, where the static capture is taken from the training images.

    Args:
        root: the scene's folder.
        name: short name; None takes the folder's.
        dynamic: which ``dynamic_*views`` folder, where there are several.
        downscale: integer factor ≥ 1 by which images and flow are made smaller.
        background: what is behind the mattes of RGBA images; RGB images are used as they are.
        bound_scale: "auto" (room for motion from silhouettes) or a number ≥ 1 by which the
            tightened canonical box is enlarged.
        near: distance in world units before which nothing is; None: from the cameras.
        far: distance in world units behind which nothing is; None: from the cameras.
        box: [[x, y, z], [x, y, z]] in world units; None: from the cameras.
        flow: "files" reads backward flow where there is any; "none" does not.
        train_views: train on the first so many dynamic views; None: all.
        frames: keep so many times, evenly spread, first and last included; None: all.
        static_until: without a static set, the latest time of an image that counts as static.

    Raises:
        DevrfError: a file or an option is wrong; the message names it.
    """
    check_choice("data.flow", flow, get_args(FlowSource))
    given_box = check_options(
        downscale=downscale,
        background=background,
        bound_scale=bound_scale,
        near=near,
        far=far,
        box=box,
        frames=frames,
        static_until=static_until,
        train_views=train_views,
    )
    folder = scene_folder(root)

    layout, flow_folder = _layout(folder, dynamic, static_until)
    layout, thinned = fewer(layout, train_views, frames)
    static, dynamic_ = load_layout(layout, folder, downscale)
    if flow == "files" and thinned:
        log.info("flow files dropped: with data.frames=%s neighbouring frames are left out", frames)
    elif flow == "files":
        train = _with_flow(dynamic_.train, layout.dynamic_train, flow_folder)
        dynamic_ = replace(dynamic_, train=train)
    bounds = inward_bounds(
        static.train,
        dynamic_.train,
        [static.train, static.test, dynamic_.train, dynamic_.test],
        bound_scale=bound_scale,
        near=near,
        far=far,
        box=given_box,
    )
    return Scene(name or folder.resolve().name, "inward", static, dynamic_, bounds, background)


def _layout(root: Path, dynamic: str | None, static_until: float) -> tuple[Layout, Path]:
    """The splits, and the folder where flow files would lie."""
    static = root / "static"
    if not os.path.isdir(static) and not dynamic_folders(root):
        if not os.path.isfile(root / "transforms_train.json"):
            raise scene_error(
                root,
                "expected static/ and dynamic_<V>views/, or transforms_train.json; "
                "set data.root to the scene's folder",
            )
        train = dynamic_split(root / "transforms_train.json", root)
        test = dynamic_split(root / "transforms_test.json", root)
        return without_static_set(train, test, static_until), root / "train_flow"
    existing_folder(static)
    moving = chosen_dynamic(root, dynamic)
    layout = Layout(
        static_split(static / "transforms_train.json", root),
        static_split(static / "transforms_test.json", root),
        dynamic_split(moving / "transforms_train.json", root),
        dynamic_split(moving / "transforms_test.json", root),
    )
    return layout, moving / "train_flow"


def _with_flow(views: Views, split: Split, folder: Path) -> Views:
    first = split.times.min()
    if any(not known.distortion.none for known in split.transforms.intrinsics):
        log.warning("flow files in %s left out: they are of images before undistortion", folder)
        return views
    used = int(split.index[0])
    flow = read_flow(
        folder,
        split.index.tolist(),
        (views.times > first + 1e-6).tolist(),
        image_size(split.transforms.images[used], split.transforms.intrinsics[used].size),
        (views.width, views.height),
    )
    return replace(views, flow=flow)
