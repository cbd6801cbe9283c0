"""A built wheel works from any folder, without the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from devrf.cli.config import config_folder

REPOSITORY = Path(__file__).parents[2]
SCENE = "width=24 height=20 static_views=6 static_test_views=2 train_views=2 frames=3 supersample=1"
SCHEDULE = "iterations=6 side=16 search_side=16 upsample_at=[2] rays=64"
TINY = ["field.width=16", *(f"data.{word}" for word in SCENE.split())]
TINY += [f"schedule.canonical.{word}" for word in SCHEDULE.split()]


def run(*command: object, folder: Path) -> subprocess.CompletedProcess[str]:
    hidden = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}
    environment = {key: value for key, value in os.environ.items() if key not in hidden}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env=environment,
        text=True,
        capture_output=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with a source distribution and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, folder=REPOSITORY)
    return folder


@pytest.fixture(scope="module")
def wheel(built) -> Path:
    """The wheel."""
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def environment(tmp_path_factory, wheel) -> Path:
    """A fresh environment with the wheel, which sees this one's packages but not the checkout."""
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    venv.create(folder, with_pip=False, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    # A path that is added by a .pth file is no site folder: the .pth files in it, which an
    # editable install of the checkout leaves there, are not read.
    theirs = {Path(path).resolve() for path in sys.path if path.endswith("site-packages")}
    (site / "dependencies.pth").write_text("".join(f"{path}\n" for path in sorted(theirs)))
    pip = (sys.executable, "-m", "pip", "--python", folder / "bin" / "python")
    run(*pip, "install", "--no-deps", "--no-index", "--quiet", wheel, folder=folder)
    return folder


def test_the_wheel_has_code_configs_and_licence(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    configs = {p.relative_to(config_folder()) for p in config_folder().rglob("*.y*ml")}
    assert {f"devrf/conf/{path.as_posix()}" for path in configs} <= names
    assert "devrf/__main__.py" in names and "devrf/py.typed" in names
    assert "devrf/apps/report/published.toml" in names
    assert {f"devrf/apps/web/scene.{kind}" for kind in ("html", "js", "glsl")} <= names
    assert [name for name in names if name.endswith("licenses/LICENSE")]
    assert {name.split("/")[0].split("-")[0] for name in names} == {"devrf"}


def test_all_extras_bring_no_torchvision():
    """Beside torch's CPU build, pip takes torchvision's CUDA build, which does not work."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    (everything,) = project["optional-dependencies"]["all"]
    extras = Requirement(everything).extras
    assert "viewer" in extras and "raft" not in extras
    brought = [word for extra in extras for word in project["optional-dependencies"][extra]]
    assert not any(Requirement(word).name == "torchvision" for word in brought)


def test_the_source_distribution_has_what_a_build_needs(built):
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "conf/config.yaml", "src/devrf/cli/main.py", "LICENSE"} <= names
    assert {"mkdocs.yml", "docs/method.md", "CHANGELOG.md", "CITATION.cff"} <= names


def test_an_installed_devrf_learns_a_scene_from_any_folder(environment, tmp_path):
    python = environment / "bin" / "python"
    script = "import devrf, devrf.cli.config as c; print(devrf.__file__, c.config_folder())"
    where = run(python, "-c", script, folder=tmp_path).stdout
    assert str(REPOSITORY) not in where
    assert all(part.startswith(str(environment)) for part in where.split())
    arguments = ["stage=canonical", "hydra.run.dir=run", *TINY]
    done = run(environment / "bin" / "devrf", *arguments, folder=tmp_path)
    assert done.stderr == ""
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()


def test_another_program_names_the_installed_groups(environment, tmp_path):
    (tmp_path / "app.yaml").write_text(
        "defaults: [_self_, schedule: best_inward]\nhydra: {searchpath: ['pkg://devrf.conf']}\n"
    )
    script = (
        "from hydra import compose, initialize_config_dir as folder\n"
        f"with folder({str(tmp_path)!r}, version_base='1.3'): print(compose('app'))"
    )
    done = run(environment / "bin" / "python", "-c", script, folder=tmp_path)
    assert "'elastic': 0.05" in done.stdout and done.stderr == ""
