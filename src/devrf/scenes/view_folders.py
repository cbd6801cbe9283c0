"""Folders of a moving capture: ``dynamic_<V>views``, ``view1`` … ``viewV``, and their flow."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from devrf.scenes.files import entries
from devrf.scenes.flow_files import FlowDirection, stacked_flow
from devrf.scenes.image_folders import ImageFolder, image_folder, shot_together
from devrf.scenes.layout import Layout, Pair
from devrf.scenes.lens import Intrinsics
from devrf.scenes.names import last_number
from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.splits import Split, at_one_moment, file_sizes
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import scene_error
from devrf.system.files import utf8_path


def dynamic_folders(root: Path) -> list[Path]:
    """The folders ``dynamic_<V>views`` of ``root``, in order of their names."""
    return [
        utf8_path(path)
        for path in entries(root)
        if fnmatch.fnmatch(path.name, "dynamic_*views") and os.path.isdir(path)
    ]


def dynamic_folder(root: Path, name: str | None) -> Path | None:
    """The one of :func:`dynamic_folders` called ``name``; for None the only one, or None.

    DevrfError if there is none of that name, or there are several for None.
    """
    folders = dynamic_folders(root)
    names = ", ".join(folder.name for folder in folders)
    named = [folder for folder in folders if name in (None, folder.name)]
    if name is not None and not named:
        raise scene_error(
            root, f"no folder {name!r} (found: {names or 'none'}); correct data.dynamic"
        )
    if len(named) > 1:
        raise scene_error(root, f"several captures ({names}); choose one with data.dynamic=NAME")
    return named[0] if named else None


_VIEW = re.compile(r"view(\d{1,6})")


@dataclass(frozen=True)
class ViewFolder(ImageFolder):
    """One fixed camera's T ``images`` in order of time."""

    images: list[Path]


def view_folders(folder: Path, downscale: int) -> list[ViewFolder]:
    """The folders of V fixed cameras, in order of their numbers.

    DevrfError if there are none, a number is left out or written with a zero in front, or they hold
    different numbers of images or fewer than two.
    """
    numbered: dict[int, Path] = {}
    for path in entries(folder):
        match = _VIEW.fullmatch(path.name)
        if match and os.path.isdir(path):
            numbered[int(match[1])] = path
    if not numbered:
        raise scene_error(folder, "no folders view1, view2, …; add one for each fixed camera")
    for number in range(1, len(numbered) + 1):
        if number not in numbered or numbered[number].name != f"view{number}":
            raise scene_error(
                folder,
                f"no folder view{number} although there is {numbered[max(numbered)].name}; number "
                "the fixed cameras' folders from 1 on, without zeros in front",
            )
    sources = [image_folder(path, downscale) for _, path in sorted(numbered.items())]
    for source in sources:
        if source.downscale != sources[0].downscale:
            raise scene_error(
                source.path.parent,
                f"no folder {sources[0].path.name} as the other views have; add it",
            )
    taken = shot_together([source.path for source in sources])
    views = [
        ViewFolder(source.path, source.downscale, images)
        for source, images in zip(sources, taken, strict=True)
    ]
    if min(len(views), len(views[0].images)) < 2:
        raise scene_error(
            folder,
            f"has {len(views)} views of {len(views[0].images)} images, expected 2 or more of both",
        )
    return views


def held_out_view(count: int, test_view: int) -> int:
    """The position of the held-out one of ``count`` views, by its number; else DevrfError.

    Numbers count from 1 on; −1 is the last one.
    """
    if test_view == 0 or not -count <= test_view <= count:
        raise scene_error(
            "data.test_view",
            f"{test_view} is none of the {count} views; give 1 … {count}, or -1 for the last one",
        )
    return test_view - 1 if test_view > 0 else count + test_view


def with_fixed_views(
    static: Pair,
    views: list[ViewFolder],
    posed_by: Path,
    poses: Tensor,
    lenses: Sequence[Intrinsics],
    test: int,
) -> Layout:
    """The layout of a static capture, and a dynamic one by V fixed cameras.

    The dynamic images are all of the first frame, then all of the next. The ``views`` have
    ``poses`` (V, 3, 4), camera-to-world, and ``lenses``, both from the file ``posed_by``; ``test``
    is the position of the held-out one.
    """
    frames = len(views[0].images)

    def split_of(cameras: list[int]) -> Split:
        shots = [(t, v) for t in range(frames) for v in cameras]
        camera = [v for _, v in shots]
        transforms = Transforms(
            posed_by,
            tuple(lenses[v] for v in camera),
            tuple(views[v].images[t] for t, v in shots),
            poses[camera].float(),
            tuple(t / (frames - 1) for t, _ in shots),
            downscale=views[0].downscale,
        )
        number = torch.arange(len(cameras)).repeat(frames)
        times = torch.tensor(transforms.times)
        return Split(transforms, times, number, True, torch.arange(len(shots)))

    train = split_of([v for v in range(len(views)) if v != test])
    return Layout(at_one_moment(static[0]), at_one_moment(static[1]), train, split_of([test]))


def flow_of_views(split: Split, views: Views, direction: FlowDirection) -> OpticalFlow | None:
    """The flow in ``<folder>_flow`` beside the folders of fixed cameras' images; None: no file.

    Backward flow is in ``<frame>_bwd.npz``, and frame 0 has none; forward flow in
    ``<frame>_fwd.npz``, and the last frame has none. A name gives the frame in one of three ways:
    by its image's name (``0007`` for ``0007.png``), by the last number in it (``7`` for
    ``img_0007.png``), or by its position, counted from 0. The way that matches the most files holds
    for all views, the first of equal ones.
    """
    suffix = f"_{direction}.npz"
    ways: tuple[Callable[[int, Path], str | int | None], ...] = (
        lambda position, image: image.stem,
        lambda position, image: last_number(image.stem),
        lambda position, image: position,
    )
    images = [split.transforms.images[k] for k in split.index.tolist()]
    folders = {
        image.parent: image.parent.with_name(f"{image.parent.name}_flow") for image in images
    }
    named = {folder: _named(flow, suffix) for folder, flow in folders.items()}
    count = len(folders)
    length = len(images) // count
    frames = range(1, length) if direction == "bwd" else range(length - 1)
    shots = [
        (t, t * count + view, images[t * count + view]) for view in range(count) for t in frames
    ]
    candidates = [
        {
            row: named[image.parent][name]
            for t, row, image in shots
            if (name := way(t, image)) in named[image.parent]
        }
        for way in ways
    ]
    best = max(candidates, key=len)
    pattern = folders[images[0].parent] / f"<frame>{suffix}"
    return stacked_flow(best, len(shots), pattern, file_sizes(split, views), views.cameras)


def _named(folder: Path, suffix: str) -> dict[str | int | None, Path]:
    """The files whose names end with ``suffix``, by the text before it, and by it as a number."""
    files: dict[str | int | None, Path] = {}
    for path in sorted(folder.glob(f"*{suffix}")):
        name = path.name.removesuffix(suffix)
        files[name] = path
        if name.isdecimal():
            files[int(name)] = path
    return files
