"""Paths are taken as they are typed, whatever Hydra's grammar makes of them."""

from __future__ import annotations

import shlex
import subprocess

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from devrf.cli.arguments import PATHS, with_quoted_paths
from devrf.cli.completion import candidates
from devrf.cli.overrides import in_quotes

PARSER = OverridesParser.create()


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1).filter(str.strip))
def test_text_in_quotes_is_read_as_that_text(text):
    assert PARSER.parse_override(f"a={in_quotes(text)}").value() == text


@pytest.mark.parametrize(
    "path",
    ["/my scenes/fox [1]", "München (2)", "a=b", "x#y", "it's", 'a "b"', "2026", "[1]", "{a}"],
)
@pytest.mark.parametrize("key", ["data.root", "+data.root", "ckpt", "hydra.run.dir"])
def test_a_path_is_taken_as_it_is_typed(key, path):
    (argument,) = with_quoted_paths([f"{key}={path}"])
    assert PARSER.parse_override(argument).value() == path


def test_the_home_folder_is_filled_in(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ä b")
    home = [PARSER.parse_override(a).value() for a in with_quoted_paths(["report.runs=~/runs"])]
    assert home == ["/home/ä b/runs"]
    several = with_quoted_paths(["-m", "data.root=~/a,~/b"])[1]
    assert [one.text for one in PARSER.parse_override(several).value().list] == [
        "/home/ä b/a",
        "/home/ä b/b",
    ]


@pytest.mark.parametrize(
    "argument",
    ["data.root=/a/b c", "data.root=${ckpt}", "ckpt=null", "data.root=", "seed=1,2", "~data.root"],
)
def test_the_rest_is_left_to_hydra(argument):
    assert with_quoted_paths([argument]) == [argument]


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


def test_a_scene_in_a_folder_with_any_name(devrf, tmp_path, tiny):
    folder = tmp_path / "Käfer [1] (neu) =x"
    exported = devrf(*tiny, "stage=prepare", f"data.export={folder}", "hydra.run.dir=o [1]")
    assert (exported.status, exported.err) == (0, "")
    assert (tmp_path / "o [1]" / "run.log").is_file()
    read = devrf("data=inward", f"data.root={folder}", "stage=inspect", "trainer=cpu")
    assert (read.status, read.err) == (0, "")
    (run,) = tmp_path.glob("outputs/*/quickstart/images/inspect.png")
    assert run.is_file()


def test_the_keys_of_paths_exist(devrf):
    scenes = (["data=inward", "data.root=x"], ["data=procedural"])
    shown = [devrf(*scene, "--cfg", "all").out for scene in scenes]
    configs = [OmegaConf.create(out) for out in shown]
    for key in PATHS:
        parent, _, name = key.rpartition(".")
        nodes = [OmegaConf.select(one, parent) if parent else one for one in configs]
        assert any(name in node for node in nodes), key


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("devrf stage=", "stage=deformation"),
        ("devrf seed=1 stage=fe", "stage=fetch"),
        ("devrf stage=fetch scene=", "scene=fox"),
        ("devrf kernels=", "kernels=triton"),
        ("devrf resume=", "resume=false"),
        ("devrf exper", "experiment="),
        ("devrf data=", "data=nerfstudio"),
        ("devrf data=inward data.bound", "data.bound_scale="),
    ],
)
def test_the_shell_completes(typed, offered):
    assert offered in candidates(typed)


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
