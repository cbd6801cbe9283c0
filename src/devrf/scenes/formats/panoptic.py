"""The Panoptic sports scenes of Dynamic 3D Gaussians: cameras of a dome, listed time by time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeVar

import torch
from pydantic import BaseModel, Field
from pydantic.dataclasses import dataclass

from devrf.geometry.offset import Offset
from devrf.scenes.files import MOST_IMAGES, Name, Positive, Vector3, Vector4, read_json
from devrf.scenes.layout import Layout, with_static_times
from devrf.scenes.lens import Intrinsics
from devrf.scenes.names import ImageFinder
from devrf.scenes.reader import InwardReader
from devrf.scenes.transforms import Shot, Transforms, posed_images
from devrf.scenes.validation import scene_error

TRAIN = "train_meta.json"
TEST = "test_meta.json"

Entry = TypeVar("Entry")
Listed = Annotated[list[Entry], Field(fail_fast=True, min_length=1, max_length=MOST_IMAGES)]
# Of each time, an entry for each image taken then.
ByTime = Listed[Listed[Entry]]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]


class _Meta(BaseModel):
    """The content of a file.

    Attributes:
        w: width of the images in pixels.
        h: height of them.
        k: intrinsics in pixels, rows.
        w2c: world-to-camera, rows, OpenCV axes.
        fn: images, relative to ``ims/``.
    """

    w: Positive
    h: Positive
    k: ByTime[Matrix3]
    w2c: ByTime[Matrix4]
    fn: ByTime[Name]


@dataclass(frozen=True, kw_only=True)
class PanopticReader(InwardReader):
    """Reads ``train_meta.json``, ``test_meta.json``, ``ims/`` and ``seg/``.

    Cameras all around take an image each at each time. Those of the first time are the static set.

    Attributes:
        masks: ``none``: the dome behind the subject is learned, too; ``alpha``: what is black in
            ``seg/`` is background.
    """

    masks: Literal["none", "alpha"] = "none"

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        finder = ImageFinder(folder)
        files = (folder / TRAIN, folder / TEST)
        what = "it lists the images and their cameras; add it"
        learned, held_out = (read_json(file, _Meta, what) for file in files)
        if len(held_out.fn) != len(learned.fn):
            raise scene_error(
                files[1],
                f"lists {len(held_out.fn)} times, and {TRAIN} {len(learned.fn)}; list all of them",
            )
        train = self._listed(files[0], learned, finder)
        test = self._listed(files[1], held_out, finder, train.offset)
        return with_static_times(train, test, 0.0)

    def _listed(
        self, file: Path, meta: _Meta, finder: ImageFinder, offset: Offset | None = None
    ) -> Transforms:
        """The images of a file; positions lose the ``offset``, or one of their own."""
        fn, *others = ([len(taken) for taken in lists] for lists in (meta.fn, meta.k, meta.w2c))
        if others != [fn, fn]:
            raise scene_error(file, "fn, k and w2c do not list as many images; correct them")
        if sum(fn) > MOST_IMAGES:
            raise scene_error(file, f"lists more than {MOST_IMAGES} images; leave some out")
        last = max(len(fn) - 1, 1)
        shots = [
            Shot(
                f"ims/{name}",
                torch.tensor(to_camera, dtype=torch.float64),
                Intrinsics((k[0][0], k[1][1]), (k[0][2], k[1][2]), (meta.w, meta.h), skew=k[0][1]),
                time / last,
                f"seg/{name}" if self.masks == "alpha" else None,
            )
            for time, taken in enumerate(zip(meta.fn, meta.k, meta.w2c, strict=True))
            for name, k, to_camera in zip(*taken, strict=True)
        ]
        return posed_images(file, shots, finder, self.missing, offset)
