"""``stage=still`` and videos of any size."""

from __future__ import annotations

import shutil

import imageio.v3 as iio
import pytest


def test_a_still_in_any_size(devrf, tmp_path, tiny, trained):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    outcome = devrf(
        *tiny,
        "stage=still",
        f"ckpt={checkpoint}",
        "still.time=0.3",
        "still.height=70",
        "hydra.run.dir=run",
    )
    assert (outcome.status, outcome.err) == (0, "")
    for name in ("still_held_out_t0.3_h70", "still_held_out_t0.3_h70_depth"):
        assert f"{name}.png" in outcome.out
        assert iio.imread(tmp_path / "run" / "images" / f"{name}.png").shape == (70, 84, 3)


def test_videos_in_any_size(devrf, tmp_path, tiny, trained):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    outcome = devrf(*tiny, "stage=render", "video.height=30", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    # Two and three images of 30 x 36 pixels with a gap of 4, below a line of text.
    for name, width in (("held_out", 3 * 36 + 8), ("orbit", 2 * 36 + 4)):
        video = iio.imread(tmp_path / "run" / "videos" / f"{name}.mp4")
        assert video.shape == (4, 18 + 30, width, 3)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["still.view=6"], "still.view: expected held_out or 0 to 5, not 6"),
        (["still.view=front"], "still.view: expected one of held_out or a whole number"),
        (["still.time=2"], "still.time: expected 0 to 1, not 2"),
    ],
)
def test_no_such_still(devrf, tmp_path, tiny, trained, arguments, expected):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    here = ("stage=still", f"ckpt={checkpoint}", "hydra.run.dir=run")
    outcome = devrf(*tiny, *here, *arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and expected in outcome.err
    assert not list(tmp_path.iterdir())


def test_earlier_stills_stay(devrf, tmp_path, trained):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    for typed in ((), (), ("still.view=1",)):
        assert devrf("stage=still", "hydra.run.dir=run", *typed).status == 0
    names = ("held_out_t0.5", "held_out_t0.5_2", "1_t0.5")
    made = {path.stem for path in (tmp_path / "run" / "images").iterdir()}
    assert made == {f"still_{name}{kind}" for name in names for kind in ("", "_depth")}


def test_a_still_reads_no_scene(devrf, tmp_path, tiny, trained, monkeypatch):
    command = ("stage=still", f"ckpt={trained[0] / 'checkpoints' / 'deformation.ckpt'}")

    def unread(self):
        raise AssertionError("the scene was read")

    with monkeypatch.context() as patch:
        patch.setattr("devrf.data.rendered.RenderedDataModule.load", unread)
        assert devrf(*command, "hydra.run.dir=run").status == 0
    # Data that is not that of the checkpoint is read, and refused.
    outcome = devrf(*command, "hydra.run.dir=other", "data.frames=4")
    assert outcome.status == 2
    assert "belongs to another scene" in outcome.err
