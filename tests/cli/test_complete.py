"""What was typed is completed: paths, the run that is named, the experiment's form, the reader."""

from __future__ import annotations

import json
import shlex
import subprocess
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from devrf.cli.complete import PATHS, completed
from devrf.cli.config import config_folder
from devrf.cli.main import candidates
from devrf.cli.messages import in_quotes
from devrf.scenes.export import export
from devrf.scenes.formats import LAYOUTS
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene

PARSER = OverridesParser.create()


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1).filter(str.strip))
def test_text_in_quotes_is_read_as_that_text(text):
    assert PARSER.parse_override(f"a={in_quotes(text)}").value() == text


@pytest.mark.parametrize("key", ["data.root", "+data.root", "report.runs"])
@pytest.mark.parametrize("path", ["/my scenes/fox [1]", "München (2)", "a=b", 'a "b"', "2026"])
def test_a_path_is_taken_as_it_is_typed(key, path):
    argument = completed(["data=inward", f"{key}={path}"])[-1]
    assert PARSER.parse_override(argument).value() == path


def test_the_home_folder_is_filled_in(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ä b")
    several = completed(["-m", "data=inward", "data.root=~/a,~/b"])[-1]
    read = [path.text for path in PARSER.parse_override(several).value().list]
    assert read == ["/home/ä b/a", "/home/ä b/b"]


def test_the_rest_is_left_to_hydra():
    for argument in ("report.runs=/a/b c", "ckpt=null", "seed=1,2", "--help", "x=[", "viewer=1"):
        assert completed([argument]) == [argument]
    assert completed(["viewer=True"]) == ["viewer.training=true"]


def test_the_line_prints_what_to_type(devrf):
    for typed, quoted in (
        ("data.name=a (1)", "'data.name=\"a (1)\"'"),
        ("data.root=a,b", "'data.root=\"a,b\"'"),
    ):
        outcome = devrf("data=inward", typed)
        assert outcome.status == 2 and outcome.err.count("\n") == 1
        assert quoted in outcome.err
        (argument,) = shlex.split(quoted)
        assert PARSER.parse_override(argument).value() == typed.partition("=")[2]


def test_the_keys_of_paths_exist(devrf):
    scenes = (["data=inward", "data.root=x"], ["data=procedural"])
    configs = [OmegaConf.create(devrf(*scene, "--cfg", "all").out) for scene in scenes]
    for key in PATHS:
        parent, _, name = key.rpartition(".")
        nodes = [OmegaConf.select(one, parent) if parent else one for one in configs]
        assert any(name in node for node in nodes), key


# The form of an experiment, and the reader of a scene


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
    return folder


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("experiment=paper data=lego", "experiment=paper_lego data=lego"),
        ("experiment=paper_lego data.root=x", "experiment=paper_lego data.root=x"),
        ("data=inward experiment=paper seed=1", "data=inward experiment=paper_inward seed=1"),
        ("experiment=paper data=colmap", "experiment=paper_inward data=colmap"),
        ("-m experiment=paper data=lego,plant", "-m experiment=paper_lego,paper_plant"),
        (
            "-m experiment=paper_lego,paper_plant data.root=x seed=1",
            "-m experiment=paper_lego,paper_plant ++data.root=x seed=1",
        ),
        ("experiment=fast data=rabbit", "experiment=fast_forward data=rabbit"),
        ("experiment=best data=neural_3d_video", "experiment=best_forward data=neural_3d_video"),
        ("experiment=best_small data=flower", "experiment=best_small_embedded data=flower"),
        ("experiment=best_small data=inward", "experiment=best_small data=inward"),
        (
            "experiment=best_small data=procedural_forward",
            "experiment=best_small_forward data=procedural_forward",
        ),
        ("experiment=best_small data.root=walker", "experiment=best_small data.root=walker"),
        ("experiment=best_small data.root=wall", "experiment=best_small_forward data.root=wall"),
        ("experiment=paper data.root=wall", "experiment=paper_forward data.root=wall"),
        ("experiment=cpu_small data.root=walker", "experiment=cpu_small data.root=walker"),
        ("experiment=cpu_small data.root=wall", "experiment=cpu_small_forward data.root=wall"),
        ("experiment=cpu_small data=flower", "experiment=cpu_small_embedded data=flower"),
        # What a folder's files say counts, not the reader alone.
        ("experiment=best data.root=phone", "experiment=best_forward data.root=phone"),
        ("data.root=phone seed=1", "data.root=phone seed=1 experiment=best_small_forward"),
        ("data.root=hook method=dnerf", "data=auto data.root=hook method=dnerf protocol=dynamic"),
        ("data.root=hook method=devrf", "data=auto data.root=hook method=devrf"),
        ("data.root=wall method=dnerf", "data=auto data.root=wall method=dnerf"),
        # Where no experiment says how DeVRF learns, the scene's facing does.
        ("data.root=wall facing=inward", "data=auto data.root=wall facing=inward"),
        (
            "data.root=wall facing=auto schedule=quick",
            "data=auto data.root=wall schedule=quick facing=forward",
        ),
        ("data=forward data.root=wall method=devrf", "data=forward data.root=wall method=devrf"),
        ("data.root=wall,walker method=nsff", "data=auto data.root=wall,walker method=nsff"),
        ("stage=report data.root=x", "data=auto stage=report data.root=x"),
        ("data.root=wall method=devrf", "data=auto data.root=wall method=devrf facing=forward"),
        (
            "experiment=comparison_table data.root=phone",
            "data=auto experiment=comparison_table data.root=phone facing=forward",
        ),
        (
            "experiment=comparison_table data.root=walker",
            "data=auto experiment=comparison_table data.root=walker",
        ),
        (
            "experiment=quickstart data.root=wall",
            "data=auto experiment=quickstart_forward data.root=wall",
        ),
        ("experiment=best_small", "experiment=best_small"),
        ("experiment=paper", "experiment=paper_inward"),
        ("experiment=cpu_small,best_small", "experiment=cpu_small,best_small"),
        ("experiment=quickstart data=lego", "experiment=quickstart data=lego"),
        (
            "experiment=best schedule.deformation.levels.6.parallel_frames=2",
            "experiment=best_inward ++schedule.deformation.levels.6.parallel_frames=2",
        ),
        # The reader.
        ("data.root=walker", "data=auto data.root=walker"),
        ("+data.root=walker seed=1", "data=auto +data.root=walker seed=1"),
        (
            "data.root=walker experiment=peer_small",
            "data=auto data.root=walker experiment=peer_small",
        ),
        ("data.root=x experiment=nonsense", "data=auto data.root=x experiment=nonsense"),
        ("data.root=walker data=nerfstudio", "data.root=walker data=nerfstudio"),
    ],
)
def test_the_form_for_the_scene_and_its_reader(scenes, monkeypatch, typed, meant):
    monkeypatch.chdir(scenes)
    assert completed(typed.split()) == meant.split()


