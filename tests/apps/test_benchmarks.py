"""Which benchmark's protocol a run followed, by what it scored."""

from __future__ import annotations

import tomllib
from dataclasses import fields

import pytest

from devrf.apps import benchmarks
from devrf.apps.benchmarks import followed
from devrf.apps.records import data_record
from devrf.data.recorded import READERS, InwardFacingDataModule
from devrf.scenes.exchange import write_for_others

# All that a protocol may fix of a scene.
KEYS = {
    *("data", "image_size", "downscale", "frames", "train_views", "static_images", "test_frames"),
    *("masked", "background", "lpips_network", "mean_color", "options"),
}
TINY = """
version = 3
data = "embedded"
scenes = ["robot", "other"]
lpips_network = "vgg"
[own.robot]
image_size = [18, 24]
frames = 3
train_views = 2
static_images = 8
test_frames = 3
[own.other]
data = "inward"
options = { frames = "all", alpha_weighted = true }
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A folder of one protocol."""
    monkeypatch.setattr(benchmarks, "FILES", tmp_path / "files")
    benchmarks.benchmarks.cache_clear()
    yield tmp_path / "files" / "tiny.toml"
    benchmarks.benchmarks.cache_clear()


def test_every_file_is_read_and_names_what_there_is():
    found = benchmarks.benchmarks()
    counts = {name: len(scenes) for name, scenes in found.items()}
    assert counts == {
        **{"devrf 1": 9, "dnerf 1": 8, "dycheck 1": 7},
        **{"embedded 1": 4, "hypernerf_vrig 1": 4, "n3dv 1": 6},
    }
    for file in benchmarks.FILES.glob("*.toml"):
        table = tomllib.loads(file.read_text())
        assert {*table.get("own", {})} <= {*table["scenes"]}
    for facts in (facts for scenes in found.values() for facts in scenes.values()):
        assert {"data", "lpips_network"} <= {*facts} <= KEYS
        if facts["data"] == "embedded":
            assert facts["mean_color"] and facts["frames"] and "options" not in facts
        else:
            options = {field.name for field in fields(READERS[facts["data"]])}
            assert {*facts.get("options", {})} <= options


def test_a_run_follows_what_it_did(file, tiny_scene, datamodule, caplog):
    caplog.set_level("INFO")
    record = data_record(tiny_scene)
    red, green, blue, alpha = tiny_scene.dynamic.test.pixels.float().mean(dim=(0, 1, 2)) / 255
    file.parent.mkdir()
    colors = f"mean_color = [{red:.4f}, {green:.4f}, {blue:.4f}, {alpha:.4f}]"
    file.write_text(TINY.replace("test_frames = 3", f"test_frames = 3\n{colors}"))
    assert followed(tiny_scene, datamodule, record, "vgg") == "tiny 3"
    assert followed(tiny_scene, datamodule, record, "alex") is None
    assert "robot: not scored as benchmark tiny 3 is: lpips_network is alex, not vgg" in caplog.text
    assert followed(tiny_scene, datamodule, {**record, "frames": 2}, "vgg") is None
    benchmarks.benchmarks.cache_clear()
    file.write_text(TINY.replace("test_frames = 3", "mean_color = [0.5]"))
    assert followed(tiny_scene, datamodule, record, "vgg") is None
    assert "show something else" in caplog.text


def test_a_readers_options_count(file, tiny_scene, tmp_path):
    file.parent.mkdir()
    file.write_text(TINY)
    write_for_others(tiny_scene, tmp_path / "other", "dnerf")
    for options, expected in (({}, "tiny 3"), ({"frames": 2}, None), ({"name": "robot"}, None)):
        module = InwardFacingDataModule(tmp_path / "other", **options)
        assert followed(module.scene, module, data_record(module.scene), "vgg") == expected
