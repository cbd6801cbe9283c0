"""``stage=inspect``: what a scene holds, written and drawn before anything is learned."""

from __future__ import annotations

import imageio.v3 as iio


def test_a_scene_is_described_and_drawn(devrf, tmp_path, tiny):
    outcome = devrf(*tiny, "stage=inspect", "data.static_views=16", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    for part in (
        "robot, inward-facing",
        "static train",
        "24 x 20",
        "optical flow",
        "3 from 0 to 1",
        "GPU, deformation stage",
        "checkpoint",
        "no problems found",
        "inspect.png",
    ):
        assert part in outcome.out
    page = iio.imread(tmp_path / "run" / "images" / "inspect.png")
    assert page.shape[1] == 1600
    assert "inward-facing" in (tmp_path / "run" / "run.log").read_text()
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_problems_are_advice(devrf, tiny):
    # Two views leave more than half of the circle unseen.
    outcome = devrf(*tiny, "stage=inspect", "data.static_views=2")
    assert (outcome.status, outcome.err) == (0, "")
    assert "problems found: 1" in outcome.out
    assert "static training set: no view from a sector of" in outcome.out


def test_the_space_and_the_box_are_said_with_their_reasons(devrf, tiny):
    outcome = devrf(*tiny, "stage=inspect", "data.surroundings=room", "data.static_views=16")
    assert (outcome.status, outcome.err) == (0, "")
    lines = {line.strip()[:5]: line for line in outcome.out.splitlines()}
    assert "contracted" in lines["space"]
    assert "(the images have no mattes, data.box is not given)" in lines["space"]
    assert "(what the static cameras all see)" in lines["box  "]
