"""Which benchmark's protocol a run followed, by what it scored."""

from __future__ import annotations

from dataclasses import fields

import pytest

from devrf.apps import benchmarks
from devrf.apps.benchmarks import Benchmark, followed
from devrf.apps.records import data_record
from devrf.data.recorded import READERS, InwardFacingDataModule
from devrf.scenes.exchange import write_for_others

TINY = """
version = 3
title = "one robot"
source = "this file"
data = "embedded"
lpips_network = "vgg"
[scenes.robot]
image_size = [18, 24]
frames = 3
train_views = 2
static_images = 8
test_frames = 3
[scenes.other]
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
    counts = {name: len(benchmark.scenes) for name, benchmark in found.items()}
    assert counts == {
        **{"devrf": 9, "dnerf": 8, "dycheck": 7, "embedded": 4, "hypernerf_vrig": 4, "n3dv": 6}
    }
    for benchmark in found.values():
        for scene in benchmark.scenes:
            facts = benchmark.of_scene(scene)
            if facts.data == "embedded":
                assert facts.mean_color and facts.frames and not facts.options
            else:
                assert {*facts.options} <= {field.name for field in fields(READERS[facts.data])}
            assert facts.lpips_network and benchmark.source and benchmark.version == 1


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


def test_a_misspelt_fact_is_an_error():
    with pytest.raises(ValueError, match="image_sise"):
        Benchmark(version=1, title="", source="", scenes={}, image_sise=(1, 2))
