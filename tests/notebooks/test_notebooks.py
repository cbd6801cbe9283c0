"""Every notebook is stored with its figures, and all of it runs."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

import devrf
from devrf.cli.config import config_folder

REASON = "needs devrf[notebooks]"
nbformat = pytest.importorskip("nbformat", reason=REASON)
nbclient = pytest.importorskip("nbclient", reason=REASON)
pytest.importorskip("ipykernel", reason=REASON)
pytest.importorskip("matplotlib", reason=REASON)

PATHS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


@pytest.fixture(params=PATHS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def showing(notebook):
    """The cells that show figures or tables."""
    return [c for c in code_cells(notebook) if "plt.show()" in c.source or "display(" in c.source]


def shows_something(cell):
    return any({"image/png", "text/markdown"} & set(o.get("data", {})) for o in cell.outputs)


def test_it_is_stored_with_its_figures(notebook):
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.metadata.kernelspec.name == "python3"
    counts = [cell.execution_count for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1)), "run it from top to bottom, and save it"
    assert all(shows_something(cell) for cell in showing(notebook))
    # Small enough to live in a repository.
    assert len(nbformat.writes(notebook)) < 1_500_000


def leave_run(folder, number, ablation, psnr):
    """What ``compare_runs`` reads of a finished run."""
    choices = {"ablation": ablation, "method": "devrf", "protocol": "two_stage"}
    learned = {"choices": choices, "settings": {"loss.terms": ablation, "views": number}}
    dynamic = {"psnr": psnr, "rest_pose_psnr": 20.0, "ssim": 0.9, "lpips": None, "seconds": 9.0}
    record = {
        "scene": "robot",
        "method": "devrf",
        "protocol": "two_stage",
        "static": {"psnr": 33.0, "seconds": 5.0},
        "dynamic": dynamic,
        "run": {**learned, "train_views": number, "device": "a processor"},
    }
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(record))
    rows = "".join(f"dynamic,m{k},{k},{psnr + k}\n" for k in range(2))
    (folder / "frames.csv").write_text(f"capture,name,time,psnr\n{rows}")


def test_the_sweep_of_compare_runs_composes(monkeypatch):
    monkeypatch.setenv("DEVRF_NOTEBOOK_SCALE", "0.05")
    cells = code_cells(nbformat.read(PATHS[0], as_version=4))
    source = next(cell.source for cell in cells if "SWEEP = [" in cell.source)
    names = {"os": os, "Path": Path}
    exec(source[: source.index("\nif ")], names)
    overrides = [re.sub(r",[^,\[\]{}]*$", "", text) for text in names["SWEEP"][:2]]
    with initialize_config_dir(str(config_folder()), version_base=None):
        composed = compose("config", [*overrides, *names["SWEEP"][2:]])
    assert composed.data.train_views == 1


def test_its_short_form_runs(notebook, monkeypatch, tmp_path):
    runs = tmp_path / "runs"
    for k, (views, ablation, psnr) in enumerate(
        ((1, "base", 21), (1, "full", 24), (4, "full", 28))
    ):
        leave_run(runs / str(k), views, ablation, psnr)
    monkeypatch.setenv("DEVRF_RUNS", str(runs))
    # The kernel is a process of its own: it finds the devrf that is tested here.
    source = str(Path(devrf.__file__).parents[1])
    before = [path for path in (os.environ.get("PYTHONPATH"),) if path]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([source, *before]))
    monkeypatch.setenv("DEVRF_NOTEBOOK_SCALE", "0.05")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    # Whatever kernels this machine knows, it is this interpreter that runs the cells.
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    client = nbclient.NotebookClient(
        notebook,
        timeout=120,
        kernel_name="python3",
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.create_kernel_manager().kernel_spec.argv = command
    client.execute()  # an error in a cell is raised

    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert showing(notebook) and all(shows_something(cell) for cell in showing(notebook))


def test_there_are_the_documented_ones():
    assert [path.stem for path in PATHS] == ["compare_runs", "look_inside"]
