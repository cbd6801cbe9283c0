"""``stage=export``: which files it writes, and what it refuses in one line."""

from __future__ import annotations

import json

import pytest
import trimesh

# A few iterations make nothing that is more opaque.
FAINT = "export.threshold=5e-3"


@pytest.fixture
def export(devrf, trained):
    """``export(*arguments)``: the tiny run's last checkpoint, exported into ``run``."""
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"

    def command(*arguments):
        return devrf("stage=export", f"ckpt={checkpoint}", "hydra.run.dir=run", *arguments)

    return command


def test_one_file_that_plays(export, tmp_path):
    outcome = export(FAINT, "export.faces=200")
    assert (outcome.status, outcome.err) == (0, "")
    path = tmp_path / "run" / "export" / "scene.glb"
    assert f"vertices at 3 times written to {path}" in outcome.out
    (mesh,) = trimesh.load_scene(path).geometry.values()
    assert 100 < len(mesh.faces) <= 200


def test_files_of_wanted_times_in_a_wanted_folder(export, tmp_path):
    there = ("export.into=out there", "export.fps=2", "export.seconds=2", "export.format=obj")
    assert export(FAINT, *there).status == 0
    index = json.loads((tmp_path / "out there" / "obj" / "index.json").read_text())
    assert [one["time"] for one in index["frames"]] == [0, 0.25, 0.5, 0.75, 1]
    assert {one["file"] for one in index["frames"]} | {"index.json"} == {
        path.name for path in (tmp_path / "out there" / "obj").iterdir()
    }


def test_points_of_each_training_frame(export, tmp_path):
    outcome = export("export.content=points", "export.format=ply", "export.points=50")
    assert (outcome.status, outcome.err) == (0, "")
    folder = tmp_path / "run" / "export" / "points"
    index = json.loads((folder / "index.json").read_text())
    assert index["content"] == "points"
    assert [one["time"] for one in index["frames"]] == pytest.approx([0, 0.5, 1])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "export.threshold: the field is empty: no voxel has the opacity 0.1, the most is"),
        (["export.format=stl"], "export.format: expected one of gltf, ply, obj, usd, not 'stl'"),
        (["export.times=[0,2]"], "export.times: expected times from 0 to 1, not [0, 2]"),
        (["export.content=points"], "points are written as ply, not as gltf; give export.format"),
        (["ckpt=none.ckpt"], "none.ckpt: no such checkpoint"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(export, tmp_path, arguments, expected):
    outcome = export(*arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and expected in outcome.err
    assert not (tmp_path / "run" / "export").exists()
