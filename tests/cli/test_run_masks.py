"""Masked pixels have no part in a run: neither in what is learned nor in the scores."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.scenes.scene import Scene
from layouts import write_scene

# Where a passer-by stands, of another grey in each of two recordings.
MASKED = (slice(0, 7), slice(3, 12))
LAYOUT = ("data=nerfstudio", "data.flow=none")


@pytest.fixture
def recorded(tiny_scene: Scene, tmp_path: Path) -> Callable[[str, int], Path]:
    """``recorded(name, grey)``: the tiny scene on white in nerfstudio's layout."""

    def write(name: str, grey: int) -> Path:
        root = tmp_path / name
        write_scene("nerfstudio", tiny_scene, root)
        content = json.loads((root / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["mask_path"] = "mask.png"
            pixels = iio.imread(root / frame["file_path"]).astype(np.float32)
            alpha = pixels[..., 3:] / 255
            shown = (pixels[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
            shown[MASKED] = grey
            iio.imwrite(root / frame["file_path"], shown)
        mask = np.full(shown.shape[:2], 255, dtype=np.uint8)
        mask[MASKED] = 0
        iio.imwrite(root / "mask.png", mask)
        (root / "transforms.json").write_text(json.dumps(content))
        return root

    return write


def scores(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_masked_pixels_decide_nothing(devrf, short, recorded, tiny_scene, tmp_path):
    bounds = tiny_scene.bounds.box
    box = f"data.box={[list(bounds.low), list(bounds.high)]}".replace(" ", "")
    more = (box, "data.masks=ignore", "video.frames=1", "evaluation.metrics=[]")
    for name, grey in (("a", 0), ("b", 200)):
        root = f"data.root={recorded(name, grey)}"
        outcome = devrf(*short, *LAYOUT, root, *more, f"hydra.run.dir=run_{name}")
        assert (outcome.status, outcome.err) == (0, "")
    a, b = tmp_path / "run_a", tmp_path / "run_b"
    assert "leave out 14.6 % of the pixels" in outcome.out  # 7 · 9 of 24 · 18
    assert scores(a) == scores(b) and len(scores(a)) == 6
    assert float(scores(a)[0]["psnr"]) > 5
    ours, theirs = (
        load_checkpoint(one / "checkpoints" / "deformation.ckpt").model.state_dict()
        for one in (a, b)
    )
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
