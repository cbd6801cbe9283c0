"""A capture with images of two sizes, learned, scored and shown by its folder alone."""

from __future__ import annotations

import csv
import json

import imageio.v3 as iio
import torch

from devrf.checkpoints.checkpoint import load_checkpoint
from layouts import write_scene, write_sparse

BRIEF = ("video.frames=2", "evaluation.metrics=[psnr_masked]", "data.flow=dis")


def test_a_listed_scene_of_two_sizes(devrf, short, two_sizes, tmp_path):
    write_scene("nerfstudio", two_sizes, tmp_path / "robot")
    place = ("data=nerfstudio", "data.root=robot", "hydra.run.dir=run")
    run = devrf(*short, *place, *BRIEF)
    assert (run.status, run.err) == (0, "")
    assert "images of several sizes up to 24x18 px" in run.out
    with (tmp_path / "run/frames.csv").open(newline="") as file:
        scores = [float(row["psnr"]) for row in csv.DictReader(file)]
    assert len(scores) == 6 and min(scores) > 5
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["run"]["image_size"] == [18, 18]
    # The cameras of a checkpoint have the images' sizes.
    kept = load_checkpoint(tmp_path / "run/checkpoints/deformation.ckpt").viewpoints
    assert kept is not None and kept.static.size_of(0) != kept.static.size_of(1)
    still = devrf("stage=still", "hydra.run.dir=run", "still.view=1", "still.time=0")
    assert (still.status, still.err) == (0, "")
    (picture,) = (tmp_path / "run/images").glob("still_1_t0.png")
    assert iio.imread(picture).shape[0] == 400
    looked = devrf("stage=inspect", *place[:2], "hydra.run.dir=looked")
    assert (looked.status, looked.err) == (0, "")
    assert "18 x 18, 24 x 16" in looked.out


def test_a_sparse_model_of_two_sizes(devrf, short, two_sizes, tmp_path):
    train = two_sizes.static.train
    names = [f"{k}.png" for k in range(len(train))]
    points = 0.4 * torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) - 0.2
    model = tmp_path / "robot/sparse/0"
    write_sparse(model, train.cameras, names, points)
    (fx, fy), (cx, cy) = train.cameras.focal[0].tolist(), train.cameras.center[0].tolist()
    cameras = [
        f"{k} PINHOLE {size} {fx} {fy} {cx} {cy}" for k, size in ((1, "18 18"), (2, "24 16"))
    ]
    (model / "cameras.txt").write_text("\n".join(cameras))
    text = (model / "images.txt").read_text()
    for name in names[1::2]:
        text = text.replace(f" 1 {name}", f" 2 {name}")
    (model / "images.txt").write_text(text)
    (tmp_path / "robot/images").mkdir()
    for name, view in zip(names, train.singles(), strict=True):
        iio.imwrite(tmp_path / "robot/images" / name, view.pixels[0].numpy())
    run = devrf(*short, "data=colmap", "data.root=robot", "hydra.run.dir=run", *BRIEF[:2])
    assert (run.status, run.err) == (0, "")
    with (tmp_path / "run/frames.csv").open(newline="") as file:
        assert min(float(row["psnr"]) for row in csv.DictReader(file)) > 5
