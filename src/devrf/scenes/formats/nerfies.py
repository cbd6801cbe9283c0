"""Scenes in the layout of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, RootModel
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.geometry.cameras import Distortion
from devrf.geometry.offset import offset_of, subtracted
from devrf.scenes.bounds import FALLBACK_BOUND_SCALE, axes_do_meet, box_of_frusta
from devrf.scenes.files import (
    MOST_IMAGES,
    Ids,
    Number,
    Positive,
    Vector2,
    Vector3,
    inside,
    read_json,
)
from devrf.scenes.image_folders import ImageFolder, folder_size, image_folder
from devrf.scenes.layout import Layout, one_capture
from devrf.scenes.lens import Intrinsics
from devrf.scenes.names import ImageFinder, present_images
from devrf.scenes.reader import InwardReader, Time
from devrf.scenes.scene import Capture, Scene
from devrf.scenes.splits import parted
from devrf.scenes.transforms import SceneBounds, Transforms
from devrf.scenes.validation import FARTHEST, check_poses, scene_error
from devrf.system.options import Several, abbreviated

log = logging.getLogger(__name__)

Length = Annotated[Positive, Field(le=FARTHEST)]


class World(BaseModel):
    """The frame of reference, (position − center) · scale.

    Attributes:
        center: centre of the world, in the cameras' units.
        scale: world units in one of the cameras'.
        near: least distance of the scene, world units.
        far: largest distance of the scene, world units.
    """

    center: Vector3
    scale: Length
    near: Length
    far: Length


class Camera(BaseModel):
    """The content of a camera file; pixels are those of the full image.

    Attributes:
        orientation: rows of the world-to-camera rotation.
        position: position of the camera, in the file's units.
        focal_length: pixels, horizontally.
        pixel_aspect_ratio: vertical over horizontal focal length.
        skew: pixels.
        image_size: width, height.
        principal_point: pixels.
        radial_distortion: k1, k2, k3.
        tangential_distortion: p1, p2; the example in Nerfies' documentation says "tangential".
    """

    orientation: tuple[Vector3, Vector3, Vector3]
    position: Vector3
    focal_length: Positive
    pixel_aspect_ratio: Positive = 1.0
    skew: Number = 0.0
    image_size: tuple[Positive, Positive]
    principal_point: Vector2
    radial_distortion: Vector3 = (0.0, 0.0, 0.0)
    tangential_distortion: Vector2 = Field(
        (0.0, 0.0), validation_alias=AliasChoices("tangential", "tangential_distortion")
    )


def read_camera(folder: Path, item: str, world: World) -> tuple[Tensor, Intrinsics]:
    """Camera-to-world (3, 4) float64, OpenGL axes, world units, and intrinsics of the full image.

    DevrfError if the camera file of the image with the id ``item`` is missing or wrong.
    """
    file = inside(folder, folder / "camera", f"{item}.json", folder / "dataset.json")
    camera = read_json(file, Camera, "every image needs its camera; add it")
    world_to_camera = torch.tensor(camera.orientation, dtype=torch.float64)
    # OpenCV's y points down and its z ahead; ours point up and back.
    axes = world_to_camera.T * world_to_camera.new_tensor([1, -1, -1])
    position = (axes.new_tensor(camera.position) - axes.new_tensor(world.center)) * world.scale
    pose = torch.cat([axes, position[:, None]], dim=1)
    check_poses(pose[None], lambda _: f"{file}: orientation or position")
    focal = camera.focal_length
    intrinsics = Intrinsics(
        (focal, focal * camera.pixel_aspect_ratio),
        camera.principal_point,
        camera.image_size,
        Distortion((*camera.radial_distortion, 0.0), camera.tangential_distortion),
        camera.skew,
    )
    return pose, intrinsics


# N ids, and the positions of training and held-out images.
Listed = tuple[list[str], list[int], list[int]]


@dataclass(frozen=True, kw_only=True)
class ItemsReader(InwardReader):
    """Reads layouts that keep a camera file for each image, and have no static set.

    World units, near and far are those of ``scene.json``: (position − center) · scale. Images come
    from ``rgb/<downscale>x``, or from a larger folder and are made smaller. Without alpha masks the
    scene is unbounded; if the cameras look in nearly one direction, the box is that of their frusta
    between near and far.

    Attributes:
        holdout: one of so many images is held out, if there is no list of them.
        static_until: the latest time of an image that counts as static.
    """

    listing: ClassVar[str]

    holdout: Several = 8
    static_until: Time = 1.0

    @abstractmethod
    def listed(self, folder: Path) -> Listed:
        """The images in ``listing``, in the scene's folder."""

    @abstractmethod
    def moments(self, folder: Path, ids: Sequence[str]) -> Sequence[float]:
        """The times of images, on some scale."""

    def masks_of(
        self, folder: Path, ids: Sequence[str], images: ImageFolder
    ) -> tuple[Path | None, ...] | None:
        """The masks of images; pixels that they leave out are ignored. None: no masks."""
        return None

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        items, *split = self.listed(folder)
        listing = folder / self.listing
        world = read_json(
            folder / "scene.json", World, "it says where the scene is; set data.root to its folder"
        )
        factor = self.choose_factor(folder_size(folder / "rgb", full="1x", reduced="{}x"))
        images = image_folder(folder / "rgb", factor, full="1x", reduced="{}x")
        files = [f"rgb/{images.path.name}/{item}" for item in items]
        present = present_images(files, listing, ImageFinder(folder), self.missing)
        ids = [items[position] for position in present]
        row = {position: k for k, position in enumerate(present)}
        train, test = ([row[p] for p in part if p in row] for part in split)
        if not train or not test:
            raise scene_error(
                listing, "all images to learn from, or all that are held out, are absent; add them"
            )
        cameras = [read_camera(folder, item, world) for item in ids]
        poses = torch.stack([pose for pose, _ in cameras])
        offset = offset_of(poses)
        moments = self.moments(folder, ids)
        first = min(moments)
        span = (max(moments) - first) or 1.0
        posed = Transforms(
            listing,
            tuple(intrinsics for _, intrinsics in cameras),
            tuple(present.values()),
            subtracted(poses, offset).float(),
            tuple((moment - first) / span for moment in moments),
            self.masks_of(folder, ids, images),
            downscale=images.downscale,
            bounds=SceneBounds(space="contracted", near=world.near, far=world.far),
            offset=offset,
        )
        return one_capture(posed[train], posed[test], self.static_until)

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`devrf.scenes.reader.LayoutReader.placed`."""
        stated = layout.bounds
        assert stated and stated.near and stated.far  # those of scene.json
        near = stated.near if self.near is None else self.near
        far = stated.far if self.far is None else self.far
        options = replace(self, near=near, far=far)
        cameras = static.train.cameras
        wide = self.box is None and not static.train.cut_out and 0 <= near < far
        if not wide or (self.space != "world" and axes_do_meet(cameras)):
            return InwardReader.placed(options, layout, static, dynamic)
        # Without alpha masks the backdrop is learned, too.
        frusta_box = box_of_frusta(cameras, near, far).moved(layout.offset)
        scale = FALLBACK_BOUND_SCALE if self.bound_scale == "auto" else self.bound_scale
        options = replace(options, box=frusta_box, space="world", bound_scale=scale)
        scene = InwardReader.placed(options, layout, static, dynamic)
        why = "data.space=world" if self.space == "world" else "the cameras look in one direction"
        bounds = replace(scene.bounds, reason=why, box_source="all that the cameras see up to far")
        return replace(scene, bounds=bounds)


class _Dataset(BaseModel):
    """``dataset.json``: the ids of the images; numbers become text."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    ids: Ids | None = None
    train_ids: Ids | None = None
    val_ids: Ids | None = None


