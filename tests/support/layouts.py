"""Scenes as other programs leave them on disk: a writer for each layout."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from devrf.geometry.cameras import Cameras
from devrf.pictures.video_file import write_pictures
from devrf.scenes.lens import Lens
from devrf.scenes.scene import Scene, Views
from devrf.scenes.sparse_model import SparseModel


def write_sparse(
    folder: Path,
    cameras: Cameras,
    names: Sequence[str],
    points: torch.Tensor,
    model: str = "PINHOLE",
    parameters: Sequence[float] | None = None,
) -> None:
    """Write a sparse model as COLMAP's text files: one lens, all points in all images.

    ``parameters`` are those of ``model``; None: a pinhole with the first camera's numbers.
    """
    folder.mkdir(parents=True)
    given = parameters or [*cameras.focal[0].tolist(), *cameras.center[0].tolist()]
    numbers = " ".join(map(repr, given))
    (folder / "cameras.txt").write_text(f"1 {model} {cameras.width} {cameras.height} {numbers}\n")
    lines = []
    for k, pose in enumerate(cameras.camera_to_world.double()):
        turn = Rotation.from_matrix((pose[:, :3] * pose.new_tensor([1, -1, -1])).T.numpy())
        x, y, z, w = turn.as_quat().tolist()
        moved = (-turn.as_matrix() @ pose[:, 3].numpy()).tolist()
        lines.append(" ".join(map(repr, (k + 1, w, x, y, z, *moved, 1))) + f" {names[k]}")
        lines.append(" ".join(f"0.5 0.5 {number}" for number in range(len(points))))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{n} {x!r} {y!r} {z!r} 9 9 9 0.5" for n, (x, y, z) in enumerate(points.tolist())]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def points_in(poses: torch.Tensor, model: SparseModel) -> torch.Tensor:
    """The points of a model in the world of its normalised ``poses``."""
    before = model.poses
    turn = poses[0, :, :3] @ before[0, :, :3].T
    apart = [(each[1] - each[0])[:, 3].norm() for each in (poses, before)]
    local = (torch.from_numpy(model.points) - before[0, :, 3]) @ turn.T
    return local * apart[0] / apart[1] + poses[0, :, 3]


def write_rig(
    root: Path, films: Mapping[str, Iterable[np.ndarray]], cameras: Cameras, near: float, far: float
) -> None:
    """Write a video for each of the fixed cameras, and ``poses_bounds.npy``, as Neural 3D Video.

    A row of it is [down, right, back, position, (H, W, f)] as 3 × 5, then two depths.
    """
    root.mkdir(parents=True)
    for name, pictures in films.items():
        write_pictures(root / name, iter(pictures), 10)
    right, up, back, position = cameras.camera_to_world.double().unbind(dim=2)
    size = [cameras.height, cameras.width, float(cameras.focal[0, 0])]
    column = torch.tensor(size, dtype=torch.float64).expand(len(cameras), 3)
    rows = torch.stack([-up, right, back, position, column], dim=2).reshape(-1, 15)
    depths = torch.tensor([[near, far]], dtype=torch.float64).expand(len(cameras), 2)
    np.save(root / "poses_bounds.npy", torch.cat([rows, depths], dim=1).numpy())


def put_json(file: Path, content: Any) -> None:
    """Write a JSON file, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def write_camera(
    root: Path, size: str, item: str, pixels: np.ndarray, pose: torch.Tensor, lens: Lens
) -> None:
    """An image and its camera file as Nerfies has them; the lens is that of the full image."""
    (root / "rgb" / size).mkdir(parents=True, exist_ok=True)
    iio.imwrite(root / f"rgb/{size}/{item}.png", pixels)
    factor, (fx, fy) = int(size[0]), lens.focal
    camera = {
        "orientation": (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])).T.tolist(),
        "position": pose[:, 3].tolist(),
        "focal_length": fx,
        "pixel_aspect_ratio": fy / fx,
        "skew": lens.skew,
        "principal_point": lens.center,
        "image_size": [pixels.shape[1] * factor, pixels.shape[0] * factor],
        "radial_distortion": lens.distortion.radial[:3],
        "tangential_distortion": lens.distortion.tangential,
    }
    put_json(root / f"camera/{item}.json", camera)


