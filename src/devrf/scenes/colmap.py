"""Scenes at rest as COLMAP leaves them: a sparse model, and the images that it poses."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY
from pathlib import Path

from pydantic.dataclasses import dataclass

from devrf.scenes.absent_images import Missing, present_images
from devrf.scenes.colmap_model import SparseModel, model_folder, read_model, suffix_of
from devrf.scenes.downscale import Downscale, whole_factor
from devrf.scenes.holdout import first_of_every
from devrf.scenes.image_files import image_at
from devrf.scenes.image_folders import ImageFolder, image_folder
from devrf.scenes.layout import fewer, load_layout, static_alone
from devrf.scenes.normalisation import Facing, World, normalised
from devrf.scenes.paths import scene_folder
from devrf.scenes.posed_reader import PosedReader
from devrf.scenes.reader import EstimatedFlow, Holdout
from devrf.scenes.scene import Scene
from devrf.scenes.transforms import SceneBounds, Transforms
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

IMAGES = "images"


@dataclass(frozen=True)
class ColmapReader(PosedReader):
    """Reads COLMAP's ``sparse/0`` (or ``sparse``), binary or as text, and ``images/``.

    The scene is at rest. Its world is that of :func:`devrf.scenes.normalisation.normalised`, as
    ``stage=capture`` has it: of cameras around a scene z points up and the middle of what they look
    at is the origin; cameras that all look within 45° of one direction make a forward-facing scene.
    The sparse points say near, far and box. Lenses are undistorted. Images come from
    ``images_<downscale>`` where it is there; else larger ones are made smaller.

    Attributes:
        holdout: one of so many images is held out, in the order of their names, the first included.
        space: as of :class:`~devrf.scenes.posed_reader.PosedReader`; with mattes ``auto`` is
            ``world`` instead of ``contracted``.
    """

    _: KW_ONLY
    downscale: Downscale = "up_to_4"
    flow: EstimatedFlow = "auto"
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
        source = _image_folder(folder, model, self.downscale)
        images = _posed(model, world, source.path, folder, self.missing)
        count = len(images.images)
        if count < 2:
            raise scene_error(images.file, "poses one image, expected one more to hold out")
        train, test = first_of_every(count, self.holdout)
        layout = static_alone(images[train], images[test], "a COLMAP model says no times")
        layout, _ = fewer(layout, None, self.frames)
        static, dynamic = load_layout(layout, folder, source.downscale)
        return self.placed(folder, static, dynamic, _bounds(world, static.train.cut_out))


def _facing(space: str) -> Facing:
    if space == "auto":
        return "auto"
    return "forward" if space == "ndc" else "inward"


def _bounds(world: World, mattes: bool) -> SceneBounds:
    """What the sparse points say of where the scene is."""
    if world.space == "ndc":
        return SceneBounds(space="ndc", near=world.near)
    if mattes:  # then nothing is around it, whatever points lie there
        return SceneBounds(space="world", box=world.box)
    return SceneBounds(space="contracted", near=world.near, far=world.far, box=world.box)


def _image_folder(folder: Path, model: SparseModel, downscale: int | str) -> ImageFolder:
    """Where the images are, and by how much they are yet to be made smaller."""
    size = model.cameras[model.images[0].camera].size
    factor = whole_factor(downscale, lambda factor: min(size) // factor)
    source = image_folder(folder, factor)
    # Smaller images that LLFF's tools have written have names of their own.
    renamed = image_at(source.path / model.images[0].name) is None
    if renamed and source.path.name != IMAGES and os.path.isdir(folder / IMAGES):
        return ImageFolder(folder / IMAGES, factor)
    return source


def _posed(
    model: SparseModel, world: World, images: Path, root: Path, missing: Missing
) -> Transforms:
    """The images that are there, with their cameras in the normalised world."""
    file = model.folder / f"images{suffix_of(model.folder)}"
    from_file = os.path.relpath(images, model.folder)
    names = [f"{from_file}/{one.name}" for one in model.images]
    present = present_images(names, file, root, missing)
    lenses = {number: camera.intrinsics for number, camera in model.cameras.items()}
    return Transforms(
        file,
        tuple(lenses[model.images[k].camera] for k in present),
        tuple(present.values()),
        world.poses[list(present)].float(),
        None,
        skipped=len(names) - len(present),
    )
