"""The whole way from footage: film an embedded scene, capture it, learn it, and compare.

A scene is filmed with compression, in one of three ways (``--scene``): ``forward``, a static
video and four fixed ones, all from one side; ``inward``, the same around a robot in a room;
``monocular``, one video by a camera that moves while the robot does. From these files alone
``stage=capture`` finds the cameras, which are compared with the true ones. Then the captured scene
is learned, and the same images with the true cameras are, too.

Pinholes film the scenes. So they are captured as such, unless ``--lens`` names another model: a
reader resamples images of a lens with distortion, which takes away some of their detail, and scores
on smoother images are higher.
"""

from __future__ import annotations

import harness  # isort: skip: how threads wait is set before torch is loaded

import json
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from filming import SCENES, Filmed
from torch import Tensor

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.system.files import write_json


def levels(*rows: tuple[int, int]) -> list[str]:
    """Overrides for levels of (side, iterations of a frame), the third left out."""
    values = [f"{{side:{side},iterations:{count}}}" for side, count in rows]
    return [f"schedule.deformation.levels.{k}={row}" for k, row in enumerate([*values, "null"], 1)]


# What is learned: half of the images' size, for some hundred iterations.
LEARNED = {
    "forward": (
        "experiment=quickstart",
        "schedule.canonical.upsample_at=[60,120]",
        "schedule.canonical.iterations=300",
        *levels((8, 16), (16, 10)),
    ),
    "inward": (
        "experiment=quickstart",
        "schedule.canonical.upsample_at=[50,100,150]",
        "schedule.canonical.iterations=300",
        *levels((8, 12), (12, 8)),
        "schedule.deformation.rays=768",
    ),
    "monocular": (
        "experiment=quickstart",
        "schedule.canonical.upsample_at=[40,80,120]",
        "schedule.canonical.iterations=250",
        "schedule.canonical.rays=1024",
        *levels((8, 6), (12, 3)),
        "schedule.deformation.rays=768",
    ),
}
ALL = ("data=nerfstudio", "data.downscale=2", "trainer=cpu")


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
    def between(estimated: Tensor, true: Tensor) -> Similarity:
        """The best one: its rotation is that of the cameras' axes, the rest of their centres."""
        u, _, v = torch.linalg.svd((true[:, :, :3] @ estimated[:, :, :3].mT).sum(dim=0))
        turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))]).double()) @ v
        a = estimated[:, :, 3] @ turn.mT
        b = true[:, :, 3]
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


def compared(estimated: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Degrees and true units by which cameras are off, after the best similarity."""
    aligned = Similarity.between(estimated, true).to_true(estimated)
    off = true[:, :, :3].mT @ aligned[:, :, :3]
    trace = off.diagonal(dim1=1, dim2=2).sum(dim=1)
    angle = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())
    return angle, (aligned[:, :, 3] - true[:, :, 3]).norm(dim=1)


def with_true_cameras(captured: Path, into: Path, film: Filmed) -> None:
    """The captured scene's images and bounds with the true cameras, as another scene.

    The cameras are brought into the captured world, so that both scenes fill the same grids.
    """
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir()
    (into / "images").symlink_to((captured / "images").resolve())
    listing = json.loads((captured / "transforms.json").read_text())
    fx, fy = film.moving.focal[0].tolist()
    cx, cy = film.moving.center[0].tolist()
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": 0.0}
    frames = listing["frames"]
    true = film.true_poses(frames)
    poses = Similarity.between(poses_of(frames), true).to_captured(true)
    for frame, pose in zip(frames, poses.tolist(), strict=True):
        frame.update(lens, transform_matrix=[*pose, [0.0, 0.0, 0.0, 1.0]])
    write_json(into / "transforms.json", listing)


def poses_of(frames: list[dict[str, Any]]) -> Tensor:
    """(N, 3, 4) float64: the camera of each frame of a transforms file."""
    return torch.tensor([frame["transform_matrix"][:3] for frame in frames]).double()


def learned(scene: str, root: Path, run: Path) -> dict[str, float]:
    """PSNR on held-out images, at rest and in motion, and seconds."""
    began = time.perf_counter()
    settings = [*LEARNED[scene], *ALL, f"data.root={root}", f"hydra.run.dir={run}", "resume=false"]
    opened = harness.open_run(settings)
    for stage in (*opened.learning_stages, "evaluate"):
        config = opened.config.copy()
        config.stage = stage
        harness.run_stage(config, run)
    metrics = json.loads((run / "metrics.json").read_text())
    return {
        "PSNR": metrics["dynamic"]["psnr"],
        "PSNR at rest": metrics["static"]["psnr"],
        "learn s": time.perf_counter() - began,
    }


def main() -> None:
    """Film, capture, compare cameras; learn both, compare scores."""
    arguments = harness.parser(__doc__, overrides=False)
    arguments.add_argument("--scene", choices=tuple(SCENES), default="forward")
    arguments.add_argument("--folder", type=Path, help="default: outputs/benchmarks/capture/SCENE")
    arguments.add_argument("--lens", default="SIMPLE_PINHOLE", help="as capture.camera")
    arguments.add_argument("--mattes", help="as capture.alpha_masks")
    arguments.add_argument("--cameras", action="store_true", help="do not learn the scene")
    options = arguments.parse_args()
    folder: Path = options.folder or Path("outputs/benchmarks/capture") / options.scene
    folder.mkdir(parents=True, exist_ok=True)
    film = SCENES[options.scene](folder)
    into = folder / "captured"
    shutil.rmtree(into, ignore_errors=True)
    began = time.perf_counter()
    settings = replace(
        film.settings, into=str(into), camera=options.lens, alpha_masks=options.mattes
    )
    captured = scene_from_footage(settings)
    row: dict[str, Any] = {"scene": options.scene, "capture s": time.perf_counter() - began}
    frames = json.loads((captured / "transforms.json").read_text())["frames"]
    angle, distance = compared(poses_of(frames), film.true_poses(frames))
    row |= {
        "rotation max deg": float(angle.max()),
        "centre max %": 100 * float(distance.max()) / film.distance,
    }
    if not options.cameras:
        row |= learned(options.scene, captured, folder / "run-captured")
        with_true_cameras(captured, folder / "true", film)
        true = learned(options.scene, folder / "true", folder / "run-true")
        row |= {f"{key}, true cameras": value for key, value in true.items() if key != "learn s"}
    harness.report([row], options.json or folder / "capture.json", torch.device("cpu"))


if __name__ == "__main__":
    main()
