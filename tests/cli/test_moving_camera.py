"""A capture by a camera that moves, learned, scored and reported by its folder alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Scene, Views


@pytest.fixture(scope="module")
def inward() -> Scene:
    """The robot in 24 × 20 pixels: 16 static views of a ring, two moving views of 4 frames."""
    sizes = {"width": 24, "height": 20, "static_views": 16, "static_test_views": 3}
    return ProceduralScene(shape="robot", train_views=2, frames=4, supersample=1, **sizes)()


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_photograph(path: Path, views: Views, image: int) -> None:
    """Write an image before a grey wall, as a camera takes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = views.pixels[image].float() / 255
    if views.has_alpha:
        pixels = 0.5 + pixels[..., 3:] * (pixels[..., :3] - 0.5)
    iio.imwrite(path, (255 * pixels.numpy()).round().astype(np.uint8))


def nerfies_camera(cameras: Cameras, image: int) -> dict[str, Any]:
    """A camera as Nerfies writes it: world-to-camera axes, x right, y down, z forward."""
    pose, focal = cameras.camera_to_world[image], cameras.focal[image]
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


def write_windmill(root: Path, scene: Scene) -> None:
    """DyCheck: Nerfies' files; camera 0 moves and is learned from, one that stands is held out."""
    # The moving camera stands where one fixed view does, then where the next one does.
    train, test = scene.dynamic.train, scene.dynamic.test
    chosen = {"train": train.frames % 2 == train.view, "val": test.view == 0}
    ids, metadata = {}, {}
    for split, camera, views in (("train", 0, train), ("val", 1, test)):
        images = chosen[split].nonzero()[:, 0].tolist()
        times = [int(views.frames[k]) for k in images]
        ids[split] = [f"{camera}_{time:05d}" for time in times]
        for item, time, k in zip(ids[split], times, images, strict=True):
            write_photograph(root / "rgb/1x" / f"{item}.png", views, k)
            write_json(root / "camera" / f"{item}.json", nerfies_camera(views.cameras, k))
            metadata[item] = {"warp_id": time, "appearance_id": time, "camera_id": camera}
        names = {"frame_names": ids[split], "camera_ids": [camera] * len(times), "time_ids": times}
        write_json(root / "splits" / f"{split}.json", names)
    everything = ids["train"] + ids["val"]
    counts = {"count": len(everything), "num_exemplars": len(ids["train"])}
    lists = {"ids": everything, "train_ids": ids["train"], "val_ids": ids["val"]}
    write_json(root / "dataset.json", {**counts, **lists})
    write_json(root / "metadata.json", metadata)
    bounds = {"near": scene.bounds.near, "far": scene.bounds.far}
    write_json(root / "scene.json", {"scale": 1.0, "center": [0.0, 0.0, 0.0], **bounds})
    extra = {"bbox": [[-1, -1, -1], [1, 1, 1]], "factor": 1, "fps": 60}
    write_json(root / "extra.json", {**extra, "lookat": [0, 0, 0], "up": [0, 0, 1]})


def test_a_capture_needs_no_flag_beside_its_folder(devrf, short, inward, tmp_path) -> None:
    write_windmill(tmp_path / "windmill", inward)
    quick = (*short, "schedule.canonical.visual_hull_init=false", "video.frames=1")
    run = devrf("data.root=windmill", *quick, "evaluation.metrics=[]")
    assert (run.status, run.err) == (0, "")
    assert "(data=dycheck)" in run.out
    folder = tmp_path / "outputs" / "windmill" / "quickstart"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["scene"] == "windmill" and metrics["run"]["choices"]["data"] == "dycheck"
    assert metrics["run"]["train_views"] == 1  # one camera, however many images it took
    reported = devrf("stage=report")
    assert (reported.status, reported.err) == (0, "")
    assert "windmill" in reported.out and f"{metrics['dynamic']['psnr']:.2f}" in reported.out
