"""The whole way from footage: film an embedded scene, capture it, learn it, and compare.

The forward-facing scene is filmed into one static video and four fixed ones, with compression.
From these files alone ``stage=capture`` finds the cameras, which are compared with the true ones.
Then the captured scene is learned, and the same images with the true cameras are, too.
"""

from __future__ import annotations

import harness  # isort: skip: how threads wait is set before torch is loaded

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from devrf.artifacts.video_file import write_pictures
from devrf.capture.pipeline import scene_from_footage
from devrf.capture.settings import CaptureSettings
from devrf.cli.steps import run_stage
from devrf.scenes.procedural.forward import ProceduralForwardScene
from devrf.scenes.scene import Scene, Views
from devrf.system.files import write_json

RATE = 10
# Frames that a camera has filmed of the rest state before the motion begins.
EARLY = (3, 1, 0, 2)
# What is learned: half of the images' size, for some hundred iterations.
LEARNED = (
    *("experiment=quickstart_forward", "data=nerfstudio", "data.downscale=2", "trainer=cpu"),
    *("schedule.canonical.iterations=300", "schedule.canonical.doublings=[60,120]"),
    *("schedule.deformation.sides=[8,16]", "schedule.deformation.iterations_per_frame=[16,10]"),
)


def filmed(folder: Path) -> tuple[Scene, CaptureSettings]:
    """The scene, rendered or found, and videos of it below ``folder``."""
    kept = folder / "scene.pt"
    if kept.is_file():
        scene: Scene = torch.load(kept, weights_only=False)
    else:
        scene = ProceduralForwardScene(
            width=240, height=136, static_views=21, train_views=3, frames=10, texture="fine"
        )()
        torch.save(scene, kept)
    static = folder / "static.mp4"
    write_pictures(static, iter(_shaken(still_pixels(scene))), RATE)
    paths = []
    for number, (early, pixels) in enumerate(zip(EARLY, fixed_pixels(scene), strict=True), 1):
        paths.append(folder / f"view{number}.mp4")
        write_pictures(paths[-1], iter([pixels[0]] * early + [*pixels, pixels[-1]]), RATE)
    views = tuple(map(str, paths))
    return scene, CaptureSettings(
        static=str(static), views=views, into=str(folder / "captured"), frames=24
    )


def still_pixels(scene: Scene) -> np.ndarray:
    """(N, H, W, 3): the static images, in the order in which they are filmed."""
    return torch.cat([scene.static.train.pixels, scene.static.test.pixels]).numpy()


def fixed_pixels(scene: Scene) -> list[np.ndarray]:
    """Of each fixed camera its images, the held-out one last."""
    train, test = scene.dynamic.train, scene.dynamic.test
    count = int(train.view.max()) + 1
    return [train.pixels[train.view == v].numpy() for v in range(count)] + [test.pixels.numpy()]


def _shaken(pictures: np.ndarray) -> list[np.ndarray]:
    """Each picture between two that are blurred, as a hand-held camera would give."""
    return [
        frame
        for picture in pictures
        for frame in (cv2.blur(picture, (5, 5)), picture, cv2.blur(picture, (4, 4)))
    ]


def true_poses(scene: Scene, frames: list[dict[str, Any]]) -> Tensor:
    """(N, 3, 4) float64: the true camera of each frame of a transforms file."""
    sets: list[Views] = [scene.static.train, scene.static.test]
    still = torch.cat([views.cameras.camera_to_world for views in sets]).double()
    last = scene.dynamic.test.cameras.camera_to_world[:1]
    count = len(EARLY) - 1
    fixed = torch.cat([scene.dynamic.train.cameras.camera_to_world[:count], last]).double()
    poses = []
    for frame in frames:
        _, label, file = str(frame["file_path"]).split("/")
        if label == "static":
            poses.append(still[int(Path(file).stem) // 3])
        else:
            poses.append(fixed[int(label.removeprefix("view")) - 1])
    return torch.stack(poses)


@dataclass(frozen=True)
class Similarity:
    """From the captured world to the true one: x → scale · turn x + shift (float64).

    Attributes:
        turn: (3, 3) rotation.
        scale: true units for one of the captured world.
        shift: (3,) true units.
    """

    turn: Tensor
    scale: Tensor
    shift: Tensor

    @staticmethod
    def between(found: Tensor, true: Tensor) -> Similarity:
        """The best one: its rotation is that of the cameras' axes, the rest of their centres."""
        u, _, v = torch.linalg.svd((true[:, :, :3] @ found[:, :, :3].mT).sum(dim=0))
        turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))]).double()) @ v
        a, b = found[:, :, 3] @ turn.mT, true[:, :, 3]
        centred = a - a.mean(dim=0)
        scale = (centred * (b - b.mean(dim=0))).sum() / centred.square().sum()
        return Similarity(turn, scale, b.mean(dim=0) - scale * a.mean(dim=0))

    def to_true(self, poses: Tensor) -> Tensor:
        """Poses (N, 3, 4) of the captured world in the true one."""
        centres = self.scale * poses[:, :, 3:] + (self.turn.mT @ self.shift)[:, None]
        return self.turn @ torch.cat([poses[:, :, :3], centres], dim=2)

    def to_captured(self, poses: Tensor) -> Tensor:
        """Poses (N, 3, 4) of the true world in the captured one: the inverse."""
        centres = (poses[:, :, 3:] - self.shift[:, None]) / self.scale
        return self.turn.mT @ torch.cat([poses[:, :, :3], centres], dim=2)


