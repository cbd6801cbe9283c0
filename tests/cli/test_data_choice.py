"""A scene's folder is enough: ``data=auto`` finds its reader."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from devrf.cli.config import config_folder
from devrf.cli.data_choice import with_data_choice
from devrf.scenes.export import export
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.colmap import ColmapReader
from devrf.scenes.formats.dycheck import DycheckReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.formats.neural_3d_video import Neural3DVideoReader
from devrf.scenes.procedural import ProceduralScene

READERS = (BlenderReader, LlffReader, NerfiesReader, NerfstudioReader)
READERS += (ColmapReader, Neural3DVideoReader, DycheckReader)


@pytest.mark.parametrize(
    ("arguments", "chosen"),
    [
        (["data.root=x"], True),
        (["+data.root=x", "seed=1"], True),
        (["data.root=x", "experiment=cpu_small"], False),  # which chooses it itself
        (["data.root=x", "experiment=paper_forward"], False),
        (["data.root=x", "experiment=quickstart"], True),
        (["data.root=x", "experiment=peer_small"], True),
        (["data.root=x", "experiment=nonsense"], True),
        (["data.root=x", "data=nerfstudio"], False),
        (["data=inward"], False),
        ([], False),
    ],
)
def test_when_it_is_chosen(arguments: list[str], chosen: bool) -> None:
    found = with_data_choice(arguments)
    assert sorted(found) == sorted(arguments + ["data=auto"] * chosen)
    if chosen:  # beside the folder: Hydra takes all overrides from one place
        assert re.match(r"\+*data\.root=", found[found.index("data=auto") + 1])


def test_it_has_the_options_of_all_readers() -> None:
    options = {field.name for reader in READERS for field in fields(reader)}
    auto = OmegaConf.load(config_folder() / "data" / "auto.yaml")
    assert {str(key) for key in auto} - {"_target_"} == options
    # null stands for the reader's own default.
    assert all(auto._get_node(key)._value() is None for key in options - {"root", "flow_cache"})


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Path:
    """Three frames by two views, in DeVRF's layout."""
    root = tmp_path_factory.mktemp("auto") / "walker"
    sizes = {"width": 32, "height": 24, "static_views": 5, "static_test_views": 1}
    export(ProceduralScene(shape="robot", train_views=2, frames=3, supersample=1, **sizes)(), root)
    return root


def test_the_options_of_the_reader_reach_it(devrf, tmp_path, moving, short):
    options = ("data.downscale=2", "data.train_views=1", "data.frames=2", "data.name=w")
    done = devrf(f"data.root={moving}", *options, *short, "stage=canonical")
    assert (done.status, done.err) == (0, "")
    stored = OmegaConf.load(tmp_path / "outputs/w/quickstart/checkpoints/config.yaml").data
    assert stored._target_ == "devrf.data.recorded.InwardFacingDataModule"
    assert (stored.downscale, stored.train_views, stored.frames) == (2, 1, 2)
    assert (stored.background, stored.bound_scale) == ("white", "auto")
    assert str(stored.flow_cache).endswith("flow.npz")
    # The same run, whichever way its reader is named.
    again = devrf(f"data.root={moving}", "data=inward", *options, *short, "stage=canonical")
    assert "canonical: learned already" in again.out


def test_an_experiment_and_a_sweep_take_what_is_found(devrf, tmp_path, moving, short, balls_root):
    roots = f"data.root={moving},{balls_root}"
    done = devrf("-m", "experiment=cpu_small", roots, "stage=inspect", "hydra.sweep.dir=s", *short)
    assert (done.status, done.err) == (0, "")
    assert {path.name for path in (tmp_path / "s").iterdir() if path.name[0].isdigit()} == {
        "0_walker",
        "1_still",
    }
    assert (
        "32 x 24" in done.out
        and "images keep their size, although data.downscale=up_to_4" in done.out
    )
    assert "(data=inward)" in done.out and "(data=nerfstudio)" in done.out


@pytest.fixture
def balls_root(tmp_path, moving) -> Path:
    """The static images of the moving scene, in nerfstudio's layout."""
    root = tmp_path / "still"
    root.mkdir()
    content = json.loads((moving / "static/transforms_train.json").read_text())
    (root / "images").symlink_to(moving / "static/train")
    for frame in content["frames"]:
        frame["file_path"] = f"images/{Path(frame['file_path']).name}"
    (root / "transforms.json").write_text(json.dumps(content))
    return root


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["data.test_view=2"], "data.test_view: {root} is read by data=inward, which takes root, "),
        (["data.downscael=2"], "data.downscael: no such key; did you mean data.downscale?"),
        (["data.downscale=0"], "data.downscale: expected a whole number of at least 1, or up_to_"),
        (["data.frames=1"], "data.frames: should be greater than or equal to 2"),
        (["data.root=empty"], "{here}/empty: no known layout (DyCheck: no splits/train.json"),
        (["data.root=nowhere"], "{here}/nowhere: no such folder"),
        (["stage=prepare"], "stage=prepare: writes an embedded scene"),
    ],
)
def test_mistakes(devrf, tmp_path, moving, arguments, said):
    (tmp_path / "empty").mkdir()
    root = [] if arguments[0].startswith("data.root") else [f"data.root={moving}"]
    done = devrf(*root, *arguments)
    said = (
        said.format(root=moving, here="").replace("/empty", "empty").replace("/nowhere", "nowhere")
    )
    assert done.status == 2 and done.err.startswith(f"devrf: {said}"), done.err
    assert len(done.err.splitlines()) == 1 and not (tmp_path / "outputs").exists()


def test_its_folder_is_required(devrf):
    assert devrf("data=auto").err == "devrf: data.root: required; give data.root=PATH\n"
