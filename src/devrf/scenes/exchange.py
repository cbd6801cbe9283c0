"""A scene written for other programs: every image in one list, with its camera and its time.

The images are those that devrf learns from and scores: of pinhole cameras, at their size. Training
images are those of the static capture, at time 0, and those in motion; held out are those in motion
(of a scene at rest: its own). These are numbered in their order, in which
:mod:`devrf.evaluation.predictions` takes pictures of them. Positions are those of the capture's
world.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import torch

from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.poses import to_opencv
from devrf.scenes.export import (
    FAR,
    in_capture_world,
    whole_folder,
    write_image,
    write_nerfstudio,
    write_splits,
)
from devrf.scenes.scene import Scene, Views
from devrf.system.files import write_json, write_text

log = logging.getLogger(__name__)

Exchange = Literal["dnerf", "nerfies", "colmap"]
# Where times are counted, time 1 is the least number, up to MOST_STEPS, that makes whole ones of
# all times; of more frames they are rounded.
MOST_FRAMES = 1000
MOST_STEPS = 10_000
NAMES = ("train_{:05d}", "test_{:05d}")


@dataclass(frozen=True)
class PrepareSettings:
    """Settings of ``stage=prepare``; ``conf/prepare/default.yaml`` says what each does."""

    into: str | Path | None = None
    layout: Literal["devrf", Exchange] = "devrf"


def write_for_others(scene: Scene, folder: Path, layout: Exchange) -> None:
    """Write a ``scene`` in the layout of D-NeRF, Nerfies, or COLMAP with times.

    A line of the log says what the layout has no place for. DevrfError if ``folder`` is in use or
    cannot be written.
    """
    scene = in_capture_world(scene)
    moving, static, shared = scene.dynamic, scene.static.train, {*scene.dynamic.train.names}
    only_static = [k for k, name in enumerate(static.names) if name not in shared]
    train = [*map(static.single, only_static), *moving.train.singles()]
    test = [*moving.test.singles()]
    if layout != "colmap" and any(image.valid_mask is not None for image in train):
        log.warning("%s has no place for masks: all pixels of training images count there", layout)
    with whole_folder(folder) as partial:
        if layout == "dnerf":
            _warn_of_lenses([*train, *test])
            write_splits(train, test, partial)
        elif layout == "nerfies":
            _write_nerfies(scene, train, test, partial)
        else:
            patterns = [f"images/{name}.png" for name in NAMES]
            images = dict(zip(patterns, (train, test), strict=True))
            names = write_nerfstudio(images, partial)
            _write_sparse(dict(zip(names, [*train, *test], strict=True)), partial / "sparse" / "0")


def _warn_of_lenses(images: Sequence[Views]) -> None:
    """Say if cameras are not what D-NeRF's one angle says of all of them."""
    cameras = [image.cameras for image in images]
    focal = float(cameras[0].focal[0, 0])
    pinhole = [focal, focal, cameras[0].width, cameras[0].height]
    if any(torch.cat([c.focal[0], 2 * c.center[0]]).tolist() != pinhole for c in cameras):
        log.warning(
            "cameras differ, or are not centred, or pixels not square: a program that reads "
            "camera_angle_x, but not fl_x, fl_y, cx and cy of each frame, takes others"
        )


def _write_nerfies(
    scene: Scene, train: Sequence[Views], test: Sequence[Views], folder: Path
) -> None:
    """Write Nerfies' and HyperNeRF's files, and DyCheck's lists and masks beside them."""
    times = {float(image.times[0]) for image in [*train, *test]}
    denominators = [Fraction(time).limit_denominator(MOST_FRAMES).denominator for time in times]
    steps = min(math.lcm(*denominators), MOST_STEPS)
    metadata: dict[str, dict[str, int]] = {}
    splits: list[list[str]] = []
    for held_out, images in enumerate((train, test)):
        splits.append([NAMES[held_out].format(k) for k in range(len(images))])
        for item, image in zip(splits[-1], images, strict=True):
            write_image(folder / "rgb" / "1x" / f"{item}.png", image.pixels[0])
            write_json(folder / "camera" / f"{item}.json", _camera(image))
            if held_out and image.valid_mask is not None:
                mask = folder / "covisible" / "1x" / "val" / f"{item}.png"
                write_image(mask, image.valid_mask[0] * 255)
            time = round(float(image.times[0]) * steps)
            ids = dict.fromkeys(("time_id", "warp_id", "appearance_id"), time)
            metadata[item] = ids | {"camera_id": held_out}
    for name, items in zip(("train", "val"), splits, strict=True):
        lists = {
            f"{key}s": [metadata[item][key] for item in items] for key in ("camera_id", "time_id")
        }
        write_json(folder / "splits" / f"{name}.json", {"frame_names": items, **lists})
    ids_of = {"train_ids": splits[0], "val_ids": splits[1], "ids": [*metadata]}
    write_json(
        folder / "dataset.json", {"count": len(metadata), "num_exemplars": len(train), **ids_of}
    )
    write_json(folder / "metadata.json", metadata)
    space, bounds = scene.space, scene.bounds
    near, far = (
        (space.near, math.inf) if isinstance(space, NormalizedDevice) else (bounds.near, bounds.far)
    )
    far = far if math.isfinite(far) else FAR * near
    world = {"center": scene.offset, "scale": 1.0, "near": near or far / FAR, "far": far}
    write_json(folder / "scene.json", world)


def _camera(image: Views) -> dict[str, Any]:
    """The content of a camera file of Nerfies."""
    pose = image.cameras.camera_to_world[0].double()
    fx, fy = image.cameras.focal[0].tolist()
    return {
        "orientation": to_opencv(pose)[:, :3].tolist(),
        "position": pose[:, 3].tolist(),
        "focal_length": fx,
        "pixel_aspect_ratio": fy / fx,
        "skew": 0.0,
        "principal_point": image.cameras.center[0].tolist(),
        "image_size": [image.width, image.height],
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
    }


def _write_sparse(images: Mapping[str, Views], folder: Path) -> None:
    """Write COLMAP's model of known cameras as text, without points: COLMAP triangulates them."""
    # Slow to import.
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    cameras: dict[str, int] = {}
    lines: list[str] = []
    for number, (name, image) in enumerate(images.items(), start=1):
        lens = [*image.cameras.focal[0].tolist(), *image.cameras.center[0].tolist()]
        pinhole = " ".join(map(str, ("PINHOLE", image.width, image.height, *lens)))
        camera = cameras.setdefault(pinhole, len(cameras) + 1)
        to_camera = to_opencv(image.cameras.camera_to_world[0].double())
        turn = rotation_matrix_to_quaternion(to_camera[:, :3].contiguous()).tolist()
        place = [*turn, *to_camera[:, 3].tolist()]
        # The line below is of the points that the image shows.
        file = Path(name).name
        lines += [" ".join(map(str, (number, *place, camera, file))), ""]
    numbered = [f"{number} {pinhole}" for pinhole, number in cameras.items()]
    for part, content in (("cameras", numbered), ("images", lines), ("points3D", [])):
        write_text(folder / f"{part}.txt", "".join(f"{line}\n" for line in content))
