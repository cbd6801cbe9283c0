"""Whole runs on a CUDA device that is not there: what a GPU would refuse, and what it would learn.

Every night: make fuzz, or DEVRF_ALL_LAUNCHES=1.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.cpp_extension import include_paths

from devrf.checkpoints.checkpoint import load_checkpoint

HERE = Path(__file__).parent
TINY = (
    "experiment=paper data=procedural data.width=12 data.height=12 data.static_views=3 "
    "data.frames=3 data.static_test_views=1 video.frames=2 video.height=16 "
    "schedule.canonical.visual_hull_init=true schedule.canonical.search_iterations=0 "
    "schedule.canonical.iterations=12 schedule.canonical.upsample_at=[6] "
    "schedule.canonical.side=10 schedule.canonical.search_side=8 schedule.canonical.rays=24 "
    "schedule.deformation.rays=24 schedule.deformation.levels.1.side=4 "
    "schedule.deformation.levels.1.iterations=6 schedule.deformation.levels.2.side=8 "
    "schedule.deformation.levels.2.iterations=6 schedule.deformation.levels.2.parallel_frames=2 "
    "schedule.deformation.levels.3=null schedule.deformation.levels.4=null "
    "schedule.deformation.levels.5=null schedule.canonical.density_drop=0"
).split()
pytestmark = [
    pytest.mark.skipif(os.environ.get("DEVRF_ALL_LAUNCHES") != "1", reason="takes minutes"),
    pytest.mark.skipif(shutil.which("g++") is None, reason="there is no compiler"),
]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library that tells torch about the device."""
    made = tmp_path_factory.mktemp("library") / "device.so"
    libraries = Path(torch.__file__).parent / "lib"
    command = ["g++", "-std=c++20", "-shared", "-fPIC", str(HERE / "stand_in_device.cpp")]
    command += [f"-I{path}" for path in include_paths()]
    command += [f"-L{libraries}", f"-Wl,-rpath,{libraries}", "-ltorch_cpu", "-lc10"]
    subprocess.run([*command, "-o", str(made)], check=True)
    return made


def metrics_of(library: Path, folder: Path, *arguments: str) -> dict[str, Any]:
    """``metrics.json`` of a whole run; nothing in it was refused, or done in another way."""
    command = [sys.executable, str(HERE / "stand_in_device.py"), f"hydra.run.dir={folder}"]
    environment = {"LD_PRELOAD": str(library), "TRITON_INTERPRET": "1"}
    environment["PYTHONPATH"] = str(HERE.parents[1] / "src")
    done = subprocess.run(
        [*command, *TINY, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in (folder / "run.log").read_text()
    return json.loads((folder / "metrics.json").read_text())  # type: ignore[no-any-return]


def test_kernels_and_graphs_learn_on_the_device_what_plain_pytorch_does(
    library: Path, tmp_path: Path
) -> None:
    plain = metrics_of(library, tmp_path / "torch", "kernels=torch")
    fast = metrics_of(library, tmp_path / "triton")
    for stage in ("canonical", "deformation"):
        there = fast["run"]["execution"][stage]
        assert there["kernels"] == "triton" and there["graph_captures"] > 0, stage
        assert plain["run"]["execution"][stage]["kernels"] == "torch"
    expected, learned = (fields(tmp_path / kernels) for kernels in ("torch", "triton"))
    for name, values in expected.items():
        off = (learned[name] - values).abs().mean()
        assert off <= 0.02 * values.abs().mean() + 1e-6, name
    assert expected["displacement"].abs().mean() > 2e-4  # what is compared is no rounding


def fields(folder: Path) -> dict[str, torch.Tensor]:
    """What a run has learned: the field at rest, and how it is bent at the last frame."""
    model: Any = load_checkpoint(folder / "checkpoints/deformation.ckpt").model
    rest = model.canonical
    fields = {"density": rest.density.values, "color": rest.color.values}
    fields |= {f"decoder.{name}": value for name, value in rest.decoder.state_dict().items()}
    return fields | {"displacement": model.deformation.blended(1.0)}
