"""Small captures on disk as strangers have them, each written from its format's description."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.procedural.recipe import ProceduralForwardScene
from devrf.scenes.scene import Scene, Views

Writer = Callable[[Path], None]


@pytest.fixture(scope="session")
def inward() -> Scene:
    """The robot in 24 × 20 pixels: 16 static views of a ring, two moving views of 4 frames."""
    sizes = {"width": 24, "height": 20, "static_views": 16, "static_test_views": 3}
    return ProceduralScene(shape="robot", train_views=2, frames=4, supersample=1, **sizes)()


@pytest.fixture(scope="session")
def forward() -> Scene:
    """The plush toy in 40 × 32 pixels, seen from one side."""
    return ProceduralForwardScene(
        width=40, height=32, static_views=14, train_views=2, frames=9, supersample=1
    )()


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2))


def photograph(views: Views, image: int) -> np.ndarray:
    """An image (H, W, 3) before a wall of changing colour, as a camera takes it."""
    pixels = views.pixels[image].float() / 255
    y, x = np.mgrid[: views.height, : views.width] / views.width
    wall = torch.from_numpy(np.stack([0.3 + 0.4 * x, 0.5 + 0.2 * y, 0.6 - 0.3 * x], axis=-1))
    if views.has_alpha:
        pixels = wall + pixels[..., 3:] * (pixels[..., :3] - wall)
    return (255 * pixels.numpy()).round().astype(np.uint8)


def matrix(cameras: Cameras, image: int) -> list[list[float]]:
    """A pose as transforms files have it, 4 × 4."""
    return [*cameras.camera_to_world[image].tolist(), [0.0, 0.0, 0.0, 1.0]]


def write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, pixels)


def lego(scene: Scene) -> Writer:
    """NeRF-synthetic: RGBA images, one angle for all, no times."""

    def write(root: Path) -> None:
        train = scene.static.train
        order = torch.arange(len(train))
        parts = {"train": train[order[:12]], "val": train[order[12:]], "test": scene.static.test}
        for split, views in parts.items():
            angle = 2 * math.atan(views.width / 2 / float(views.cameras.focal[0, 0]))
            frames = []
            for k in range(len(views)):
                write_image(root / split / f"r_{k}.png", views.pixels[k].numpy())
                if split == "test":  # depth and normals lie beside the images
                    for other in ("depth_0001", "normal_0001"):
                        write_image(root / split / f"r_{k}_{other}.png", views.pixels[k].numpy())
                frames.append(
                    {
                        "file_path": f"./{split}/r_{k}",
                        "rotation": 0.012566370614359171,
                        "transform_matrix": matrix(views.cameras, k),
                    }
                )
            write_json(
                root / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames}
            )

    return write


def poses_bounds(cameras: Cameras, near: float, far: float) -> np.ndarray:
    """LLFF's rows (N, 17): 3 × 5 of [down, right, back, position, (H, W, f)], then two depths."""
    right, up, back, position = cameras.camera_to_world.double().unbind(dim=2)
    size = [cameras.height, cameras.width, float(cameras.focal[0, 0])]
    column = torch.tensor(size, dtype=torch.float64).expand(len(cameras), 3)
    rows = torch.stack([-up, right, back, position, column], dim=2).reshape(-1, 15)
    depths = torch.tensor([[near, far]], dtype=torch.float64).expand(len(cameras), 2)
    return torch.cat([rows, depths], dim=1).numpy()


