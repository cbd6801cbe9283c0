"""Another Hydra application composes devrf's groups, and pays for no torch until it builds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import devrf

APP = """
import json
import sys

import hydra
from omegaconf import OmegaConf


@hydra.main(config_path="configs", config_name="app", version_base="1.3")
def main(config):
    assert not {"torch", "lightning"} & set(sys.modules), "composing is light"
    print(json.dumps(OmegaConf.to_container(config, resolve=True)))


main()
"""
CONFIG = """
defaults:
  - _self_
  - data@scene: procedural
  - schedule: paper_inward
  - loss: best
  - local: mine
run: ${devrf.run_name:${local.name},base,devrf,two_stage}
label: ${devrf.scene_name:${scene}}
hydra:
  output_subdir: null
  run:
    dir: .
"""


def test_groups_resolvers_and_choices_are_there(tmp_path: Path) -> None:
    (tmp_path / "configs" / "local").mkdir(parents=True)
    (tmp_path / "app.py").write_text(APP)
    (tmp_path / "configs" / "app.yaml").write_text(CONFIG)
    (tmp_path / "configs" / "local" / "mine.yaml").write_text("name: theirs\n")
    source = str(Path(devrf.__file__).parents[1])
    path = os.pathsep.join(filter(None, [source, os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "app.py", "data@scene=inward", "scene.root=/scenes/suzanne"],
        cwd=tmp_path,
        text=True,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": path},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    config = json.loads(done.stdout)
    assert config["scene"]["_target_"] == "devrf.data.recorded.InwardFacingDataModule"
    assert config["schedule"]["canonical"]["side"] == 160
    assert config["loss"]["deformation"]["elastic"] == 0.05  # a row, not a file
    assert (config["run"], config["label"]) == ("theirs-base", "suzanne")
