"""Hydra's own ``compose()`` and the command line give the same config, whatever is chosen."""

from __future__ import annotations

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from devrf.cli.complete import completed
from devrf.cli.config import config_folder, group_choices

NAMES = group_choices()
EMBEDDED = {"procedural", "flower", "procedural_forward"}


@pytest.mark.parametrize("data", NAMES["data"])
def test_the_command_line_adds_nothing_to_what_is_typed(data):
    scene = [f"data={data}", *([] if data in EMBEDDED else ["data.root=scene"])]
    for experiment in NAMES["experiment"]:
        typed = [*scene, f"experiment={experiment}"]
        assert completed(typed).words == typed


@pytest.mark.parametrize(
    ("data", "experiment"),
    [("procedural", "quickstart"), ("forward", "paper"), ("colmap", "phone")],
)
def test_python_and_the_command_line_compose_the_same(devrf, data, experiment):
    scene = [f"data={data}", *([] if data in EMBEDDED else ["data.root=scene"])]
    typed = [*scene, f"experiment={experiment}"]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        composed = OmegaConf.to_yaml(compose("config", typed))
    said = devrf(*typed, "--cfg", "job")
    assert (said.status, said.out.strip(), said.err) == (0, composed.strip(), "")