def in_one_list(scene: Scene) -> dict[str, tuple[Views, int]]:
    """Every image of an inward-facing scene by a name, held-out ones last."""
    parts = {
        "static": scene.static.train,
        "moving": scene.dynamic.train,
        "test_static": scene.static.test,
        "test_moving": scene.dynamic.test,
    }
    return {f"{name}_{i}": (views, i) for name, views in parts.items() for i in range(len(views))}


def write_nerfstudio(scene: Scene, root: Path) -> None:
    """The scene as nerfstudio lists it: all images in one file, at rest at time 0."""
    root.mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for name, (views, i) in in_one_list(scene).items():
        view = views.single(i)
        iio.imwrite(root / f"{name}.png", view.pixels[0].numpy())
        pose = [*view.cameras.camera_to_world[0].tolist(), [0, 0, 0, 1]]
        (fx, fy), (cx, cy) = view.cameras.focal[0].tolist(), view.cameras.center[0].tolist()
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": view.width, "h": view.height}
        placed = {"time": float(view.times[0]), "transform_matrix": pose}
        frames.append({"file_path": f"{name}.png", **placed, **lens})
    names = [frame["file_path"] for frame in frames]
    listed = {"frames": frames, "test_filenames": [n for n in names if n.startswith("test")]}
    put_json(root / "transforms.json", listed)


def write_nerfies(scene: Scene, root: Path, size: str = "4x") -> None:
    """The scene as Nerfies lists it, its images already made smaller."""
    images, factor = in_one_list(scene), int(size[0])
    for name, (views, i) in images.items():
        focal, center = views.cameras.focal[i] * factor, views.cameras.center[i] * factor
        lens = Lens(tuple(focal.tolist()), tuple(center.tolist()))
        pose = views.cameras.camera_to_world[i]
        write_camera(root, size, name, views.pixels[i].numpy(), pose, lens)
    ids = list(images)
    held_out = [name for name in ids if name.startswith("test")]
    times = {name: {"warp_id": round(2 * float(v.times[i]))} for name, (v, i) in images.items()}
    train = [name for name in ids if name not in held_out]
    put_json(root / "dataset.json", {"ids": ids, "train_ids": train, "val_ids": held_out})
    put_json(root / "metadata.json", times)
    world = {"center": [0, 0, 0], "scale": 1, "near": scene.bounds.near, "far": scene.bounds.far}
    put_json(root / "scene.json", world)


def write_nerf_ds(scene: Scene, root: Path) -> None:
    """The dynamic images as NeRF-DS has them: Nerfies' files, masks and cameras of each split."""
    write_nerfies(scene, root, "1x")
    ids = json.loads((root / "dataset.json").read_text())
    ids["ids"] = [item for item in ids["ids"] if "static" not in item]
    ids["train_ids"] = [item for item in ids["train_ids"] if "static" not in item]
    ids["val_ids"] = [item for item in ids["val_ids"] if "static" not in item]
    put_json(root / "dataset.json", ids)
    for split, folder in (("train_ids", "train_camera"), ("val_ids", "vrig_camera")):
        for item in ids[split]:
            put_json(root / folder / f"{item}.json", {})
    (root / "resized_mask").mkdir()
    for item in ids["train_ids"]:  # the foreground is 0
        mask = 255 - iio.imread(root / f"rgb/1x/{item}.png")[..., 3]
        iio.imwrite(root / f"resized_mask/{item}.png", mask)
    np.save(root / "points.npy", np.zeros((5, 3)))


def write_dycheck(scene: Scene, root: Path) -> None:
    """The scene as DyCheck lists it: the dynamic images alone, made smaller by two."""
    write_nerfies(scene, root, "2x")
    times = json.loads((root / "metadata.json").read_text())
    for split, part in (("train", "moving"), ("val", "test_moving")):
        names = [name for name in times if name.startswith(part)]
        ids = [times[name]["warp_id"] for name in names]
        put_json(root / f"splits/{split}.json", {"frame_names": names, "time_ids": ids})


