"""An embedded scene written to disk is a scene from disk like any other."""

from __future__ import annotations

import json

import pytest


@pytest.fixture(scope="module")
def exported(devrf_in, tmp_path_factory, tiny):
    folder = tmp_path_factory.mktemp("exported")
    outcome = devrf_in(folder, *tiny, "stage=prepare", "data.export=robot")
    assert (outcome.status, outcome.err) == (0, "")
    return folder / "robot"


def test_the_published_layout_is_written(exported):
    assert (exported / "static" / "transforms_train.json").is_file()
    assert (exported / "dynamic_2views" / "transforms_test.json").is_file()


def test_every_stage_runs_on_it(devrf, tmp_path, exported, short):
    outcome = devrf(*short, "data=inward", f"data.root={exported}", "data.bound_scale=1.2")
    assert (outcome.status, outcome.err) == (0, "")
    # The folder is told from the scene's: outputs/SCENE/EXPERIMENT.
    found = json.loads((tmp_path / "outputs" / "robot" / "quickstart" / "metrics.json").read_text())
    assert found["scene"] == "robot"
    assert found["deformation"]["iterations"] == 12
