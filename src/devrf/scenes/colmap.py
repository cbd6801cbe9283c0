"""Scenes as COLMAP leaves them: a sparse model, and the images that it poses."""

from __future__ import annotations

from dataclasses import KW_ONLY
from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.scenes.capture_folders import chosen_dynamic, dynamic_folders
from devrf.scenes.colmap_images import images_of, posed_by, present_of
from devrf.scenes.colmap_model import SparseModel, model_folder, read_model
from devrf.scenes.colmap_views import fixed_views
from devrf.scenes.downscale import Downscale, whole_factor
from devrf.scenes.holdout import first_of_every
from devrf.scenes.image_folders import ImageFolder
from devrf.scenes.layout import Layout, fewer, load_layout, static_alone
from devrf.scenes.normalisation import Facing, World, normalised
from devrf.scenes.paths import scene_folder
from devrf.scenes.posed_reader import PosedReader
from devrf.scenes.reader import Count, EstimatedFlow, Holdout
from devrf.scenes.scene import Scene
from devrf.scenes.splits import at_rest, in_motion
from devrf.scenes.transforms import SceneBounds
from devrf.scenes.validation import scene_error


@dataclass(frozen=True)
class ColmapReader(PosedReader):
    """Reads COLMAP's ``sparse/0`` (or ``sparse``), binary or as text, and ``images/``.

    The scene is at rest, unless there are folders ``dynamic_<V>views/view1`` … of fixed cameras, as
    in DeVRF's forward-facing layout; the model then poses an image of each, ``view1.png`` or in
    ``view1/`` (:mod:`devrf.scenes.colmap_views`).

    The world is that of :func:`devrf.scenes.normalisation.normalised`, as ``stage=capture`` has it:
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
        space: as of :class:`~devrf.scenes.posed_reader.PosedReader`; with mattes ``auto`` is
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


def _bounds(world: World, mattes: bool) -> SceneBounds:
    """What the sparse points say of where the scene is."""
    if world.space == "ndc":
        return SceneBounds(space="ndc", near=world.near)
    if mattes:  # then nothing is around it, whatever points lie there
        return SceneBounds(space="world", box=world.box)
    return SceneBounds(space="contracted", near=world.near, far=world.far, box=world.box)