def fern(scene: Scene) -> Writer:
    """LLFF: photographs, the same made smaller by four, the cameras in ``poses_bounds.npy``."""

    def write(root: Path) -> None:
        views = scene.static.train
        for k in range(len(views)):
            image = photograph(views, k)
            write_image(root / "images" / f"IMG_{4026 + k}.JPG", image)
            small = image.reshape(views.height // 4, 4, views.width // 4, 4, 3).mean(axis=(1, 3))
            write_image(root / "images_4" / f"image{k:03d}.png", small.astype(np.uint8))
        np.save(root / "poses_bounds.npy", poses_bounds(views.cameras, 1.5, 12.0))
        (root / "sparse/0").mkdir(parents=True)
        (root / "simplices.npy").write_bytes(b"")

    return write


def hand(scene: Scene) -> Writer:
    """NR-NeRF: one camera's video of what moves, in LLFF's layout."""

    def write(root: Path) -> None:
        views, count = scene.dynamic.train, 9
        static = scene.static.train.cameras
        # Frame k of the first fixed view stands for a picture of a camera that moves a little.
        at = (views.view == 0).nonzero()[:, 0][:count]
        for k, image in enumerate(at.tolist()):
            write_image(root / "images" / f"image{k + 1:06d}.png", photograph(views, image))
        cameras = static[torch.arange(count)]
        np.save(root / "poses_bounds.npy", poses_bounds(cameras, 1.5, 12.0))
        size = torch.tensor([cameras.height, cameras.width, float(cameras.focal[0, 0])])
        poses = torch.cat([cameras.camera_to_world, size[None, :, None].expand(count, 3, 1)], dim=2)
        content = {"poses": poses.tolist(), "bds": [[1.5, 12.0]] * count, "i_test": 4}
        write_json(root / "precomputed.json", content)

    return write


def fox(scene: Scene) -> Writer:
    """instant-ngp: one ``transforms.json`` of COLMAP's cameras, with the images' sharpness."""

    def write(root: Path) -> None:
        views = scene.static.train
        (fl_x, fl_y), (cx, cy) = views.cameras.focal[0].tolist(), views.cameras.center[0].tolist()
        frames = []
        for k in range(len(views)):
            name = f"images/{k + 1:04d}.jpg"
            write_image(root / name, photograph(views, k))
            pose = matrix(views.cameras, k)
            frames.append({"file_path": name, "sharpness": 300.0 + k, "transform_matrix": pose})
        content = {
            "camera_angle_x": 2 * math.atan(views.width / 2 / fl_x),
            "camera_angle_y": 2 * math.atan(views.height / 2 / fl_y),
            **{"fl_x": fl_x, "fl_y": fl_y, "k1": 0.01, "k2": -0.02, "p1": 0.001, "p2": -0.0005},
            **{"cx": cx, "cy": cy, "w": float(views.width), "h": float(views.height)},
            **{"aabb_scale": 4, "frames": frames},
        }
        write_json(root / "transforms.json", content)

    return write


def turned(pose: list[list[float]]) -> list[list[float]]:
    """The pose of a camera held upright whose image was turned by a quarter."""
    rows = torch.tensor(pose)
    quarter = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return (rows @ quarter).tolist()


def phone(scene: Scene) -> Writer:
    """nerfstudio, from an app on a telephone: portrait, each frame with a lens of its own."""

    def write(root: Path) -> None:
        views, frames = scene.static.train, []
        for k in range(len(views)):
            name = f"images/frame_{k + 1:05d}.png"
            write_image(root / name, np.rot90(photograph(views, k)))
            focal = float(views.cameras.focal[k, 0]) * (1 + 0.002 * (k % 3))
            lens = {"fl_x": focal, "fl_y": focal, "cx": views.height / 2, "cy": views.width / 2}
            size = {"w": views.height, "h": views.width}
            pose = turned(matrix(views.cameras, k))
            frames.append({"file_path": name, "transform_matrix": pose, **lens, **size})
        content = {
            "camera_model": "OPENCV",
            "applied_transform": [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]],
            "orientation_override": "none",
            "auto_scale_poses_override": False,
            "ply_file_path": "sparse_pc.ply",
            "frames": frames[::-1],
        }
        write_json(root / "transforms.json", content)

    return write


