"""Scenes in nerfstudio's layout: one ``transforms.json`` for all images, with a time on each."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from devrf.scenes.bounds import inward_bounds
from devrf.scenes.holdout import every_nth
from devrf.scenes.json_files import json_object
from devrf.scenes.layout import Layout, fewer, load_layout, without_static_set
from devrf.scenes.masks import Masks
from devrf.scenes.options import check_options
from devrf.scenes.paths import scene_folder
from devrf.scenes.scene import Background, Scene
from devrf.scenes.splits import at_rest, distinct_poses, in_motion
from devrf.scenes.transforms import Transforms, listed_image, read_transforms
from devrf.scenes.validation import abbreviated, check_choice, check_count, scene_error

log = logging.getLogger(__name__)

FILE = "transforms.json"
# So many images at time 0 are a static set: from fewer no field can be learned.
_SEVERAL = 3
_AT_REST = 1e-6


def read_nerfstudio(
    root: str | Path,
    *,
    name: str | None = None,
    downscale: int = 1,
    background: Background = "white",
    bound_scale: float | str = "auto",
    near: float | None = None,
    far: float | None = None,
    box: list[list[float]] | None = None,
    train_views: int | None = None,
    frames: int | None = None,
    holdout: int = 8,
    static_until: float | None = None,
    masks: Masks = "ignore",
) -> Scene:
    """Read a scene that cameras look in at, from ``transforms.json`` and images.

    The file may lie in ``root``, with a ``time`` in [0, 1] on every frame, or in
    ``root/static`` and, with times, in ``root/dynamic``. Cameras may stand still or move.
    Held-out images are those in ``test_filenames`` (else ``val_filenames``), else every
    ``holdout``-th. Images are undistorted; the world is that of the file's poses.

    A frame's ``mask_path`` is a grey image, black where the mask leaves pixels out, of the size
    of the image or of its camera. In nerfstudio's meaning these pixels say nothing (people who
    walk by): "ignore" neither learns from them nor scores them, and the fields show there what
    other images say. "matte" takes them for background (a person who was cut out), as an alpha
    channel would be taken: that also shows where the scene is and where it moves.

    Args:
        root: the scene's folder.
        name: short name; None takes the folder's.
        downscale: integer factor ≥ 1 by which images are made smaller.
        background: what is behind the mattes of RGBA images; RGB images are used as they are.
        bound_scale: "auto" (room for motion from silhouettes) or a number ≥ 1 by which the
            tightened canonical box is enlarged.
        near: distance in world units before which nothing is; None: from the cameras.
        far: distance in world units behind which nothing is; None: from the cameras.
        box: [[x, y, z], [x, y, z]] in world units; None: from the cameras.
        train_views: train on the first so many dynamic views; None: all.
        frames: keep so many times, evenly spread, first and last included; None: all.
        holdout: without lists in the file, one of so many images is held out.
        static_until: in one file, the latest time of an image that counts as static; None: 0
            where several images are of time 0, else 1.
        masks: what the masks of the frames are taken for: "ignore", "matte", or "none" to leave
            them alone.

    Raises:
        DevrfError: a file or an option is wrong; the message names it.
    """
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
    check_count("data.holdout", holdout, 2)
    check_choice("data.masks", masks, get_args(Masks))
    folder = scene_folder(root)
    masked = masks != "none"
    layout, _ = fewer(_layout(folder, holdout, static_until, masked), train_views, frames)
    static, dynamic = load_layout(layout, folder, downscale, masks)
    bounds = inward_bounds(
        static.train,
        dynamic.train,
        [static.train, static.test, dynamic.train, dynamic.test],
        bound_scale=bound_scale,
        near=near,
        far=far,
        box=given_box,
    )
    return Scene(name or folder.resolve().name, "inward", static, dynamic, bounds, background)


def _layout(root: Path, holdout: int, static_until: float | None, masked: bool) -> Layout:
    if os.path.isfile(root / FILE):
        both = _train_and_test(root / FILE, root, holdout, masked)
        return _one_file(*_with_times(*both), static_until)
    still, moving = root / "static" / FILE, root / "dynamic" / FILE
    if not os.path.isfile(still) and not os.path.isfile(moving):
        raise scene_error(
            root,
            f"expected {FILE}, or static/{FILE} and dynamic/{FILE}; set data.root to the "
            "scene's folder",
        )
    rest = _train_and_test(still, root, holdout, masked)
    motion = _with_times(*_train_and_test(moving, root, holdout, masked))
    return Layout(at_rest(rest[0]), at_rest(rest[1]), in_motion(motion[0]), in_motion(motion[1]))


def _with_times(train: Transforms, test: Transforms) -> tuple[Transforms, Transforms]:
    if train.times is None:
        raise scene_error(
            train.file,
            'its frames have no "time", which a capture of a moving scene needs; '
            "give every frame its time in [0, 1]",
        )
    return train, test


def _train_and_test(
    file: Path, root: Path, holdout: int, masked: bool
) -> tuple[Transforms, Transforms]:
    transforms = read_transforms(file, root, masked=masked)
    count = len(transforms.images)
    content = json_object(file, "every capture needs its posed images")
    listed = {
        split: _listed(content, f"{split}_filenames", transforms, root)
        for split in ("train", "val", "test")
    }
    test = listed["test"] or listed["val"]
    elsewhere = set(listed["val"] + listed["test"])
    train = listed["train"] or [i for i in range(count) if i not in elsewhere]
    if listed["train"] and not test:
        test = sorted(set(range(count)) - set(train))
    elif not test and count > 1:
        train, test = every_nth(count, holdout)
    if not train or not test or set(train) & set(test):
        raise scene_error(
            file,
            f"{len(train)} images to learn from, {len(test)} held out, "
            f"{len(set(train) & set(test))} of them both; expected at least one of each and none "
            "twice: correct train_filenames and test_filenames",
        )
    return transforms[train], transforms[test]


def _listed(content: dict[str, Any], key: str, transforms: Transforms, root: Path) -> list[int]:
    """Positions in the file, ascending, of the images that it lists under ``key``."""
    names = content.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise scene_error(transforms.file, f"expected a list of file paths as {key}; correct it")
    position = {image: i for i, image in enumerate(transforms.images)}
    found = []
    for name in names:
        image = listed_image(name, transforms.file, root)
        if image not in position:
            raise scene_error(
                transforms.file,
                f"{key} lists {abbreviated(name)}, which is in none of the frames; correct it",
            )
        found.append(position[image])
    return sorted(set(found))


def _one_file(train: Transforms, test: Transforms, static_until: float | None) -> Layout:
    """The layout of a file that holds the scene at rest and in motion."""
    times = _times(train)
    at_zero = times <= _AT_REST
    if static_until is None:
        static_until = 0.0 if int(at_zero.sum()) >= _SEVERAL else 1.0
    if static_until > 0 or not bool(at_zero.any()):
        return without_static_set(in_motion(train), in_motion(test), static_until)
    still = at_zero.nonzero()[:, 0].tolist()
    still_test = (_times(test) <= _AT_REST).nonzero()[:, 0].tolist()
    moving, moving_test = _seen_moving(train), _seen_moving(test)
    if not moving or not moving_test:
        raise scene_error(
            train.file,
            f"{len(moving)} images to learn motion from and {len(moving_test)} held "
            "out, expected at least one of each at a time above 0; correct the times, or "
            "train_filenames and test_filenames",
        )
    if not still_test:
        log.warning("no held-out image at time 0: the static scene is tested on one in training")
        still_test, rest_test = still[:1], train
    else:
        rest_test = test
    log.info("%d images at time 0 are the static set of %d", len(still), len(times))
    return Layout(
        at_rest(train[still]),
        at_rest(rest_test[still_test]),
        in_motion(train[moving]),
        in_motion(test[moving_test]),
    )


def _seen_moving(transforms: Transforms) -> list[int]:
    """The images at later times, and those at time 0 by cameras that stay to see more.

    What else there is at time 0 tells nothing of motion, and its many cameras would hide that
    the others stand still.
    """
    later = _times(transforms) > _AT_REST
    camera = distinct_poses(transforms.poses)
    kept: list[int] = (later | torch.isin(camera, camera[later])).nonzero()[:, 0].tolist()
    return kept


def _times(transforms: Transforms) -> Tensor:
    assert transforms.times is not None  # _with_times asks for them
    return torch.tensor(transforms.times)
