"""A scene written to disk in the published layout of its kind: Blender's, LLFF's; nerfstudio's."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.offset import added
from devrf.scenes.files import Numbers
from devrf.scenes.flow_files import write_flow
from devrf.scenes.formats.llff_poses import BOUND_FACTOR
from devrf.scenes.scene import Capture, Scene, Views
from devrf.scenes.validation import scene_error
from devrf.system.files import atomic_folder, write_json

_WRITE_HINT = "give prepare.into another folder"


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into that becomes ``folder``, new or empty, if nothing fails.

    DevrfError if it is in use, or cannot be written.
    """
    folder = folder.expanduser().absolute()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise scene_error(folder, f"is there already and not an empty folder; {_WRITE_HINT}")
    try:
        with atomic_folder(folder) as partial:
            yield partial
    except OSError as error:
        raise scene_error(folder, f"cannot be written ({error}); {_WRITE_HINT}") from error


def time_major(views: Views) -> Views:
    """The views in order of time; those of one time in order of their cameras."""
    by_view = torch.argsort(views.view, stable=True)
    return views[by_view[torch.argsort(views.times[by_view], stable=True)]]


def export(scene: Scene, folder: Path) -> None:
    """Write an embedded ``scene`` for ``data=inward`` or ``data=forward``, depending on its kind.

    Images of one size have one focal length, and principal points are in the middle; cameras are
    fixed, and one of them is held out. A video by one moving camera is written for
    ``data=nerfstudio``. ``folder`` is new or empty. Positions are those of the capture's world.
    DevrfError if the folder is in use or cannot be written, or if some views of a forward-facing
    scene lack a frame.
    """
    write = _export_blender if scene.kind == "inward" else _export_llff
    if scene.dynamic.train.by_moving_camera:
        write = _export_video
    write(in_capture_world(scene), folder)


def in_capture_world(scene: Scene) -> Scene:
    """The scene with its offset added to all cameras, whose poses are in double precision then."""
    if not any(scene.offset):
        return scene

    def moved(views: Views) -> Views:
        poses = added(views.cameras.camera_to_world, scene.offset)
        return replace(views, cameras=replace(views.cameras, camera_to_world=poses))

    return replace(scene, static=scene.static.mapped(moved), dynamic=scene.dynamic.mapped(moved))


def _export_video(scene: Scene, folder: Path) -> None:
    """Write the video to ``folder/images``, held-out views to ``folder/others``, and true poses.

    Poses, times, images and masks read back exactly; ``stage=capture`` takes ``images`` alone.
    """
    assert isinstance(scene.space, NormalizedDevice)
    bounds = {"space": "ndc", "near": scene.space.near}
    images = {"images/{:03d}.png": scene.dynamic.train, "others/{:03d}.png": scene.dynamic.test}
    with whole_folder(folder) as partial:
        named = {pattern: [*views.singles()] for pattern, views in images.items()}
        write_nerfstudio(named, partial, scene_bounds=bounds)


def write_nerfstudio(
    images: Mapping[str, Sequence[Views]], folder: Path, **further: object
) -> list[str]:
    """Write ``folder/transforms.json`` and images, each of which is alone; return their names.

    Args:
        images: the training images, and then those held out, by the pattern of their names.
        folder: where masks of the pixels that count go to ``masks/``, too.
        further: keys of the file.
    """
    frames = list[dict[str, Any]]()
    names = [[pattern.format(k) for k in range(len(views))] for pattern, views in images.items()]
    for name, image in zip(chain(*names), chain(*images.values()), strict=True):
        write_image(folder / name, image.pixels[0])
        frames.append(listed(image, name))
        if image.valid_mask is not None:
            frames[-1]["mask_path"] = f"masks/{name}"
            write_image(folder / "masks" / name, image.valid_mask[0] * 255)
    lists = dict(zip(("train_filenames", "test_filenames"), names, strict=True))
    write_json(
        folder / "transforms.json",
        {"camera_model": "PINHOLE", **further, **lists, "frames": frames},
    )
    return [*chain(*names)]


def listed(image: Views, name: str) -> dict[str, Any]:
    """An image alone as a transforms file lists it: its time, pose and pinhole, in pixels."""
    cameras = image.cameras
    (fx, fy), (cx, cy) = cameras.focal[0].tolist(), cameras.center[0].tolist()
    return {
        "file_path": name,
        "time": float(image.times[0]),
        # A float32 becomes the float64 of the same value, which JSON keeps digit for digit.
        "transform_matrix": [*cameras.camera_to_world[0].tolist(), [0.0, 0.0, 0.0, 1.0]],
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": cameras.width, "h": cameras.height},
    }


def _export_blender(scene: Scene, folder: Path) -> None:
    """Write ``folder/static`` and ``folder/dynamic_<V>views``.

    Each holds ``transforms_{train,val,test}.json`` and images, RGBA where they have
    alpha masks; dynamic images are ordered time-major, and their flow, where there is one, goes to
    ``train_flow/<index>_bwd.npz``. Poses, times and images read back exactly.
    """
    dynamic = Capture(time_major(scene.dynamic.train), time_major(scene.dynamic.test))
    count = len(set(dynamic.train.view.tolist()))
    with whole_folder(folder) as partial:
        _write_capture(scene.static, partial / "static")
        _write_capture(dynamic, partial / f"dynamic_{count}views")


def _write_capture(capture: Capture, folder: Path) -> None:
    write_splits([*capture.train.singles()], [*capture.test.singles()], folder)
    if capture.train.flow is not None:
        # The first images of the views have no earlier one.
        later = (capture.train.times > 0).nonzero().flatten().tolist()
        write_flow(folder / "train_flow", capture.train, later)