def opencv_matrices(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera (N, 4, 4) and intrinsics (N, 3, 3), float64, as OpenCV has them."""
    to_camera = np.tile(np.eye(4), (len(cameras), 1, 1))
    k = np.tile(np.eye(3), (len(cameras), 1, 1))
    for row, pose in enumerate(cameras.camera_to_world.double().numpy()):
        turn = (pose[:, :3] * [1, -1, -1]).T
        to_camera[row, :3] = np.column_stack([turn, -turn @ pose[:, 3]])
    k[:, [0, 1], [0, 1]] = cameras.focal.numpy()
    k[:, :2, 2] = cameras.center.numpy()
    return to_camera, k


def write_panoptic(scene: Scene, root: Path) -> None:
    """The dynamic images as Dynamic 3D Gaussians lists them: time by time, masks in ``seg/``."""
    for split, views in (("train", scene.dynamic.train), ("test", scene.dynamic.test)):
        to_camera, k = opencv_matrices(views.cameras)
        moments = views.times.unique().tolist()
        taken = [(views.times == time).nonzero()[:, 0].tolist() for time in moments]
        names = [f"{split}{int(views.view[i])}/{i:06d}.png" for i in range(len(views))]
        for name, pixels in zip(names, views.pixels.numpy(), strict=True):
            for part, image in (("ims", pixels), ("seg", pixels[..., -1])):
                (root / part / name).parent.mkdir(parents=True, exist_ok=True)
                iio.imwrite(root / part / name, image)
        listed = {
            "w": views.width,
            "h": views.height,
            "fn": [[names[i] for i in rows] for rows in taken],
            "k": [[k[i].tolist() for i in rows] for rows in taken],
            "w2c": [[to_camera[i].tolist() for i in rows] for rows in taken],
            "cam_id": [[int(views.view[i]) for i in rows] for rows in taken],
        }
        put_json(root / f"{split}_meta.json", listed)


def write_easyvolcap(scene: Scene, root: Path) -> None:
    """The dynamic images as EasyVolcap has them, by camera; the held-out one is the last."""
    root.mkdir(parents=True)
    intrinsics = cv2.FileStorage(str(root / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extrinsics = cv2.FileStorage(str(root / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    views = [
        capture[capture.view == number]
        for capture in (scene.dynamic.train, scene.dynamic.test)
        for number in capture.view.unique().tolist()
    ]
    names = [f"{camera:02d}" for camera in range(len(views))]
    for file in (intrinsics, extrinsics):
        file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            file.write("", name)
        file.endWriteStruct()
    for name, of_camera in zip(names, views, strict=True):
        to_camera, k = opencv_matrices(of_camera.cameras[:1])
        intrinsics.write(f"K_{name}", k[0])
        intrinsics.write(f"W_{name}", of_camera.width)
        intrinsics.write(f"H_{name}", float(of_camera.height))
        intrinsics.write(f"D_{name}", np.zeros((5, 1)))
        extrinsics.write(f"R_{name}", cv2.Rodrigues(to_camera[0, :3, :3])[0])
        extrinsics.write(f"Rot_{name}", to_camera[0, :3, :3])
        extrinsics.write(f"T_{name}", to_camera[0, :3, 3:])
        for part in ("images", "masks"):
            (root / part / name).mkdir(parents=True)
        for frame, pixels in enumerate(of_camera.pixels.numpy()):
            iio.imwrite(root / "images" / name / f"{frame:06d}.png", pixels)
            iio.imwrite(root / "masks" / name / f"{frame:06d}.png", pixels[..., -1])
    intrinsics.release()
    extrinsics.release()


def write_scene(choice: str, scene: Scene, root: Path) -> None:
    """Write an inward-facing scene as ``data=CHOICE`` reads it."""
    writers = {"nerfstudio": write_nerfstudio, "nerfies": write_nerfies, "dycheck": write_dycheck}
    writers |= {"panoptic": write_panoptic, "easyvolcap": write_easyvolcap}
    writers[choice](scene, root)
