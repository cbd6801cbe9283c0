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
from devrf.scenes.flow_files import FlowDirection, warn_of_missing
from devrf.scenes.image_folders import ImageFolder, image_folder, listed_images
from devrf.scenes.lens import Intrinsics
from devrf.scenes.splits import Split
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


def chosen_dynamic(root: Path, chosen: str | None) -> Path:
    """The one of :func:`dynamic_folders` called ``chosen``, or (None) the only one.

    DevrfError if there is none, none of that name, or several to choose from.
    """
    folders = dynamic_folders(root)
    names = ", ".join(folder.name for folder in folders)
    if chosen is not None:
        named = [folder for folder in folders if folder.name == chosen]
        if not named:
            raise scene_error(
                root, f"no folder {chosen!r} (found: {names or 'none'}); correct data.dynamic"
            )
        return named[0]
    if not folders:
        raise scene_error(root, "no folder dynamic_<V>views; add the capture of the moving scene")
    if len(folders) > 1:
        raise scene_error(root, f"several captures ({names}); choose one with data.dynamic=NAME")
    return folders[0]


_VIEW = re.compile(r"view(\d{1,6})")
_DIGITS = re.compile(r"\d+")


@dataclass(frozen=True)
class ViewFolder(ImageFolder):
    """What one fixed camera recorded: T ``images`` in order of time."""

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
    views: list[ViewFolder] = []
    for _, path in sorted(numbered.items()):
        source = image_folder(path, downscale)
        images = listed_images(source.path)
        if views and len(images) != len(views[0].images):
            raise scene_error(
                source.path,
                f"has {len(images)} images, but {views[0].path} has "
                f"{len(views[0].images)}; each view needs one a frame",
            )
        if views and source.downscale != views[0].downscale:
            raise scene_error(
                path, f"no folder {views[0].path.name} as the other views have; add it"
            )
        views.append(ViewFolder(source.path, source.downscale, images))
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


def fixed_views(
    views: list[ViewFolder], posed_by: Path, poses: Tensor, lenses: Sequence[Intrinsics], test: int
) -> tuple[Split, Split]:
    """What fixed cameras saw, to learn from and held out: all at the first frame, then at the next.

    The V ``views`` have ``poses`` (V, 3, 4), camera-to-world, and ``lenses``, both from the file
    ``posed_by``; ``test`` is the position of the held-out one.
    """
    frames = len(views[0].images)

    def of(chosen: list[int]) -> Split:
        shots = [(t, v) for t in range(frames) for v in chosen]
        cameras = [v for _, v in shots]
        times = tuple(t / (frames - 1) for t, _ in shots)
        transforms = Transforms(
            posed_by,
            tuple(lenses[v] for v in cameras),
            tuple(views[v].images[t] for t, v in shots),
            poses[cameras].float(),
            times,
        )
        number = torch.arange(len(chosen)).repeat(frames)
        return Split(transforms, torch.tensor(times), number, True, torch.arange(len(shots)))

    return of([v for v in range(len(views)) if v != test]), of([test])


def flow_files(
    views: list[ViewFolder], direction: FlowDirection = "bwd"
) -> dict[tuple[int, int], Path]:
    """The file that holds the backward flow of (view, frame); frame 0 has none.

    Forward flow is in ``<frame>_fwd.npz``, and the last frame has none.

    ``<frame>_bwd.npz`` may name a frame in three ways: by its image's name (``0007`` for
    ``0007.png``), by the last number in it (``7`` for ``img_0007.png``), or by its position,
    counted from 0. The way that finds the most files holds for all views; of equal ones the first.
    """
    suffix = f"_{direction}.npz"
    ways: tuple[Callable[[int, Path], str | int | None], ...] = (
        lambda position, image: image.stem,
        lambda position, image: _last_number(image.stem),
        lambda position, image: position,
    )
    frames = len(views[0].images)
    shots = [
        (v, k, view.images[k], files)
        for v, view in enumerate(views)
        for files in [_named(view.flow, suffix)]
        for k in (range(1, frames) if direction == "bwd" else range(frames - 1))
    ]
    candidates = [
        {(v, k): files[name] for v, k, image, files in shots if (name := way(k, image)) in files}
        for way in ways
    ]
    best = max(candidates, key=len)
    if best:
        warn_of_missing(len(best), len(shots), views[0].flow)
    return best


def _named(folder: Path, suffix: str) -> dict[str | int | None, Path]:
    """The files whose names end with ``suffix``, by what comes before it, as text and as number."""
    files: dict[str | int | None, Path] = {}
    for path in sorted(folder.glob(f"*{suffix}")):
        name = path.name.removesuffix(suffix)
        files[name] = path
        if name.isdecimal():
            files[int(name)] = path
    return files


def _last_number(stem: str) -> int | None:
    numbers = _DIGITS.findall(stem)
    return int(numbers[-1]) if numbers else None