def write_splits(train: Sequence[Views], test: Sequence[Views], folder: Path) -> None:
    """Write ``transforms_{train,val,test}.json`` and images, each of which is alone.

    The validation split, which nothing here uses, lists the held-out images again.
    """
    for images, split, *others in ((train, "train"), (test, "test", "val")):
        frames = [listed(image, f"./{split}/r_{k:03d}") for k, image in enumerate(images)]
        for frame, image in zip(frames, images, strict=True):
            write_image(folder / f"{frame['file_path']}.png", image.pixels[0])
        angle = 2 * math.atan(frames[0]["w"] / 2 / frames[0]["fl_x"])
        for name in (split, *others):
            content = {"camera_angle_x": angle, "frames": frames}
            write_json(folder / f"transforms_{name}.json", content)


# The published scenes are read at this factor, from folders images_4: larger images are not
# written.
FACTOR = 4
# Readers hold out every eighth static image, the first one included.
HOLDOUT = 8
# The largest depth if none is known, in multiples of the least one.
FAR = 100.0


def _export_llff(scene: Scene, folder: Path) -> None:
    """Write ``folder/static`` and ``folder/dynamic_<V>views``.

    ``static/poses_bounds.npy`` (N, 17) is for images four times as large as those in
    ``static/images_4``, as LLFF's is. The moving capture has V − 1 training views and,
    the last one, the held-out view; flow goes to ``view<k>/images_4_flow/<frame>_bwd.npz``.
    Least depths are written as 1/0.75, so a reader scales by one; a scene whose static cameras
    have the identity as their average pose reads back as it is.
    """
    held_out = np.arange(len(scene.static.train) + len(scene.static.test)) % HOLDOUT == 0
    views = [*_by_camera(scene.dynamic.train), *_by_camera(scene.dynamic.test)]
    _check_times(views)
    far = _farthest([scene.static.train, scene.static.test, *views])
    bounds = np.array([1 / BOUND_FACTOR, far])
    with whole_folder(folder) as partial:
        _write_static(scene.static, held_out, bounds, partial / "static")
        _write_moving(views, bounds, partial / f"dynamic_{len(views)}views")


def _by_camera(views: Views) -> list[Views]:
    """The views of each fixed camera, in order of time."""
    ordered = time_major(views)
    return [
        ordered[(ordered.view == camera).nonzero().flatten()]
        for camera in sorted(set(views.view.tolist()))
    ]


def _check_times(views: list[Views]) -> None:
    frames = len(views[-1])
    # The layout has no times: readers count frames.
    expected = torch.arange(frames) / (frames - 1)
    near = FrameClock.TOLERANCE
    for view in views:
        if len(view) != frames or bool(((view.times - expected).abs() > near).any()):
            raise scene_error(
                "prepare.into",
                "the layout has no times: each view needs the same frames, evenly spread; set "
                "data.novel_times_every=null",
            )


def _farthest(everyone: list[Views]) -> float:
    """The largest known distance from a camera, or a very large one."""
    depths = [views.depth[views.depth.isfinite()] for views in everyone if views.depth is not None]
    return max(float(depth.max()) for depth in depths) if depths else FAR / BOUND_FACTOR


def _intrinsics(views: Views, factor: int) -> Numbers:
    """[H, W, focal] (N, 3) of images larger by ``factor``."""
    sides = views.cameras.extents.flip(1).double().cpu().numpy()
    focal = views.cameras.focal[:, :1].double().cpu().numpy()
    return np.concatenate([sides, focal], axis=1) * factor


def _write_static(static: Capture, held_out: Tensor, bounds: Numbers, folder: Path) -> None:
    rows = np.empty((len(held_out), 17))
    for views, mask in ((static.train, ~held_out), (static.test, held_out)):
        # In double precision what was exact in single precision stays so.
        poses = views.cameras.camera_to_world.double().numpy()
        right, up, back, position = poses.transpose(2, 0, 1)
        matrix = np.stack([-up, right, back, position, _intrinsics(views, FACTOR)], axis=2)
        rows[mask] = np.hstack([matrix.reshape(-1, 15), np.tile(bounds, (len(views), 1))])
        _write_images(views, np.flatnonzero(mask), folder / f"images_{FACTOR}")
    np.save(folder / "poses_bounds.npy", rows)


def _write_moving(views: list[Views], bounds: Numbers, folder: Path) -> None:
    matrices = []
    for number, view in enumerate(views, start=1):
        images = folder / f"view{number}" / f"images_{FACTOR}"
        _write_images(view, range(len(view)), images)
        if view.flow is not None and number < len(views):
            flow_folder = images.with_name(f"{images.name}_flow")
            write_flow(flow_folder, view, range(1, len(view)))
        pose = view.cameras.camera_to_world[0].double().numpy()
        matrices.append(np.concatenate([pose, _intrinsics(view, 1)[:1].T], axis=1))
    np.save(folder / "poses.npy", np.stack(matrices))
    np.save(folder / "bds.npy", np.tile(bounds, (len(views), 1)))


def _write_images(views: Views, numbers: Iterable[int], folder: Path) -> None:
    for image, k in zip(views.singles(), numbers, strict=True):
        write_image(folder / f"{k:03d}.png", image.pixels[0])


def write_image(file: Path, pixels: Tensor) -> None:
    """Write pixels (H, W) or (H, W, 3 or 4) as PNG, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # In memory first: on a full disk a library that has the file open fails once more.
    image = iio.imwrite("<bytes>", pixels.to(torch.uint8).cpu().numpy(), extension=".png")
    file.write_bytes(image)