def compared(found: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Degrees and true units by which cameras are off, after the best similarity."""
    there = Similarity.between(found, true).to_true(found)
    off = true[:, :, :3].mT @ there[:, :, :3]
    trace = off.diagonal(dim1=1, dim2=2).sum(dim=1)
    angle = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())
    return angle, (there[:, :, 3] - true[:, :, 3]).norm(dim=1)


def with_true_cameras(captured: Path, into: Path, scene: Scene) -> None:
    """The captured scene's images and bounds with the true cameras, as another scene.

    The cameras are brought into the captured world, so that both scenes fill the same grids.
    """
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir()
    (into / "images").symlink_to((captured / "images").resolve())
    listing = json.loads((captured / "transforms.json").read_text())
    camera = scene.static.train.cameras
    fx, fy, cx, cy = (*camera.focal[0].tolist(), *camera.center[0].tolist())
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": 0.0}
    frames = listing["frames"]
    true, found = true_poses(scene, frames), poses_of(frames)
    own = Similarity.between(found, true).to_captured(true)
    for frame, pose in zip(frames, own.tolist(), strict=True):
        frame.update(lens, transform_matrix=[*pose, [0.0, 0.0, 0.0, 1.0]])
    write_json(into / "transforms.json", listing)


def poses_of(frames: list[dict[str, Any]]) -> Tensor:
    """(N, 3, 4) float64: the camera of each frame of a transforms file."""
    return torch.tensor([frame["transform_matrix"][:3] for frame in frames]).double()


def learned(root: Path, run: Path) -> tuple[float, float]:
    """PSNR on the held-out fixed view, and seconds."""
    began = time.perf_counter()
    opened = harness.open_run(
        [*LEARNED, f"data.root={root}", f"hydra.run.dir={run}", "resume=false"]
    )
    run.mkdir(parents=True, exist_ok=True)
    for stage in (*opened.learning_stages, "evaluate"):
        config = opened.config.copy()
        config.stage = stage
        run_stage(config, run)
    metrics = json.loads((run / "metrics.json").read_text())
    return float(metrics["dynamic"]["psnr"]), time.perf_counter() - began


def main() -> None:
    """Film, capture, compare cameras; learn both, compare scores."""
    arguments = harness.parser(__doc__, overrides=False)
    arguments.add_argument("--folder", type=Path, default=Path("outputs/benchmarks/capture"))
    arguments.add_argument("--cameras", action="store_true", help="do not learn the scene")
    given = arguments.parse_args()
    folder: Path = given.folder
    folder.mkdir(parents=True, exist_ok=True)
    scene, settings = filmed(folder)
    shutil.rmtree(folder / "captured", ignore_errors=True)
    began = time.perf_counter()
    captured = scene_from_footage(settings)
    row = {"capture s": time.perf_counter() - began}
    frames = json.loads((captured / "transforms.json").read_text())["frames"]
    angle, distance = compared(poses_of(frames), true_poses(scene, frames))
    # As the scene's size counts the median distance of what the cameras see.
    middle = float(scene.static.train.depth.median())  # type: ignore[union-attr]
    row |= {
        "rotation max deg": float(angle.max()),
        "centre max %": 100 * float(distance.max()) / middle,
    }
    if not given.cameras:
        row["PSNR"], row["learn s"] = learned(captured, folder / "run-captured")
        with_true_cameras(captured, folder / "true", scene)
        row["PSNR true cameras"], _ = learned(folder / "true", folder / "run-true")
    harness.report([row], given.json or folder / "capture.json", torch.device("cpu"))


if __name__ == "__main__":
    main()
