"""What was typed is completed: paths, the run that is named, what the scene's files say."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from devrf.cli.complete import completed
from devrf.cli.config import PATHS
from devrf.errors import DevrfError
from devrf.evaluation.suite import Evaluation
from devrf.scenes.exchange import PrepareSettings
from devrf.scenes.export import export
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene

PARSER = OverridesParser.create()


@pytest.mark.parametrize("key", ["data.root", "+data.root", "report.runs"])
@pytest.mark.parametrize(
    "path", ["/my scenes/fox [1]", "München (2)", "a=b", 'a "b"', "2026", "a,b", "x, y"]
)
def test_a_path_is_taken_as_it_is_typed(tmp_path, monkeypatch, key, path):
    monkeypatch.chdir(tmp_path)
    if "," in path:  # else it separates two
        Path(path).mkdir()
    argument = completed(["data=inward", f"{key}={path}"]).words[-1]
    assert PARSER.parse_override(argument).value() == path


def test_the_home_folder_is_filled_in(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ä b")
    several = completed(["-m", "data=inward", "data.root=~/a,~/b"]).words[-1]
    read = [path.text for path in PARSER.parse_override(several).value().list]
    assert read == ["/home/ä b/a", "/home/ä b/b"]


def test_the_rest_is_left_to_hydra():
    for argument in ("report.runs=/a/b c", "ckpt=null", "seed=1,2", "--help", "x=["):
        assert completed([argument]).words == [argument]
    assert completed(["viewer=True"]).words == ["viewer.training=true"]


def test_options_that_are_paths_are_known_as_such():
    for section, settings in (("evaluation", Evaluation), ("prepare", PrepareSettings)):
        paths = {f"{section}.{option.name}" for option in fields(settings) if "Path" in option.type}
        assert paths and paths <= PATHS


def test_the_keys_of_paths_exist(devrf):
    scenes = (["data=inward", "data.root=x"], ["data=procedural"])
    configs = [OmegaConf.create(devrf(*scene, "--cfg", "all").out) for scene in scenes]
    for key in PATHS:
        parent, _, name = key.rpartition(".")
        nodes = [OmegaConf.select(one, parent) if parent else one for one in configs]
        assert any(name in node for node in nodes), key


# What the files of a scene say


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """``walker`` and ``wall``, an inward-facing and a forward-facing scene, in DeVRF's layout.

    ``phone`` is what ``stage=capture`` writes of photographs from one side, but for the images.
    """
    folder = tmp_path_factory.mktemp("scenes")
    size = {"width": 32, "height": 24, "static_views": 5, "train_views": 2, "frames": 3}
    export(ProceduralScene(static_test_views=1, supersample=1, **size)(), folder / "walker")
    size["static_views"] = 7
    export(ProceduralForwardScene(supersample=1, **size)(), folder / "wall")
    (folder / "phone").mkdir()
    frame = {"file_path": "0.jpg", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}
    content = {"frames": [frame], "scene_bounds": {"space": "ndc", "near": 1.0}}
    (folder / "phone/transforms.json").write_text(json.dumps(content))
    # As D-NeRF's: one camera, elsewhere in each image.
    (folder / "hook").mkdir()
    moved = [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]
    frames = [frame | {"time": 0}, frame | {"time": 1, "transform_matrix": moved}]
    (folder / "hook/transforms_train.json").write_text(json.dumps({"frames": frames}))
    # As stage=capture writes it of one video; ``stop`` is filmed at rest first.
    for name, first in (("walk", frames[:1]), ("stop", 3 * frames[:1])):
        (folder / name).mkdir()
        file = folder / name / "transforms.json"
        file.write_text(json.dumps({"frames": [*first, frames[1]]}))
    (folder / "video").mkdir()
    (folder / "video/precomputed.json").write_text("{}")
    # As HyperNeRF's; ``pose`` shows one moment.
    listing = {"ids": ["a", "b", "c"], "train_ids": ["a", "b"], "val_ids": ["c"]}
    for name, later in (("vrig", 1), ("pose", 0)):
        (folder / name).mkdir()
        moments = {"a": {"warp_id": 0}, "b": {"warp_id": later}, "c": {"warp_id": 0}}
        for file, content in (("dataset", listing), ("metadata", moments), ("scene", {})):
            (folder / name / f"{file}.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("typed", "by_files"),
    [
        # The reader, and what its own config says of the scene.
        ("data.root=walker", "data=inward"),
        ("+data.root=walker seed=1", "data=inward"),
        ("data.root=wall", "data=forward"),
        ("experiment=paper data.root=wall", "data=forward"),
        ("-m experiment=cpu_small,best_small data.root=walker", "data=inward"),
        ("-m method=devrf data.root=walker,hook", "data=inward"),
        ("data.root=walker experiment=nonsense", "data=inward"),
        # What is typed, or an experiment chooses, is not told again.
        ("data.root=walker data=nerfstudio", ""),
        ("data=lego data.root=x", ""),
        ("experiment=published_table data.root=wall", ""),
        ("experiment=published_table data.root=${data.name}", ""),
        ("data=colmap", ""),
        ("experiment=paper", ""),
        ("stage=report data.root=x", ""),
        # What only the files say.
        ("data.root=phone seed=1", "data=nerfstudio facing=forward"),
        ("data=nerfstudio data.root=phone", "facing=forward"),
        ("data.root=phone facing=inward", "data=nerfstudio"),
        ("data.root=phone data.space=world", "data=nerfstudio"),
        ("data=colmap data.root=gone data.space=ndc", "facing=forward"),
        ("experiment=comparison_table data.root=phone", "data=nerfstudio facing=forward"),
        ("data.root=stop", "data=nerfstudio"),
        ("data.root=pose", "data=nerfies"),
        # One camera that moves: what learns it is typed, or it is not learned.
        ("data.root=hook experiment=phone", "data=inward"),
        ("stage=inspect data.root=hook schedule.seconds=60", "data=inward"),
        ("data.root=hook data.static_until=0.3", "data=inward"),
        (
            "data.root=hook experiment=phone method=tineuvox profile=tineuvox_light",
            "data=inward protocol=dynamic",
        ),
        ("data.root=hook stage=canonical", "data=inward"),
        ("data.root=hook profile=devrf_small", "data=inward"),
        ("data.root=hook method=dnerf", "data=inward protocol=dynamic"),
        ("data.root=hook method=dnerf protocol=joint", "data=inward"),
        ("data.root=hook comparison=dnerf", "data=inward"),
        ("data.root=hook method=devrf", "data=inward"),
        ("data.root=walker method=dnerf", "data=inward"),
    ],
)
def test_what_the_files_of_a_scene_say_comes_after_what_was_typed(
    scenes, monkeypatch, typed, by_files
):
    monkeypatch.chdir(scenes)
    assert completed(typed.split()).words == [*typed.split(), *by_files.split()]


@pytest.mark.parametrize("place", ["--config-dir {}", "hydra.searchpath=[file://{}]"])
def test_an_experiment_in_a_folder_of_ones_own_chooses_the_reader(scenes, tmp_path, place):
    (tmp_path / "experiment").mkdir()
    chosen = "# @package _global_\ndefaults: [override /data: nerfstudio]\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(chosen)
    typed = [*place.format(tmp_path).split(), "experiment=mine", f"data.root={scenes}/walker"]
    assert completed(typed).words == typed


def test_what_the_files_say_is_said_in_one_line(devrf, scenes, short):
    done = devrf(f"data.root={scenes}/phone", *short, "stage=inspect")
    line = f"{scenes}/phone: the layout of nerfstudio, instant-ngp (data=nerfstudio facing=forward)"
    assert done.out.splitlines().count(line) == 1


@pytest.mark.parametrize("scene", ["hook", "walk", "video", "vrig"])
def test_what_learns_one_moving_camera_is_named_and_not_chosen(scenes, scene):
    lacks = "one moving camera, and nothing at rest, which method=devrf needs"
    line = f"{lacks}; give experiment=phone, on a GPU experiment=phone_gpu"
    with pytest.raises(DevrfError, match=f"{scene}: {line}$"):
        completed([f"data.root={scenes}/{scene}"])
    remarks = completed([f"data.root={scenes}/{scene}", "stage=inspect"]).remarks
    assert remarks[0].endswith(line)
    remarks = completed([f"data.root={scenes}/{scene}", "method=devrf"]).remarks
    assert remarks[0].endswith(f"{lacks}; experiment=phone learns more of it")


@pytest.mark.parametrize(
    ("other", "needed"),
    [
        ("wall", "data=inward and data=forward"),
        ("hook", "data=inward and data=inward protocol=dynamic"),
    ],
)
def test_a_sweep_over_scenes_that_need_different_options_is_refused(devrf, scenes, other, needed):
    outcome = devrf("-m", "method=dnerf", f"data.root={scenes}/walker,{scenes}/{other}")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: data.root: the scenes need {needed}; sweep over")


def test_the_options_of_the_reader_reach_it(devrf, tmp_path, scenes, short):
    options = ("data.downscale=2", "data.train_views=1", "data.frames=2", "data.name=w")
    root = f"data.root={scenes}/walker"
    done = devrf(root, *options, *short, "stage=canonical")
    assert (done.status, done.err) == (0, "")
    stored = OmegaConf.load(tmp_path / "outputs/w/quickstart/checkpoints/config.yaml").data
    assert (stored.downscale, stored.train_views, stored.frames) == (2, 1, 2)
    assert (stored.background, stored.bound_scale) == ("white", "auto")
    # The same run, whichever way its reader is named.
    again = devrf(root, "data=inward", *options, *short, "stage=canonical")
    assert "canonical: learned already" in again.out


def test_a_sweep_over_scenes_of_one_layout_has_their_reader(devrf, tmp_path, scenes, short):
    shutil.copytree(scenes / "walker", tmp_path / "a, b=c")
    roots = f"data.root={scenes}/walker,'{tmp_path}/a, b=c'"
    sweep = ("experiment=cpu_small", roots, "hydra.sweep.dir=s")
    done = devrf("-m", *sweep, "stage=inspect", *short)
    assert (done.status, done.err) == (0, "")
    assert {path.name for path in (tmp_path / "s").glob("*_*")} == {"0_walker", "1_a_b_c"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["data.holdout=2"], "data.holdout: no such key; it belongs to data=colmap, dycheck, "),
        (["data.downscael=2"], "data.downscael: no such key; did you mean data.downscale?"),
        (["data.root=empty"], "empty: no known layout: "),
        (["data.root=nowhere", "experiment=best_small"], "nowhere: no such folder"),
    ],
)
def test_mistakes_in_a_recognised_scene(devrf, tmp_path, scenes, arguments, said):
    (tmp_path / "empty").mkdir()
    root = [] if arguments[0].startswith("data.root") else [f"data.root={scenes}/walker"]
    done = devrf(*root, *arguments)
    said = said.format(root=scenes / "walker")
    assert done.status == 2 and done.err.startswith(f"devrf: {said}"), done.err
    assert len(done.err.splitlines()) == 1 and not (tmp_path / "outputs").exists()


# In the shell


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("devrf seed=1 sta", "stage="),
        ("devrf experiment=best_s", "experiment=best_small"),
        ("devrf for_scene=paper_l", "for_scene=paper_lego"),
        ("devrf data=inward data.bound", "data.bound_scale="),
    ],
)
def test_the_shell_completes_as_hydra_does(devrf, monkeypatch, typed, offered):
    monkeypatch.setenv("COMP_LINE", typed)
    outcome = devrf("-sc", "query=bash")
    assert (outcome.status, outcome.out.split()) == (0, [offered])
