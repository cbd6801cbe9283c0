"""Fixed cameras beside COLMAP's images: ``dynamic_<V>views/view1`` …, each posed by one image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from torch import Tensor

from devrf.scenes.colmap_images import posed_by
from devrf.scenes.colmap_model import SparseModel
from devrf.scenes.image_folders import ImageFolder
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import chosen_views, view_folders


@dataclass(frozen=True)
class FixedViews:
    """What the fixed cameras saw of the scene in motion.

    Attributes:
        train: images to learn from: all views at the first frame, then all at the next.
        test: those of the held-out view.
        held_out: the position in the model of the image that poses the held-out camera.
    """

    train: Transforms
    test: Transforms
    held_out: int


def fixed_views(
    folder: Path,
    model: SparseModel,
    poses: Tensor,
    static: ImageFolder,
    downscale: int,
    test_view: int,
) -> FixedViews:
    """The images below ``folder``, with cameras and times.

    Args:
        folder: ``dynamic_<V>views``.
        model: poses, among others, an image of each fixed camera: ``view1.png``, or in ``view1/``.
        poses: (N, 3, 4) camera-to-world of the model's images, world units.
        static: where the static images are read from.
        downscale: by how much images are made smaller in all.
        test_view: the number of the view to hold out, from 1 on; −1 is the last one.

    Raises:
        DevrfError: a folder or an image is missing, or a camera has no pose.
    """
    views = view_folders(folder, downscale)
    if views[0].downscale != static.downscale:
        raise scene_error(
            folder,
            f"its views are not read from {static.path.name}, as the static images are; give both "
            "the same folders of images",
        )
    posed = [_poser(model, number, folder) for number in range(1, len(views) + 1)]
    test, train = chosen_views(folder, len(views), test_view, None)
    moments = range(len(views[0].images))

    def of(chosen: list[int]) -> Transforms:
        shots = [(t, v) for t in moments for v in chosen]
        times = tuple(t / moments[-1] for t, _ in shots)
        files = [views[v].images[t] for t, v in shots]
        return posed_by(model, poses, [posed[v] for _, v in shots], files, times)

    return FixedViews(of(train), of([test]), posed[test])


def _poser(model: SparseModel, number: int, folder: Path) -> int:
    """The position in the model of the image by a fixed camera."""
    name = f"view{number}"
    for position, one in enumerate(model.images):
        path = PurePosixPath(one.name)
        if name in (path.stem, path.parent.name):
            return position
    raise scene_error(
        model.folder,
        f"poses no image {name}.png, nor one in a folder {name}, to say where the camera of "
        f"{folder.name}/{name} stands; put its first frame among the images, and run COLMAP again",
    )
