"""Inward-facing scenes on disk: DeVRF's static + dynamic folders, and D-NeRF's single folder."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch

from devrf.scenes.bounds import inward_bounds
from devrf.scenes.flow_files import read_flow
from devrf.scenes.images import image_size
from devrf.scenes.scene import Background, Capture, Scene, Views
from devrf.scenes.splits import (
    Split,
    at_times,
    distinct_times,
    dynamic_split,
    evenly_spread,
    first_views,
    load_views,
    static_split,
)
from devrf.scenes.validation import (
    check_bound_scale,
    check_choice,
    check_count,
    checked_box,
    existing_folder,
    number,
    problem,
)

log = logging.getLogger(__name__)

FlowSource = Literal["files", "none"]


@dataclass(frozen=True)
class _Layout:
    """The four splits of a scene, and where flow files would lie."""

    static_train: Split
    static_test: Split
    dynamic_train: Split
    dynamic_test: Split
    flow_folder: Path


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
    check_count("data.downscale", downscale, 1)
    check_count("data.train_views", train_views, 1)
    check_count("data.frames", frames, 2)
    check_choice("data.background", background, get_args(Background))
    check_choice("data.flow", flow, get_args(FlowSource))
    check_bound_scale(bound_scale)
    _check_numbers(near, far, static_until)
    given_box = None if box is None else checked_box(box)
    folder = existing_folder(Path(root).expanduser())

    layout = _layout(folder, dynamic, static_until)
    layout, thinned = _subset(layout, train_views, frames)
    static, dynamic_ = _load(layout, folder, downscale)
    if flow == "files" and thinned:
        log.info("flow files dropped: with data.frames=%s neighbouring frames are left out", frames)
    elif flow == "files":
        dynamic_ = replace(dynamic_, train=_with_flow(dynamic_.train, layout))
    bounds = inward_bounds(
        static.train, dynamic_.train, [static.train, static.test, dynamic_.train, dynamic_.test],
        bound_scale=bound_scale, near=near, far=far, box=given_box,
    )
    return Scene(
        name or folder.resolve().name, "inward", static, dynamic_, bounds, background
    )


def _check_numbers(near: Any, far: Any, static_until: Any) -> None:
    for key, value in (("data.near", near), ("data.far", far)):
        if value is not None and number(value) is None:
            raise problem(key, f"expected a distance in world units or null, not {value!r}")
    until = number(static_until)
    if until is None or not 0 <= until <= 1:
        raise problem("data.static_until", f"expected a time in [0, 1], not {static_until!r}")


def _layout(root: Path, dynamic: str | None, static_until: float) -> _Layout:
    folders = sorted(f for f in root.glob("dynamic_*views") if f.is_dir())
    static = root / "static"
    if not static.is_dir() and not folders:
        if not (root / "transforms_train.json").is_file():
            raise problem(
                root, "expected static/ and dynamic_<V>views/, or transforms_train.json; "
                "set data.root to the scene's folder",
            )
        return _single_folder(root, static_until)
    existing_folder(static)
    moving = _chosen(root, folders, dynamic)
    layout = _Layout(
        static_split(static / "transforms_train.json", root),
        static_split(static / "transforms_test.json", root),
        dynamic_split(moving / "transforms_train.json", root),
        dynamic_split(moving / "transforms_test.json", root),
        moving / "train_flow",
    )
    return layout


def _chosen(root: Path, folders: list[Path], dynamic: str | None) -> Path:
    names = ", ".join(f.name for f in folders)
    if dynamic is not None:
        chosen = [f for f in folders if f.name == dynamic]
        if not chosen:
            found = names or "none"
            raise problem(root, f"no folder {dynamic!r} (found: {found}); correct data.dynamic")
        return chosen[0]
    if not folders:
        raise problem(root, "no folder dynamic_<V>views; add the capture of the moving scene")
    if len(folders) > 1:
        raise problem(root, f"several captures ({names}); choose one with data.dynamic=NAME")
    return folders[0]


def _single_folder(root: Path, static_until: float) -> _Layout:
    train = dynamic_split(root / "transforms_train.json", root)
    test = dynamic_split(root / "transforms_test.json", root)
    early = train.where(train.times <= static_until + 1e-6)
    if len(early.index) == 0:
        raise problem(
            train.transforms.file, f"no image at a time of data.static_until={static_until:g} or "
            "before to learn the static scene from; set it higher",
        )
    early_test = test.where(test.times <= static_until + 1e-6)
    if len(early_test.index) == 0:
        early_test = test
    log.warning(
        "no static set: the canonical field is learned from %d of the %d training images "
        "(times up to %g), and tested on %d of %d",
        len(early.index), len(train.index), static_until, len(early_test.index), len(test.index),
    )
    return _Layout(early, early_test, train, test, root / "train_flow")


def _subset(
    layout: _Layout, train_views: int | None, frames: int | None
) -> tuple[_Layout, bool]:
    """The layout with fewer dynamic views and times, and whether times were left out."""
    train, test = first_views(layout.dynamic_train, train_views), layout.dynamic_test
    if len(distinct_times(train.used_times)) < 2:
        raise problem(
            train.transforms.file, "all dynamic images have one time, expected at least 2 "
            "distinct times; give each frame its own",
        )
    kept = None if frames is None else evenly_spread(train.used_times, frames)
    if kept is not None:
        train, same = at_times(train, kept), at_times(test, kept)
        # Held-out times of their own (D-NeRF) need not meet the kept ones: then all stay.
        test = same if len(same.index) else test
    return replace(layout, dynamic_train=train, dynamic_test=test), kept is not None


def _load(layout: _Layout, root: Path, downscale: int) -> tuple[Capture, Capture]:
    splits = (
        layout.static_train, layout.static_test, layout.dynamic_train, layout.dynamic_test
    )
    loaded: list[tuple[Split, Views]] = []
    for split in splits:
        # Without a static set the captures share files: read them once.
        twin = next((v for s, v in loaded if _same_images(s, split)), None)
        loaded.append((split, load_views(split, root, downscale) if twin is None else twin))
    a, b, c, d = (views for _, views in loaded)
    return Capture(a, b), Capture(c, d)


def _same_images(a: Split, b: Split) -> bool:
    return a.transforms is b.transforms and torch.equal(a.index, b.index)


def _with_flow(views: Views, layout: _Layout) -> Views:
    split = layout.dynamic_train
    first = split.times.min()
    flow = read_flow(
        layout.flow_folder,
        split.index.tolist(),
        (views.times > first + 1e-6).tolist(),
        image_size(split.transforms.images[int(split.index[0])]),
        (views.width, views.height),
    )
    return replace(views, flow=flow)
