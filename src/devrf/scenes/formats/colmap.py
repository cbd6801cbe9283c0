"""Scenes as COLMAP leaves them: a sparse model, and the images that it poses."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated

import pydantic
from pydantic import Field
from torch import Tensor

from devrf.scenes.files import scene_folder
from devrf.scenes.image_folders import (
    Downscale,
    ImageFolder,
    Missing,
    image_folder,
    present_images,
    whole_factor,
)
from devrf.scenes.images import image_at
from devrf.scenes.layout import Layout, fewer, load_layout, static_alone
from devrf.scenes.reader import Count, EstimatedFlow, Holdout, PosedReader
from devrf.scenes.scene import Scene
from devrf.scenes.sparse_model import (
    Facing,
    SparseModel,
    World,
    model_folder,
    normalised,
    read_model,
    suffix_of,
)
from devrf.scenes.splits import at_rest, first_of_every, in_motion
from devrf.scenes.transforms import SceneBounds, Transforms
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import chosen_dynamic, chosen_views, dynamic_folders, view_folders

IMAGES = "images"


def images_of(model: SparseModel, root: Path, factor: int) -> ImageFolder:
    """Where the images are, and by how much they are yet to be made smaller.

    Args:
        model: what poses them.
        root: the scene's folder.
        factor: by how much they are made smaller in all.

    Raises:
        DevrfError: there is no such folder.
    """
    source = image_folder(root, factor)
    # Smaller images that LLFF's tools have written have names of their own.
    renamed = image_at(source.path / model.images[0].name) is None
    if renamed and source.path.name != IMAGES and os.path.isdir(root / IMAGES):
        return ImageFolder(root / IMAGES, factor)
    return source


def present_of(model: SparseModel, folder: Path, root: Path, missing: Missing) -> dict[int, Path]:
    """The images that are in ``folder``, by their positions in the model."""
    file = model.folder / f"images{suffix_of(model.folder)}"
    from_file = os.path.relpath(folder, model.folder)
    names = [f"{from_file}/{image.name}" for image in model.images]
    return present_images(names, file, root, missing)


def posed_by(
    model: SparseModel,
    poses: Tensor,
    positions: Sequence[int],
    images: Sequence[Path],
    times: tuple[float, ...] | None = None,
) -> Transforms:
    """K images with cameras of the model.

    Args:
        model: N cameras.
        poses: (N, 3, 4) camera-to-world in the scene's world.
        positions: K positions in the model, whose cameras took the images.
        images: K files.
        times: K times in [0, 1]; None: the scene is at rest.
    """
    lenses = {number: camera.intrinsics for number, camera in model.cameras.items()}
    return Transforms(
        model.folder,
        tuple(lenses[model.images[k].camera] for k in positions),
        tuple(images),
        poses[list(positions)].float(),
        times,
    )


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


@pydantic.dataclasses.dataclass(frozen=True)
class ColmapReader(PosedReader):
    """Reads COLMAP's ``sparse/0`` (or ``sparse``), binary or as text, and ``images/``.

    The scene is at rest, unless there are folders ``dynamic_<V>views/view1`` … of fixed cameras, as
    in DeVRF's forward-facing layout; the model then poses an image of each, ``view1.png`` or in
    ``view1/`` (:mod:`devrf.scenes.formats.colmap`).

    The world is that of :func:`devrf.scenes.sparse_model.normalised`, as ``stage=capture`` has it:
    of cameras around a scene z points up and the middle of what they look at is the origin; cameras
    that all look within 45° of one direction make a forward-facing scene. The sparse points say
    near and far, and the box where the cameras' axes do not meet. Lenses are undistorted. Images
    come from ``images_<downscale>`` where it is there; else larger ones are made smaller.

    Attributes:
        dynamic: which ``dynamic_*views`` folder, where there are several.
        test_view: the fixed view to hold out: 4 is ``view4``, −1 the last, −2 the last but one.
        train_views: train on the first so many of the views that are not held out; None: all.
        holdout: one of so many static images is held out, in the order of their names, the first
            included.
        space: as of :class:`~devrf.scenes.reader.PosedReader`; with alpha masks ``auto`` is
            ``world`` instead of ``contracted``.
    """

    _: KW_ONLY
    downscale: Downscale = "up_to_4"
    flow: EstimatedFlow = "auto"
    dynamic: str | None = None
    test_view: Annotated[int, Field(strict=True)] = -1
    train_views: Count | None = None
    holdout: Holdout = 8

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        place = model_folder(folder)
        if place is None:
            raise scene_error(
                folder,
                "no COLMAP model (looked for cameras and images, .bin or .txt, in sparse/0, sparse "
                "and colmap/sparse/0); set data.root to the folder of sparse/ and images/",
            )
        model = read_model(place)
        world = normalised(model, _facing(self.space))
        size = model.cameras[model.images[0].camera].size
        factor = whole_factor(self.downscale, lambda factor: min(size) // factor)
        source = images_of(model, folder, factor)
        layout = self._layout(folder, model, world.poses, source, factor)
        layout, _ = fewer(layout, self.train_views, self.frames)
        static, dynamic = load_layout(layout, folder, source.downscale)
        bounds = _bounds(world, static.train.cut_out)
        return self.placed(folder, static, dynamic, bounds, "the sparse model")

    def _layout(
        self, folder: Path, model: SparseModel, poses: Tensor, source: ImageFolder, factor: int
    ) -> Layout:
        """The splits of a scene at rest, or of one with folders of fixed views."""
        present = present_of(model, source.path, folder, self.missing)
        images = posed_by(model, poses, list(present), list(present.values()))
        if len(present) < 2:
            raise scene_error(model.folder, "poses one image, expected one more to hold out")
        train, test = first_of_every(len(present), self.holdout)
        if self.dynamic is None and not dynamic_folders(folder):
            why = "there is no folder dynamic_<V>views"
            return static_alone(images[train], images[test], why)
        moving = chosen_dynamic(folder, self.dynamic)
        views = fixed_views(moving, model, poses, source, factor, self.test_view)
        # What the held-out camera saw of the scene at rest is held out, too.
        known = {k for k, position in enumerate(present) if position == views.held_out}
        train, test = [k for k in train if k not in known], sorted({*test, *known})
        rest = at_rest(images[train]), at_rest(images[test])
        return Layout(*rest, in_motion(views.train), in_motion(views.test))


def _facing(space: str) -> Facing:
    if space == "auto":
        return "auto"
    return "forward" if space == "ndc" else "inward"


def _bounds(world: World, cut_out: bool) -> SceneBounds:
    """What the sparse points say of where the scene is."""
    if world.space == "ndc":
        return SceneBounds(space="ndc", near=world.near)
    if cut_out:  # then nothing is around it, whatever points lie there
        return SceneBounds(space="world", box=world.box)
    return SceneBounds(space="contracted", near=world.near, far=world.far, box=world.box)
