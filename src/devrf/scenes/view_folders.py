"""Folders of a moving capture: ``dynamic_<V>views``, ``view1`` … ``viewV``, and their flow."""

from __future__ import annotations

import fnmatch
import logging
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devrf.scenes.files import entries
from devrf.scenes.flow_files import FlowDirection
from devrf.scenes.image_folders import image_folder, listed_images
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


def dynamic_folders(root: Path) -> list[Path]:
    """The folders ``dynamic_<V>views`` of ``root``, in order of their names."""
    return [
        path
        for path in entries(root)
        if fnmatch.fnmatch(path.name, "dynamic_*views") and os.path.isdir(path)
    ]


def chosen_dynamic(root: Path, chosen: str | None) -> Path:
    """The one of :func:`dynamic_folders` called ``chosen``, or (None) the only one.

    Raises:
        DevrfError: there is none, none of that name, or several to choose from.
    """
    folders = dynamic_folders(root)
    names = ", ".join(folder.name for folder in folders)
    if chosen is not None:
        named = [folder for folder in folders if folder.name == chosen]
        if not named:
            found = names or "none"
            raise scene_error(root, f"no folder {chosen!r} (found: {found}); correct data.dynamic")
        return named[0]
    if not folders:
        raise scene_error(root, "no folder dynamic_<V>views; add the capture of the moving scene")
    if len(folders) > 1:
        raise scene_error(root, f"several captures ({names}); choose one with data.dynamic=NAME")
    return folders[0]


_VIEW = re.compile(r"view([1-9]\d{0,5})")
_FROM_ZERO = re.compile(r"view0\d*")
_DIGITS = re.compile(r"\d+")


@dataclass(frozen=True)
class ViewFolder:
    """What one fixed camera recorded.

    Attributes:
        images: T files in order of time.
        downscale: integer factor by which they are yet to be made smaller.
        flow: the folder where optical flow of these files would lie.
    """

    images: list[Path]
    downscale: int
    flow: Path


def view_folders(folder: Path, downscale: int) -> list[ViewFolder]:
    """The folders of V fixed cameras, in order of their numbers.

    Raises:
        DevrfError: there are none, a number is left out or written with a zero in front, or
            they hold different numbers of images or fewer than two.
    """
    numbered = {}
    for path in entries(folder):
        match = _VIEW.fullmatch(path.name)
        if _FROM_ZERO.fullmatch(path.name) and os.path.isdir(path):
            raise scene_error(
                path,
                "views are numbered view1, view2, … from 1 on, without zeros in front; rename the "
                "fixed cameras' folders, in the order of their rows in poses.npy",
            )
        if match and os.path.isdir(path):
            numbered[int(match[1])] = path
    if not numbered:
        raise scene_error(folder, "no folders view1, view2, …; add one for each fixed camera")
    for number in range(1, len(numbered) + 1):
        if number not in numbered:
            raise scene_error(
                folder,
                f"no folder view{number} although there is view{max(numbered)}; number "
                "the fixed cameras' folders from 1 on",
            )
    views: list[ViewFolder] = []
    for _, path in sorted(numbered.items()):
        source = image_folder(path, downscale)
        images = listed_images(source.path, by_number=True)
        if views and len(images) != len(views[0].images):
            raise scene_error(
                source.path,
                f"has {len(images)} images, but {views[0].images[0].parent} has "
                f"{len(views[0].images)}; each fixed camera needs one image a frame",
            )
        if views and source.downscale != views[0].downscale:
            raise scene_error(
                path, f"no folder {views[0].images[0].parent.name} as the other views have; add it"
            )
        views.append(ViewFolder(images, source.downscale, source.flow))
    if len(views[0].images) < 2:
        raise scene_error(folder, "its views have one image each, expected at least 2 frames")
    return views


def chosen_views(
    folder: Path, count: int, test_view: int, train_views: int | None
) -> tuple[int, list[int]]:
    """Positions of the held-out view and of the views to learn from.

    Args:
        folder: where the views are, for messages.
        count: how many there are.
        test_view: the number of the one to hold out, from 1 on; −1 is the last one.
        train_views: learn from the first so many of the others; None: all.

    Raises:
        DevrfError: there is no such view, or there are too few.
    """
    if test_view == 0 or not -count <= test_view <= count:
        raise scene_error(
            "data.test_view",
            f"{test_view} is none of the {count} views in {folder}, view1 … view{count}; give 1 … "
            f"{count}, or -1 for the last one",
        )
    test = test_view - 1 if test_view > 0 else count + test_view
    train = [v for v in range(count) if v != test]
    if not train:
        raise scene_error(folder, "has one view, expected at least one more to learn from")
    if train_views is not None and train_views > len(train):
        raise scene_error(
            folder,
            f"data.train_views={train_views}, but there are {len(train)} views to learn "
            "from next to the held-out one; ask for fewer",
        )
    return test, train[:train_views]


def flow_files(
    views: list[ViewFolder], direction: FlowDirection = "bwd"
) -> dict[tuple[int, int], Path]:
    """Which file holds the backward flow of (view, frame), which frame 0 has not.

    Forward flow is in ``<frame>_fwd.npz``, and the last frame has none.

    ``<frame>_bwd.npz`` may name a frame in three ways: by its image's name (``0007`` for
    ``0007.png``), by the last number in it (``7`` for ``img_0007.png``), or by its position,
    counted from 0. The way that finds the most files holds for all views; in doubt the first.
    """
    ways: tuple[Callable[[int, Path], str | int | None], ...] = (
        lambda position, image: image.stem,
        lambda position, image: _last_number(image.stem),
        lambda position, image: position,
    )
    suffix, best = f"_{direction}.npz", dict[tuple[int, int], Path]()
    for way in ways:
        found: dict[tuple[int, int], Path] = {}
        for v, view in enumerate(views):
            named: dict[str | int | None, Path] = {}
            for path in entries(view.flow) if os.path.isdir(view.flow) else ():
                name = path.name.removesuffix(suffix)
                if name == path.name or not os.path.isfile(path):
                    continue
                named[name] = path
                if name.isdecimal():
                    named[int(name)] = path
            for k, image in enumerate(view.images):
                path_of = named.get(way(k, image))
                without = 0 if direction == "bwd" else len(view.images) - 1
                if k != without and path_of is not None:
                    found[v, k] = path_of
        if len(found) > len(best):
            best = found
    expected = len(views) * (len(views[0].images) - 1) if views else 0
    if 0 < len(best) < expected:
        log.warning(
            "%d of %d flow files are missing in %s and its like; those images go without flow",
            expected - len(best),
            expected,
            views[0].flow,
        )
    return best


def _last_number(stem: str) -> int | None:
    numbers = _DIGITS.findall(stem)
    return int(numbers[-1]) if numbers else None
