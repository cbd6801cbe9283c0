"""Held-out images, and each image's camera and time, from poses and times."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.scenes.images import image_size, load_images, raster_of
from devrf.scenes.lens import Intrinsics, Lens
from devrf.scenes.masks import cutting_out, valid_pixels
from devrf.scenes.resampling import as_pinhole
from devrf.scenes.scene import Views
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import same_shape, scene_error

log = logging.getLogger(__name__)


def every_nth(count: int, holdout: int, start: int | None = None) -> tuple[list[int], list[int]]:
    """The positions of training and held-out images, of ``count`` ≥ 2 images.

    Every ``holdout``-th (≥ 2) is held out, or the last one if there are fewer. ``start`` is the
    first held-out one: 0 for static images, as LLFF's scenes are scored; None: ``holdout`` − 1,
    since a sequence begins in the canonical state.
    """
    start = holdout - 1 if start is None else start
    held_out = list(range(start, count, holdout)) or [count - 1]
    return sorted(set(range(count)) - set(held_out)), held_out


def parted(
    train: Sequence[int],
    test: Sequence[int],
    holdout: int,
    where: object,
    start: int | None = None,
) -> tuple[list[int], list[int]]:
    """The positions of training and held-out images.

    Without ``test``, :func:`every_nth` chooses those held out among ``train``. DevrfError if
    ``where`` lists too few.
    """
    if test and not train:
        raise scene_error(where, "all images are held out; list some to learn from")
    if test:
        return list(train), list(test)
    if len(train) < 2:
        number = "one image" if train else "no image"
        raise scene_error(where, f"lists {number}; add more, one of them to hold out")
    learned, held_out = every_nth(len(train), holdout, start)
    return [train[k] for k in learned], [train[k] for k in held_out]


# Two poses are those of one camera if no entry differs by more than this, relative to its distance.
SAME_POSE = 1e-4


@dataclass(frozen=True)
class Split:
    """A split that is ordered but not yet loaded.

    Attributes:
        transforms: the file's images, in the order of the file.
        times: (N,) float32 in [0, 1].
        view: (N,) int64: the fixed camera of each image, or the image's own number.
        fixed: whether the cameras are fixed while time passes.
        index: (K,) int64, the positions in the file that are used, ascending.
    """

    transforms: Transforms
    times: Tensor
    view: Tensor
    fixed: bool
    index: Tensor

    def where(self, keep: Tensor) -> Split:
        """The same split, with only the used images that the mask ``keep`` (N,) has."""
        return replace(self, index=self.index[keep[self.index]])

    @property
    def used_times(self) -> Tensor:
        """(K,) the times of the used images."""
        return self.times[self.index]


def distinct_poses(poses: Tensor) -> Tensor:
    """(N,) int64: number of the distinct pose of each of (N, 3, 4), in order of appearance."""
    near = SAME_POSE * (1 + float(poses[:, :, 3].norm(dim=1).median()))
    entries = poses.flatten(1).double().numpy()
    # Poses that are near each other are so along any line, too: only few have to be compared. The
    # line is another one each time: a file could have all its poses across one that it knows.
    line = np.random.default_rng().normal(size=entries.shape[1])
    along = entries @ line
    reach = near * np.abs(line).sum()
    order = along.argsort()
    ends = np.searchsorted(along[order], [along - reach, along + reach])
    numbers = np.full(len(entries), -1)
    count = 0
    for row, (start, stop) in enumerate(ends.T):
        if numbers[row] < 0:
            rows = order[start:stop]
            rows = rows[(np.abs(entries[rows] - entries[row]) <= near).all(axis=1)]
            numbers[rows[numbers[rows] < 0]] = numbers[row] = count
            count += 1
    return torch.from_numpy(numbers)


def are_fixed(pose: Tensor) -> bool:
    """Whether cameras are fixed, by the number of each image's pose (N,).

    They are if poses have two images or more in the mean: a moving camera may return to a pose.
    """
    return len(pose) >= 2 * (int(pose.max()) + 1)


# The scene may well move if at least this share of images is by cameras that have others, too.
MANY_AGAIN = 0.25


def standing(poses: Tensor) -> str | None:
    """``24 of 32 images are by cameras that stand still``, by poses (N, 3, 4); None: too few."""
    images = torch.bincount(distinct_poses(poses))
    again = int(images[images > 1].sum())
    if again == 0 or again < MANY_AGAIN * len(poses):
        return None
    return f"{again} of {len(poses)} images are by cameras that stand still"


def check_timed_alike(*sets: Transforms) -> None:
    """DevrfError if images of one file have several times and those of another have none."""
    timed = [transforms for transforms in sets if transforms.times is not None]
    untimed = [transforms for transforms in sets if transforms.times is None]
    if untimed and not one_moment(*timed):
        raise scene_error(
            untimed[0].file,
            f'its frames have no "time", but those of {timed[0].file.name} have; give each its '
            "time in [0, 1]",
        )


def at_one_moment(transforms: Transforms) -> Split:
    """A split of a scene at rest: every image its own view, at time 0 whatever the file says."""
    order = torch.arange(len(transforms.images))
    return Split(transforms, torch.zeros(len(order)), order, False, order)


def one_moment(*sets: Transforms) -> bool:
    """Whether sets of images have no times, or one time altogether."""
    times = [time for transforms in sets for time in transforms.times or ()]
    return len(distinct_times(torch.tensor(times))) < 2


def in_motion(transforms: Transforms) -> Split:
    """A split of a scene in motion.

    Cameras are fixed (:func:`are_fixed`), or one camera moves and each image is its own view.
    Without times in the file, the images of V fixed views are time-major (frame = position // V;
    DevrfError if the views do not take turns) and those of a moving camera consecutive; images that
    are absent count.
    """
    order = torch.arange(len(transforms.images))
    camera = distinct_poses(transforms.poses)
    if transforms.times is not None:
        times, fixed = torch.tensor(transforms.times), are_fixed(camera)
    else:
        times, fixed = _by_turns(transforms)
    return Split(transforms, times.float(), camera if fixed else order, fixed, order)


def _by_turns(transforms: Transforms) -> tuple[Tensor, bool]:
    """Times (N,) by the positions in the file, and whether its cameras are fixed."""
    assert transforms.listed is not None  # as of all files without times
    poses, positions = transforms.listed
    order = torch.arange(len(poses))
    camera = distinct_poses(poses)
    views = int(camera.max()) + 1
    fixed = are_fixed(camera)
    if fixed and (len(order) % views or bool((camera != order % views).any())):
        raise scene_error(
            transforms.file,
            f"no times, and its {views} fixed views do not take turns; add a "
            "time to every frame, or list all views of frame 0, then all of frame 1 …",
        )
    frames = order // (views if fixed else 1)
    return (frames / frames.max().clamp(min=1))[list(positions)], fixed


def first_views(split: Split, count: int | None) -> Split:
    """The images of the first ``count`` fixed views (None: all); else DevrfError."""
    if count is None:
        return split
    file = split.transforms.file
    if not split.fixed:
        raise scene_error(
            file, "data.train_views needs fixed cameras, and these move; leave it null"
        )
    views = int(split.view.max()) + 1
    if count > views:
        raise scene_error(
            file, f"data.train_views={count}, but the set has {views} views; ask for fewer"
        )
    return split.where(split.view < count)


def evenly_spread(times: Tensor, frames: int) -> Tensor | None:
    """``frames`` of the distinct ``times`` (any shape), evenly spread, first and last included.

    Returns:
        (frames,) float32 ascending, or None when there are no more than ``frames`` distinct times.
    """
    distinct = distinct_times(times)
    if len(distinct) <= frames:
        return None
    return distinct[torch.linspace(0, len(distinct) - 1, frames).round().long()]


def distinct_times(times: Tensor) -> Tensor:
    """The distinct values (T,) in ``times`` (any shape), ascending."""
    ordered = times.flatten().sort().values
    fresh = torch.ones(len(ordered), dtype=torch.bool)
    fresh[1:] = ordered.diff() > FrameClock.TOLERANCE
    return ordered[fresh]


def at_times(split: Split, times: Tensor) -> Split:
    """The images of ``split`` taken at one of ``times`` (T,)."""
    gap = (split.times[:, None] - times).abs().amin(dim=1)
    return split.where(gap <= FrameClock.TOLERANCE)


def load_views(
    split: Split,
    root: Path,
    downscale: int,
    *,
    alpha_weighted: bool = True,
) -> Views:
    """Read the used images of a split, made smaller; their cameras are pinholes.

    Images of a lens with distortion are undistorted, and masks with them. ``root`` is the scene's
    folder; ``downscale`` applies unless the images have a factor of their own; ``alpha_weighted``
    is as for :func:`devrf.scenes.images.load_images`. DevrfError if an image, a mask or a lens is
    wrong, or they contradict each other.
    """
    used = split.index
    transforms = split.transforms[used.tolist()]
    files = transforms.images
    intrinsics = transforms.intrinsics
    sizes = [camera.size for camera in intrinsics]
    masks = transforms.masks or ()
    finish = cutting_out(masks, sizes, files) if transforms.cut_out else None
    by = transforms.downscale or downscale
    loaded = load_images(files, by, sizes, finish, alpha_weighted=alpha_weighted)
    if loaded.pixels.shape[3] == 4 and not bool(loaded.pixels[..., 3].any()):
        raise scene_error(
            files[0],
            f"its alpha is 0 everywhere, as in all {len(files)} images of its set: they would be "
            "invisible; save them without alpha, or with that of the subject",
        )
    _check_shared(intrinsics, loaded.files, files)
    distorted = [
        camera.lens(width, height, file).scaled(columns / width, rows / height)
        for camera, file, (width, height), (columns, rows) in zip(
            intrinsics, files, loaded.files, loaded.sizes, strict=True
        )
    ]
    ignored = () if transforms.cut_out else masks
    valid_mask = valid_pixels(ignored, loaded.files, loaded.sizes, sizes, distorted, files)
    # Undistorted after the images are made smaller: a tenth of the work for the same picture.
    pixels, lenses = as_pinhole(loaded.pixels, distorted, files, loaded.sizes)
    cameras = pinholes(transforms.poses, lenses, loaded.sizes)
    names = tuple(str(file.relative_to(root)) for file in files)
    return Views(
        pixels,
        cameras,
        split.times[used],
        split.view[used],
        names,
        ambiguous_orientation=loaded.ambiguous_orientation,
        valid_mask=valid_mask,
    )


def _check_shared(
    cameras: Sequence[Intrinsics], sizes: Sequence[tuple[int, int]], names: Sequence[Path]
) -> None:
    """DevrfError if a camera that names no size has images of several sizes.

    Its pixels are those of one of them; an angle alone holds for one image at several scales.
    """
    first: dict[int, int] = {}
    for k, camera in enumerate(cameras):
        j = first.setdefault(id(camera), k)
        by_angle = camera.focal == (None, None) and camera.center == (None, None)
        fits = same_shape(sizes[k], sizes[j]) if by_angle else sizes[k] == sizes[j]
        if camera.size is None and not fits:
            raise scene_error(
                names[k],
                f"{sizes[k][0]}x{sizes[k][1]} px, but {names[j]} has {sizes[j][0]}x{sizes[j][1]} "
                "px, and their camera names no size; give each frame its own fl_x, cx, cy, w and h",
            )


def file_sizes(split: Split, views: Views) -> list[tuple[int, int]]:
    """(width, height) of the file of each image of ``views``, those that the split uses."""

    def size(k: int) -> tuple[int, int]:
        return image_size(split.transforms.images[k], split.transforms.intrinsics[k].size)

    used: list[int] = split.index.tolist()
    if views.cameras.sizes is None:
        return [size(used[0])] * len(used)
    return [size(k) for k in used]


def pinholes(poses: Tensor, lenses: Sequence[Lens], sizes: Sequence[tuple[int, int]]) -> Cameras:
    """Cameras of N images of some (width, height) in pixels at poses (N, 3, 4), in float32."""
    width, height = raster_of(sizes)
    return Cameras(
        poses.float(),
        torch.tensor([lens.focal for lens in lenses]),
        torch.tensor([lens.center for lens in lenses]),
        width,
        height,
        torch.tensor(sizes) if len(set(sizes)) > 1 else None,
    )
