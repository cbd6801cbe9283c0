"""The images that a sparse model poses: which are there, and with which cameras."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from devrf.scenes.absent_images import Missing, present_images
from devrf.scenes.colmap_model import SparseModel, suffix_of
from devrf.scenes.image_files import image_at
from devrf.scenes.image_folders import ImageFolder, image_folder
from devrf.scenes.transforms import Transforms

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
    """The images that are in ``folder``, by their positions in the model.

    Raises:
        DevrfError: what :func:`devrf.scenes.absent_images.present_images` raises.
    """
    file = model.folder / f"images{suffix_of(model.folder)}"
    from_file = os.path.relpath(folder, model.folder)
    return present_images([f"{from_file}/{one.name}" for one in model.images], file, root, missing)


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