def windmill(scene: Scene) -> Writer:
    """DyCheck: Nerfies' files; camera 0 moves and is learned from, one that stands is held out."""

    def write(root: Path) -> None:
        # The moving camera stands where one fixed view does, then where the next one does.
        train, test = scene.dynamic.train, scene.dynamic.test
        numbers = {"train": train.frames % 2 == train.view, "val": test.view == 0}
        splits: dict[str, list[tuple[str, int, int]]] = {"train": [], "val": []}
        metadata = {}
        for split, camera, views in (("train", 0, train), ("val", 1, test)):
            for k in numbers[split].nonzero()[:, 0].tolist():
                time = int(views.frames[k])
                item = f"{camera}_{time:05d}"
                write_image(root / "rgb/1x" / f"{item}.png", photograph(views, k))
                write_json(root / "camera" / f"{item}.json", nerfies_camera(views.cameras, k))
                splits[split].append((item, camera, time))
                metadata[item] = {"warp_id": time, "appearance_id": time, "camera_id": camera}
        ids = {split: [item for item, _, _ in rows] for split, rows in splits.items()}
        for split, rows in splits.items():
            names, cameras, times = zip(*rows, strict=True)
            content = {"frame_names": names, "camera_ids": cameras, "time_ids": times}
            write_json(root / "splits" / f"{split}.json", content)
        everything = ids["train"] + ids["val"]
        counts = {"count": len(everything), "num_exemplars": len(ids["train"])}
        lists = {"ids": everything, "train_ids": ids["train"], "val_ids": ids["val"]}
        write_json(root / "dataset.json", {**counts, **lists})
        write_json(root / "metadata.json", metadata)
        bounds = {"near": scene.bounds.near, "far": scene.bounds.far}
        write_json(root / "scene.json", {"scale": 1.0, "center": [0.0, 0.0, 0.0], **bounds})
        extra = {"bbox": [[-1, -1, -1], [1, 1, 1]], "factor": 1, "fps": 60}
        covisible = np.full((test.height, test.width), 255, dtype=np.uint8)
        covisible[:, :3] = 0
        for item in ids["val"]:
            write_image(root / "covisible/1x/val" / f"{item}.png", covisible)
        write_json(root / "extra.json", {**extra, "lookat": [0, 0, 0], "up": [0, 0, 1]})

    return write


def nerfies_camera(cameras: Cameras, image: int) -> dict[str, Any]:
    """A camera as Nerfies writes it: world-to-camera axes, x right, y down, z forward."""
    pose: Tensor = cameras.camera_to_world[image]
    focal = cameras.focal[image]
    return {
        "orientation": (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])).T.tolist(),
        "position": pose[:, 3].tolist(),
        "focal_length": float(focal[0]),
        "principal_point": cameras.center[image].tolist(),
        "skew": 0.0,
        "pixel_aspect_ratio": float(focal[1] / focal[0]),
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [cameras.width, cameras.height],
    }


def garden(scene: Scene, write_sparse: Callable[..., None]) -> Writer:
    """COLMAP: photographs at full size and smaller by two, cameras and points in ``sparse/0``."""

    def write(root: Path) -> None:
        views = scene.static.train
        names = [f"DSC{k + 7956:05d}.JPG" for k in range(len(views))]
        for k, name in enumerate(names):
            image = photograph(views, k)
            write_image(root / "images" / name, image)
            small = image.reshape(views.height // 2, 2, views.width // 2, 2, 3).mean(axis=(1, 3))
            write_image(root / "images_2" / name, small.astype(np.uint8))
        points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        write_sparse(root / "sparse/0", views.cameras, names, points)
        np.save(root / "poses_bounds.npy", poses_bounds(views.cameras, 1.5, 12.0))

    return write


def salmon(scene: Scene, write_rig: Callable[..., None]) -> Writer:
    """Neural 3D Video: the held-out view is ``cam00.mp4``; ``cam01.mp4`` is left out."""

    def write(root: Path) -> None:
        films, poses = {}, []
        train, test = scene.dynamic.train, scene.dynamic.test
        for name, views, view in (("00", test, 0), ("02", train, 0), ("03", train, 1)):
            shots = (views.view == view).nonzero()[:, 0].tolist()
            films[f"cam{name}.mp4"] = [photograph(views, k) for k in shots]
            poses.append(views.cameras.camera_to_world[shots[0]])
        cameras = replace(train.cameras[[0, 0, 0]], camera_to_world=torch.stack(poses))
        write_rig(root, films, cameras, 1.5, 12.0)

    return write


@pytest.fixture(scope="session")
def captures(
    inward: Scene,
    forward: Scene,
    write_sparse: Callable[..., None],
    write_rig: Callable[..., None],
) -> dict[str, Writer]:
    """A function that writes each capture into a folder, by its name."""
    return {
        **{"garden": garden(inward, write_sparse), "salmon": salmon(forward, write_rig)},
        **{"lego": lego(inward), "fern": fern(forward), "fox": fox(inward)},
        **{"phone": phone(inward), "hand": hand(forward), "windmill": windmill(inward)},
    }