def test_a_sweep_over_scenes_that_need_different_forms_is_refused(devrf, scenes):
    roots = f"data.root={scenes}/walker,{scenes}/wall"
    outcome = devrf("-m", "experiment=best_small", roots)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "experiment=best_small and experiment=best_small_forward" in outcome.err


@pytest.mark.parametrize("typed", [["experiment=comparison_table"], ["-m"]])
def test_devrf_learns_scenes_of_one_facing_in_a_sweep(devrf, scenes, typed):
    outcome = devrf(*typed, f"data.root={scenes}/walker,{scenes}/wall")
    assert outcome.status == 2 and outcome.err.startswith("devrf: data.root: DeVRF has other")
    assert outcome.err.count("\n") == 1


def test_data_auto_has_the_options_of_all_readers():
    auto = OmegaConf.load(config_folder() / "data" / "auto.yaml")
    options = set()
    for choice in {layout.choice for layout in LAYOUTS}:
        options |= set(OmegaConf.load(config_folder() / "data" / f"{choice}.yaml"))
    assert set(auto) == options - {"reader"}
    # null stands for the reader's own default.
    own = options - {"_target_", "reader", "root", "flow_cache"}
    assert all(auto._get_node(key)._value() is None for key in own)


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


def test_each_job_of_a_sweep_has_the_reader_of_its_scene(devrf, tmp_path, scenes, short):
    (still := tmp_path / "still").mkdir()
    content = json.loads((scenes / "walker/static/transforms_train.json").read_text())
    (still / "images").symlink_to(scenes / "walker/static/train")
    for frame in content["frames"]:
        frame["file_path"] = f"images/{Path(frame['file_path']).name}"
    (still / "transforms.json").write_text(json.dumps(content))
    sweep = ("experiment=cpu_small", f"data.root={scenes}/walker,{still}", "hydra.sweep.dir=s")
    done = devrf("-m", *sweep, "stage=inspect", *short)
    assert (done.status, done.err) == (0, "")
    assert {path.name for path in (tmp_path / "s").glob("*_*")} == {"0_walker", "1_still"}
    assert "(data=inward)" in done.out and "(data=nerfstudio)" in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["data.test_view=2"], "data.test_view: {root} is read by data=inward, which takes root, "),
        (["data.downscael=2"], "data.downscael: no such key; did you mean data.downscale?"),
        (["data.root=empty"], "empty: no known layout ("),
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
        ("devrf seed=1 stage=fe", "stage=fetch"),
        ("devrf stage=fetch scene=", "scene=fox"),
        ("devrf kernels=", "kernels=triton"),
        ("devrf resume=", "resume=true resume=false"),
        (
            "devrf export.content=",
            "export.content=auto export.content=surface export.content=points",
        ),
        ("devrf data.root=~/x data.flow=d", "data.flow=auto data.flow=files data.flow=dis"),
        ("devrf experiment=paper_l", "experiment=paper_lego"),
        ("devrf data=inward data.bound", "data.bound_scale="),
    ],
)
def test_the_shell_completes(typed, offered):
    assert set(offered.split()) <= set(candidates(typed))


def test_bash_completes_the_module_and_the_command(python, tmp_path):
    installed = python(tmp_path, "-m", "devrf", "-sc", "install=bash")
    assert installed.status == 0
    script = tmp_path / "complete.sh"
    script.write_text(
        installed.out
        + """
for line in "devrf stage=eval" "python -m devrf seed=1 stage=eval" "python other.py stage=eval"; do
    COMP_LINE="$line" COMP_WORDS=($line) COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    _devrf_complete
    echo "${COMPREPLY[@]}"
done
"""
    )
    done = subprocess.run(["bash", str(script)], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["stage=evaluate", "stage=evaluate", ""]
