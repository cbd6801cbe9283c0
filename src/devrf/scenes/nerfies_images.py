"""``rgb/<n>x/`` and ``camera/`` of Nerfies' layout: listed images become posed ones with times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from devrf.scenes.absent_images import Missing, present_images
from devrf.scenes.downscale import folder_factor
from devrf.scenes.image_folders import ImageFolder, image_folder
from devrf.scenes.layout import Layout, static_alone, without_static_set
from devrf.scenes.nerfies_camera import read_camera
from devrf.scenes.nerfies_world import World
from devrf.scenes.splits import in_motion, one_moment
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import scene_error


@dataclass(frozen=True)
class ListedItems:
    """The images of a list that are there.

    Attributes:
        file: the list.
        items: N ids, in its order.
        images: N existing files.
        place: what place among these an image has, by its position in the list.
    """

    file: Path
    items: tuple[str, ...]
    images: tuple[Path, ...]
    place: dict[int, int]

    def positions(self, wanted: Sequence[int]) -> list[int]:
        """Those of the positions in the list that are there, among the N; else DevrfError."""
        kept = [self.place[position] for position in wanted if position in self.place]
        if not kept:
            raise scene_error(
                self.file,
                "all images to learn from, or all that are held out, are absent; add them",
            )
        return kept


def images_at(folder: Path, downscale: int | str) -> ImageFolder:
    """The folder ``rgb/<n>x`` to read from, and by how much its images are to be made smaller."""
    names = {"full": "1x", "reduced": "{}x"}
    return image_folder(folder / "rgb", folder_factor(folder / "rgb", downscale, **names), **names)


def list_items(
    folder: Path, file: Path, items: Sequence[str], images: ImageFolder, missing: Missing
) -> ListedItems:
    """The images that are there.

    Args:
        folder: the scene's folder.
        file: what lists the images, in the scene's folder.
        items: their ids.
        images: the folder that they are in.
        missing: as for :func:`devrf.scenes.absent_images.present_images`.

    Raises:
        DevrfError: what :func:`devrf.scenes.absent_images.present_images` raises.
    """
    names = [f"rgb/{images.path.name}/{item}" for item in items]
    present = present_images(names, file, folder, missing)
    place = {position: k for k, position in enumerate(present)}
    return ListedItems(
        file, tuple(items[position] for position in present), tuple(present.values()), place
    )


def posed_items(
    folder: Path, listed: ListedItems, world: World, moments: Sequence[float]
) -> Transforms:
    """The images with cameras and times.

    Args:
        folder: the scene's folder.
        listed: N images.
        world: the frame of reference.
        moments: when each was taken, on some scale; the first becomes 0, the last 1.

    Raises:
        DevrfError: a camera is missing or wrong.
    """
    cameras = [read_camera(folder, item, world.center, world.scale) for item in listed.items]
    first, span = min(moments), (max(moments) - min(moments)) or 1.0
    return Transforms(
        listed.file,
        tuple(intrinsics for _, intrinsics in cameras),
        listed.images,
        torch.stack([pose for pose, _ in cameras]),
        tuple((moment - first) / span for moment in moments),
    )


def motion_layout(
    transforms: Transforms, train: list[int], test: list[int], source: str, until: float
) -> Layout:
    """The layout of one capture without a static set, or of one moment.

    Args:
        transforms: all images.
        train: positions of those to learn from.
        test: positions of those held out.
        source: the file that says the times, for the log.
        until: the latest time of an image that counts as static.

    Raises:
        DevrfError: what :func:`devrf.scenes.layout.without_static_set` raises.
    """
    if not one_moment(transforms):
        return without_static_set(in_motion(transforms[train]), in_motion(transforms[test]), until)
    why = f"all images have one time in {source}"
    return static_alone(transforms[train], transforms[test], why)
