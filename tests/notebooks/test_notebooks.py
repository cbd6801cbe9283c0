"""Every notebook is stored with its figures, and all of it runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

import devrf

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


def test_its_short_form_runs(notebook, monkeypatch, tmp_path):
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
