"""What masks leave out has no part in a run: neither in what is learned nor in the scores."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Scene, Views

WIDTH, HEIGHT = 24, 20
# What somebody is in who walks past the cameras.
LEFT_OUT = (slice(0, 7), slice(3, 12))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A robot at rest and in motion."""
    return ProceduralScene(
        shape="robot",
        width=WIDTH,
        height=HEIGHT,
        static_views=6,
        static_test_views=1,
        train_views=2,
        frames=3,
        supersample=1,
    )()


def write(root: Path, scene: Scene, passer_by: int) -> Path:
    """The scene in nerfstudio's layout, on white, with somebody who is to be left out."""
    (root / "images").mkdir(parents=True)
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[LEFT_OUT] = 0
    Image.fromarray(mask).save(root / "mask.png")
    frames: list[dict[str, Any]] = []

    def add(views: Views, name: str) -> None:
        for k, pose in enumerate(views.cameras.camera_to_world.tolist()):
            pixels = views.pixels[k].numpy().astype(np.float32)
            matte = pixels[..., 3:] / 255
            shown = (pixels[..., :3] * matte + 255 * (1 - matte)).round().astype(np.uint8)
            shown[LEFT_OUT] = passer_by
            path = f"images/{name}_{k}.png"
            Image.fromarray(shown).save(root / path)
            frames.append(
                {
                    "file_path": path,
                    "mask_path": "mask.png",
                    "time": float(views.times[k]),
                    "transform_matrix": [*pose, [0, 0, 0, 1]],
                }
            )

    add(scene.static.train, "static")
    add(scene.static.test, "held_static")
    add(scene.dynamic.train, "dynamic")
    add(scene.dynamic.test, "held_dynamic")
    cameras = scene.static.train.cameras
    held = [f["file_path"] for f in frames if "held" in f["file_path"]]
    (root / "transforms.json").write_text(
        json.dumps(
            {
                "fl_x": float(cameras.focal[0, 0]),
                "w": WIDTH,
                "h": HEIGHT,
                "frames": frames,
                "test_filenames": held,
            }
        )
    )
    return root


def scores(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def fields(folder: Path) -> dict[str, torch.Tensor]:
    state = load_checkpoint(folder / "checkpoints" / "deformation.ckpt").model.state_dict()
    return {name: value for name, value in state.items() if torch.is_tensor(value)}


def test_what_is_left_out_decides_nothing(devrf, short, scene, tmp_path):
    box = f"data.box={[list(scene.bounds.box.low), list(scene.bounds.box.high)]}".replace(" ", "")
    for name, passer_by in (("a", 0), ("b", 200)):
        write(tmp_path / name, scene, passer_by)
        outcome = devrf(
            *short,
            "data=nerfstudio",
            f"data.root={name}",
            "data.flow=none",
            box,
            f"hydra.run.dir=run_{name}",
        )
        assert (outcome.status, outcome.err) == (0, "")
    assert "leave out 13.1 % of the pixels" in outcome.out
    a, b = tmp_path / "run_a", tmp_path / "run_b"
    assert scores(a) == scores(b) and len(scores(a)) == 5
    assert float(scores(a)[0]["psnr"]) > 5
    ours, theirs = fields(a), fields(b)
    assert list(ours) == list(theirs)
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def test_unless_it_is_not_to_be_left_out(devrf, short, scene, tmp_path):
    told = []
    for name, passer_by in (("a", 0), ("b", 200)):
        write(tmp_path / name, scene, passer_by)
        outcome = devrf(
            *short,
            "data=nerfstudio",
            f"data.root={name}",
            "data.flow=none",
            "data.masks=none",
            f"hydra.run.dir=run_{name}",
            "video.frames=1",
        )
        assert outcome.status == 0
        told.append(scores(tmp_path / f"run_{name}"))
    assert told[0] != told[1]


def test_inspect_says_what_masks_leave_out(devrf, scene, tmp_path):
    write(tmp_path / "a", scene, 0)
    outcome = devrf("stage=inspect", "data=nerfstudio", "data.root=a", "data.flow=none")
    assert outcome.status == 0
    row = next(line for line in outcome.out.splitlines() if "static train" in line)
    assert "leave out 13 %" in row
    cut = devrf(
        "stage=inspect", "data=nerfstudio", "data.root=a", "data.flow=none", "data.masks=matte"
    )
    row = next(line for line in cut.out.splitlines() if "static train" in line)
    assert "cover 87 %" in row


def test_a_mask_that_is_not_there(devrf, scene, tmp_path):
    write(tmp_path / "a", scene, 0)
    (tmp_path / "a" / "mask.png").unlink()
    outcome = devrf("stage=canonical", "data=nerfstudio", "data.root=a")
    assert (outcome.status, outcome.err) == (
        2,
        f"devrf: {Path('a/mask.png')}: no such mask; correct mask_path, or set data.masks=none\n",
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
