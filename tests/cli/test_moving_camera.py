"""A capture by a camera that moves, learned, scored and reported by its folder alone."""

from __future__ import annotations

import json
from dataclasses import replace

from devrf.scenes.procedural import ProceduralScene


def test_a_capture_needs_no_flag_beside_its_folder(devrf, short, write_scene, tmp_path) -> None:
    sizes = {"width": 24, "height": 20, "static_views": 16, "static_test_views": 3}
    scene = ProceduralScene(shape="robot", train_views=2, frames=3, supersample=1, **sizes)()
    # The moving camera stands where one fixed view does, then where the next one does.
    train = scene.dynamic.train
    path = train[(train.frames % 2 == train.view).nonzero()[:, 0]]
    write_scene(
        "dycheck", replace(scene, dynamic=replace(scene.dynamic, train=path)), tmp_path / "mill"
    )
    quick = (*short, "schedule.canonical.visual_hull_init=false", "video.frames=1")
    run = devrf("data.root=mill", *quick, "evaluation.metrics=[]")
    assert (run.status, run.err) == (0, "")
    assert "(data=dycheck)" in run.out
    metrics = json.loads((tmp_path / "outputs/mill/quickstart/metrics.json").read_text())
    assert metrics["scene"] == "mill" and metrics["run"]["choices"]["data"] == "dycheck"
    assert metrics["run"]["train_views"] == 1  # one camera, however many images it took
    reported = devrf("stage=report")
    assert (reported.status, reported.err) == (0, "")
    assert "mill" in reported.out and f"{metrics['dynamic']['psnr']:.2f}" in reported.out
