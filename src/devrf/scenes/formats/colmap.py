"""COLMAP's scenes: a sparse model, and the images that it poses."""

from __future__ import annotations

import logging
import os
from pathlib import Path, PurePosixPath
from typing import ClassVar

from pydantic.dataclasses import dataclass

from devrf.scenes.files import inside
from devrf.scenes.image_folders import ImageFolder, image_folder
from devrf.scenes.images import SUFFIXES
from devrf.scenes.layout import Layout, static_alone
from devrf.scenes.names import ImageFinder, present_images
from devrf.scenes.reader import FixedViewsReader, PosedReader
from devrf.scenes.scene import Capture
from devrf.scenes.sparse_model import Facing, SparseModel, normalised, scene_model
from devrf.scenes.splits import parted
from devrf.scenes.transforms import SceneBounds, Transforms
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import (
    dynamic_folder,
    held_out_view,
    view_folders,
    with_fixed_views,
)
from devrf.system.files import walk

log = logging.getLogger(__name__)

IMAGES = "images"
# A larger share of the images without a pose is worth a warning.
UNPOSED = 0.05
# How the cameras face the scene, by ``data.space``; other spaces: inward.
FACING: dict[str, Facing] = {"auto": "auto", "ndc": "forward"}


def images_of(model: SparseModel, root: Path, factor: int) -> ImageFolder:
    """The folder of the model's images, which are read ``factor`` times smaller; or DevrfError.

    A folder of smaller images is not used if ``images/`` has more of them: LLFF's tools rename the
    images that they make smaller, and copies may be incomplete.
    """
    source = image_folder(root, factor)
    full = root / IMAGES
    if source.path == full or not os.path.isdir(full):
        return source

    finder = ImageFinder(root)

    def absent(folder: Path) -> int:
        listed = [inside(root, folder, image.name, model.folder) for image in model.images]
        images = [finder.find(path) for path in listed]
        return sum(
            image is None or image.name.lower() != path.name.lower()
            for image, path in zip(images, listed, strict=True)
        )

    lacks = absent(source.path)
    if lacks <= absent(full):
        return source
    log.info(
        "%s lacks %d of the %d posed images: those in %s/ are made smaller",
        source.path,
        lacks,
        len(model.images),
        IMAGES,
    )
    return ImageFolder(full, factor)


def warn_of_unposed(posed: int, folder: Path) -> None:
    """Warn if a good part of the images in a folder is not among the ``posed`` ones."""
    files = (name for _, _, names in walk(folder) for name in names if name[0] != ".")
    total = sum(Path(name).suffix.lower() in SUFFIXES for name in files)
    if total - posed > UNPOSED * total:
        log.warning(
            "%d of the %d images in %s are posed, the others are left out; to pose more of them, "
            "film with more overlap, or run COLMAP's mapper again",
            posed,
            total,
            folder,
        )


def fixed_cameras(model: SparseModel, folder: Path, count: int) -> list[int]:
    """The positions in the model of an image by each of ``count`` fixed cameras.

    The model poses, among others, ``view1.png`` or an image in ``view1/``; ``folder`` is
    ``dynamic_<V>views``, for the DevrfError if a camera has no pose.
    """
    positions: dict[str, int] = {}
    for position, image in enumerate(model.images):
        path = PurePosixPath(image.name)
        positions.setdefault(path.stem, position)
        positions.setdefault(path.parent.name, position)
    names = [f"view{number}" for number in range(1, count + 1)]
    for name in names:
        if name not in positions:
            raise scene_error(
                model.folder,
                f"poses no image {name}.png, nor one in a folder {name}; put the first frame of "
                f"{folder.name}/{name} among the images, and run COLMAP again",
            )
    return [positions[name] for name in names]


@dataclass(frozen=True, kw_only=True)
class ColmapReader(PosedReader, FixedViewsReader):
    """Reads COLMAP's ``sparse/0``, binary or as text, and ``images/``.

    It reads the model with the most images, if there are several in ``sparse/``.

    The scene is static, unless there are folders ``dynamic_<V>views/view1`` … of fixed cameras, as
    in DeVRF's forward-facing layout; the model then poses an image of each, ``view1.png`` or in
    ``view1/``.

    The world is that of :func:`devrf.scenes.sparse_model.normalised`: for cameras around a scene, z
    points up and the origin is the middle of the scene; cameras that all look within 45° of one
    direction make a forward-facing scene. The sparse points give near and far, and the box if
    the cameras' axes do not meet. Images are undistorted.

    Attributes:
        space: as of :class:`~devrf.scenes.reader.PosedReader`; with alpha masks ``auto`` is
            ``world`` instead of ``contracted``.
    """

    stater: ClassVar[str] = "the sparse model"

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        model, others = scene_model(folder)
        if others:
            log.info(
                "%s is read, which poses the most images, %d; left alone: %s",
                model.folder,
                len(model.images),
                ", ".join(others),
            )
        poses, bounds = normalised(model, FACING.get(self.space, "inward"))
        cameras = (model.cameras[k] for k in dict.fromkeys(i.camera for i in model.images))
        width, height = max(((int(c["w"]), int(c["h"])) for c in cameras), key=max)
        factor = self.choose_factor(lambda factor: (width // factor, height // factor))
        source = images_of(model, folder, factor)
        lenses = model.intrinsics
        names = [image.name for image in model.images]
        listing = model.folder / "images"
        finder = ImageFinder(folder)
        present = present_images(names, listing, finder, self.missing, relative_to=source.path)
        warn_of_unposed(len(present), source.path)
        positions = list(present)
        images = Transforms(
            model.folder,
            tuple(lenses[k] for k in positions),
            tuple(present.values()),
            poses[positions].float(),
            None,
            downscale=source.downscale,
            bounds=bounds,
        )
        train, test = parted(range(len(positions)), (), self.holdout, model.folder, start=0)
        moving = dynamic_folder(folder, self.dynamic)
        if moving is None:
            why = "there is no folder dynamic_<V>views"
            return static_alone(images[train], images[test], why)
        views = view_folders(moving, factor)
        posed = fixed_cameras(model, moving, len(views))
        test_view = held_out_view(len(views), self.test_view)
        # The held-out camera's static image is held out, too.
        unseen = {k for k, position in enumerate(positions) if position == posed[test_view]}
        train = [k for k in train if k not in unseen]
        test = sorted({*test, *unseen})
        return with_fixed_views(
            (images[train], images[test]),
            views,
            posed_by=model.folder,
            poses=poses[posed],
            lenses=[lenses[k] for k in posed],
            test=test_view,
        )

    def stated(self, layout: Layout, static: Capture) -> SceneBounds | None:
        """The bounds of the sparse points."""
        bounds = layout.bounds
        if bounds and bounds.space == "contracted" and static.train.cut_out:
            # The scene is bounded, whatever points lie around it.
            return SceneBounds(space="world", box=bounds.box)
        return bounds
