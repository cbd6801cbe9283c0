"""Forward-facing scenes on disk: LLFF's static folder and DeVRF's folder of fixed views."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from devrf.scenes.capture_folders import chosen_dynamic
from devrf.scenes.flow_files import stacked_flow
from devrf.scenes.forward_bounds import forward_bounds, reference_space
from devrf.scenes.image_files import Size, image_size
from devrf.scenes.image_folders import image_folder, listed_images
from devrf.scenes.images import load_images
from devrf.scenes.llff_poses import PosedSet, read_dynamic_poses, read_static_poses
from devrf.scenes.paths import existing_folder, scene_folder
from devrf.scenes.scene import Background, Capture, Scene, Views
from devrf.scenes.validation import check_choice, check_count, number, scene_error
from devrf.scenes.view_folders import ViewFolder, flow_files, view_folders

log = logging.getLogger(__name__)

FlowSource = Literal["files", "none"]


def read_llff(
    root: str | Path,
    *,
    name: str | None = None,
    dynamic: str | None = None,
    downscale: int = 4,
    background: Background = "white",
    test_view: int = -1,
    holdout: int = 8,
    near: float = 1.0,
    flow: FlowSource = "files",
    train_views: int | None = None,
    frames: int | None = None,
) -> Scene:
    """Read a scene that cameras face from one side: ``static/`` and ``dynamic_<V>views/``.

    The world's unit is 0.75 of the least depth of the static cameras, their average pose its
    origin and axes (x right, y up, −z forward). The scene's space is NDC of that camera.

    Args:
        root: the scene's folder.
        name: short name; None takes the folder's.
        dynamic: which ``dynamic_*views`` folder, where there are several.
        downscale: integer factor ≥ 1: ``images_<downscale>`` where it is there; else larger
            images, made smaller by area averages.
        background: what is behind the mattes of RGBA images; RGB images are used as they are.
        test_view: the fixed view to hold out: 4 is ``view4``, −1 the last, −2 the last but one.
        holdout: every so manieth static image is held out, the first one included.
        near: distance of the near plane from the average camera, in the world's unit; the
            nearest point of the static scene is at 1/0.75.
        flow: "files" reads backward flow where there is any; "none" does not.
        train_views: train on the first so many of the views that are not held out; None: all.
        frames: keep so many frames, evenly spread, first and last included; None: all.

    Raises:
        DevrfError: a file or an option is wrong; the message names it.
    """
    check_count("data.downscale", downscale, 1)
    check_count("data.holdout", holdout, 2)
    check_count("data.train_views", train_views, 1)
    check_count("data.frames", frames, 2)
    check_choice("data.background", background, get_args(Background))
    check_choice("data.flow", flow, get_args(FlowSource))
    plane = number(near)
    if plane is None or plane <= 0:
        raise scene_error("data.near", f"expected a distance above 0, not {near!r}")
    folder = scene_folder(root)

    static = _static(existing_folder(folder / "static"), folder, downscale, holdout)
    moving = chosen_dynamic(folder, dynamic)
    dynamic_ = _dynamic(moving, folder, downscale, test_view, train_views, frames, flow)
    space = reference_space(static.train.cameras, plane)
    everyone = [static.train, dynamic_.train]
    bounds = forward_bounds(everyone, space, "all that the cameras see (forward-facing)")
    # The held-out cameras need not see inside the box, but they have to look the same way.
    forward_bounds([static.test, dynamic_.test], space, "")
    _warn_of_cameras_beyond(plane, [*everyone, static.test, dynamic_.test])
    return Scene(
        name or folder.resolve().name, "forward", static, dynamic_, bounds, background, space
    )


def _static(folder: Path, root: Path, downscale: int, holdout: int) -> Capture:
    posed = read_static_poses(folder).normalised()
    source = image_folder(folder, downscale)
    images = listed_images(source.path)
    if len(images) != len(posed):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but {source.path} has {len(images)} images; "
            "remove the images without a camera, or write the cameras again",
        )
    if len(images) < 2:
        raise scene_error(source.path, "holds one image, expected at least one more to hold out")
    loaded = load_images(images, source.downscale, posed.sizes)
    count, height, width = loaded.pixels.shape[:3]
    views = Views(
        loaded.pixels,
        posed.cameras(width, height),
        torch.zeros(count),
        torch.arange(count),
        _names(images, root),
        ambiguous_orientation=loaded.doubtful,
    )
    order = torch.arange(count)
    train, test = views[order[order % holdout != 0]], views[order[order % holdout == 0]]
    return Capture(_numbered(train), _numbered(test))


def _numbered(views: Views) -> Views:
    """Static views with their own positions as view numbers."""
    return replace(views, view=torch.arange(len(views)))


def _dynamic(
    folder: Path,
    root: Path,
    downscale: int,
    test_view: int,
    train_views: int | None,
    frames: int | None,
    flow: FlowSource,
) -> Capture:
    views = view_folders(folder, downscale)
    posed = read_dynamic_poses(folder)
    if len(posed) < len(views):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but there are {len(views)} folders view1 … "
            f"view{len(views)}; the last rows are those of the fixed cameras",
        )
    posed = posed.last(len(views))
    test, train = _chosen_views(folder, len(views), test_view, train_views)
    total = len(views[0].images)
    kept = torch.arange(total)
    if frames is not None and frames < total:
        kept = torch.linspace(0, total - 1, frames).round().long()
    train_set, test_set = (
        _moving([views[v] for v in chosen], posed, chosen, kept, root) for chosen in (train, [test])
    )
    if flow == "files" and len(kept) < total:
        log.info("flow files dropped: with data.frames=%s neighbouring frames are left out", frames)
    elif flow == "files":
        train_set = _with_flow(train_set, [views[v] for v in train], posed.sizes[train[0]])
    return Capture(train_set, test_set)


def _chosen_views(
    folder: Path, count: int, test_view: int, train_views: int | None
) -> tuple[int, list[int]]:
    """Positions of the held-out view and of the views to learn from."""
    whole = isinstance(test_view, int) and not isinstance(test_view, bool)
    if not whole or test_view == 0 or not -count <= test_view <= count:
        raise scene_error(
            "data.test_view",
            f"{test_view!r} is none of the {count} views in {folder}; give 1 … "
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


def _moving(
    folders: list[ViewFolder], posed: PosedSet, chosen: list[int], kept: Tensor, root: Path
) -> Views:
    """All views at the first frame, then all at the next, and so on."""
    images = [folder.images[k] for k in kept.tolist() for folder in folders]
    sizes = [posed.sizes[v] for v in chosen] * len(kept)
    loaded = load_images(images, folders[0].downscale, sizes)
    count, height, width = loaded.pixels.shape[:3]
    view = torch.arange(len(folders)).repeat(len(kept))
    times = kept / (len(folders[0].images) - 1)
    cameras = posed.cameras(width, height)[torch.tensor(chosen)][view]
    return Views(
        loaded.pixels,
        cameras,
        times.float().repeat_interleave(len(folders)),
        view,
        _names(images, root),
        ambiguous_orientation=loaded.doubtful,
    )


def _with_flow(views: Views, folders: list[ViewFolder], camera: Size) -> Views:
    files = flow_files(folders)
    if not files:
        log.info("no optical flow: no <frame>_bwd.npz in %s and its like", folders[0].flow)
        return views
    rows = {frame * len(folders) + view: path for (view, frame), path in sorted(files.items())}
    source = image_size(folders[0].images[0], camera)
    return replace(views, flow=stacked_flow(rows, len(views), source, (views.width, views.height)))


def _names(images: list[Path], root: Path) -> tuple[str, ...]:
    return tuple(str(image.relative_to(root)) for image in images)


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
