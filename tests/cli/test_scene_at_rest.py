"""A scene at rest: canonical, evaluate, render; a refusal of what would learn motion."""

from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as iio
import pytest

from devrf.scenes.export import export
from devrf.scenes.procedural import ProceduralScene


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory) -> Path:
    """A scene whose static capture is all there is."""
    root = tmp_path_factory.mktemp("rest") / "statue"
    sizes = {"width": 24, "height": 18, "static_views": 6, "static_test_views": 3}
    export(ProceduralScene(shape="robot", train_views=2, frames=2, supersample=1, **sizes)(), root)
    (root / "dynamic_2views").rename(root.parent / "moving")
    return root


def test_the_pipeline_learns_no_motion(devrf, tmp_path, short, at_rest):
    where = ("data=inward", f"data.root={at_rest}", "hydra.run.dir=run")
    done = devrf(*where, *short, "objective=dynamic.psnr")
    assert (done.status, done.err) == (0, "")
    assert "statue is at rest: canonical, evaluate, render; no motion is learned" in done.out
    run = tmp_path / "run"
    assert [path.name for path in (run / "checkpoints").glob("*.ckpt")] == ["canonical.ckpt"]
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["at_rest"] is True and metrics["static"] == metrics["canonical"]
    assert "dynamic" not in metrics and set(metrics["run"]["wall_seconds"]) == {
        "canonical",
        "evaluate",
    }
    film = iio.imread(run / "videos" / "held_out.mp4")
    assert len(film) == 4 and film.shape[2] > 1.5 * film.shape[1]
    report = devrf("stage=report", "report.runs=run")
    assert report.status == 0 and f"{metrics['static']['psnr']:.2f}" in report.out
    assert "At rest, scored on held-out images of the static set: statue." in report.out
    for stage in ("evaluate", "render", "still"):
        assert devrf(*where, *short, f"stage={stage}").status == 0
    inspected = devrf(*where, "stage=inspect", "trainer=cpu")
    assert "one moment: the scene is at rest" in inspected.out
    assert "dynamic training set" not in inspected.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["stage=deformation"], "stage=deformation: learns motion, but statue is at rest"),
        (
            ["method=dnerf", "protocol=joint"],
            "protocol=joint: learns from images in motion, but statue is at rest",
        ),
        (["data.frames=2"], "data.frames: 2 was asked for, but all images of"),
        (["data.flow=dis"], "data.flow: "),
    ],
)
def test_what_needs_motion_is_refused(devrf, tmp_path, short, at_rest, arguments, said):
    small = () if "method=dnerf" in arguments else short
    done = devrf("data=inward", f"data.root={at_rest}", "trainer=cpu", *small, *arguments)
    assert done.status == 2 and done.err.startswith(f"devrf: {said}")
    assert len(done.err.splitlines()) == 1 and not (tmp_path / "outputs").exists()
