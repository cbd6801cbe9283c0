"""An installed devrf leaves other Hydra programs alone; those that name its groups have them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import devrf
from devrf.cli.config import config_folder

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
RUN = "hydra: {output_subdir: null, run: {dir: .}}"


def run(folder: Path, files: dict[str, str], *typed: str) -> dict[str, Any]:
    """What a small program of its own, with these files in ``configs/``, composes."""
    for name, content in {"app.yaml": f"{RUN}\n", **files}.items():
        (folder / "configs" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "configs" / name).write_text(content)
    (folder / "app.py").write_text(APP)
    source = str(Path(devrf.__file__).parents[1])
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), source]))
    done = subprocess.run(
        [sys.executable, "app.py", *typed],
        cwd=folder,
        text=True,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": path},
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    config: dict[str, Any] = json.loads(done.stdout)
    return config


def test_groups_of_the_same_names_are_another_programs_own(tmp_path: Path) -> None:
    files = {
        "app.yaml": f"defaults: [_self_, loss: forward, field: x, experiment: null]\n{RUN}\n",
        "loss/forward.yaml": "weight: 1\n",
        "field/x.yaml": "width: 2\n",
        "experiment/y.yaml": "# @package _global_\ndefaults: [override /loss: other]\nseed: 3\n",
        "loss/other.yaml": "defaults: [forward]\nbias: 4\n",
    }
    composed = {"loss": {"weight": 1, "bias": 4}, "field": {"width": 2}, "seed": 3}
    assert run(tmp_path, files, "experiment=y") == composed


def test_a_program_that_names_the_folder_has_devrfs_groups(tmp_path: Path) -> None:
    app = "defaults:\n  - _self_\n  - data@scene: inward\n  - schedule@devrf: best_inward\n"
    app += f"  - local: mine\n{RUN}\n"
    app = app.replace("run: {", f'searchpath: ["file://{config_folder()}"], run: {{')
    files = {"app.yaml": app, "local/mine.yaml": "name: theirs\n"}
    config = run(tmp_path, files, "scene.root=/scenes/suzanne")
    assert config["scene"]["_target_"] == "devrf.data.recorded.InwardFacingDataModule"
    assert config["devrf"]["schedule"]["canonical"]["search_side"] == 48
    assert config["devrf"]["loss"]["deformation"]["elastic"] == 0.05
    assert {*config} == {"scene", "devrf", "local"}
    assert config["local"] == {"name": "theirs"}