class _Moment(BaseModel):
    """An entry of ``metadata.json``: the time of an image, on some scale."""

    time_id: Number | None = None
    warp_id: Number | None = None


def _few(moments: object) -> object:
    """Few entries: each may be an error, of 1 kB, before pydantic compares their number."""
    if isinstance(moments, dict) and len(moments) > MOST_IMAGES:
        raise ValueError(f"expected at most {MOST_IMAGES} images, not {len(moments)}; correct it")
    return moments


_Moments = RootModel[Annotated[dict[str, _Moment], BeforeValidator(_few)]]


@dataclass(frozen=True)
class NerfiesReader(ItemsReader):
    """Reads ``dataset.json``, ``metadata.json``, ``scene.json``, ``camera/`` and ``rgb/<n>x/``.

    The time of an image is its ``time_id`` (HyperNeRF), else its ``warp_id``, brought to [0, 1].
    Images are undistorted. The scene is static if they all have one time.
    """

    listing: ClassVar[str] = "dataset.json"

    def listed(self, folder: Path) -> Listed:
        """The ids in ``dataset.json``."""
        file = folder / self.listing
        listed = read_json(file, _Dataset, "it lists the images; add it")
        ids = listed.ids or []
        train = listed.train_ids or []
        val = listed.val_ids or []
        items = ids or list(dict.fromkeys(train + val))
        position = {item: i for i, item in enumerate(items)}
        unknown = [item for item in train + val if item not in position]
        if unknown:
            raise scene_error(
                file, f'{abbreviated(unknown[0])} is in train_ids or val_ids, but not in "ids"'
            )
        scored = set(val)
        if both := scored.intersection(train):
            log.warning("%s: %d images of val_ids are in train_ids too; held out", file, len(both))
        learned = [position[item] for item in train or items if item not in scored]
        held_out = [position[item] for item in val]
        return items, *parted(learned, held_out, self.holdout, file)

    def moments(self, folder: Path, ids: Sequence[str]) -> Sequence[float]:
        """The times in ``metadata.json``: all ``time_id``, or else all ``warp_id``."""
        file = folder / "metadata.json"
        purpose = "it says when each image was taken; add it, with one time_id for all at rest"
        moments = read_json(file, _Moments, purpose).root
        absent = [item for item in ids if item not in moments]
        if absent:
            raise scene_error(file, f"lacks image {abbreviated(absent[0])}; add its warp_id")
        times = [moments[item].time_id for item in ids]
        if None in times:
            times = [moments[item].warp_id for item in ids]
        if None in times:
            item = ids[times.index(None)]
            raise scene_error(file, f"image {abbreviated(item)} has no warp_id; add it")
        return [time for time in times if time is not None]
