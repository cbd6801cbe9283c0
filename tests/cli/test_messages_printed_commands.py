"""What is printed to be typed works when it is typed, whatever the names of files are."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from devrf.cli.complete import completed
from devrf.cli.config import command_line
from devrf.cli.restore_config import parsed, value, values
from devrf.errors import DevrfError
from devrf.system.override import to_type

PARSER = OverridesParser.create()
TEXT = st.characters(exclude_categories=["Cs", "Cc"]) | st.sampled_from("\\\"'a1.e/ ,[]{}()=:$~+-")

# As phones, people, recorders and other programs name files.
NAMES = ["left (1)", "left, near", "it's", "a,b", "scene[1]", "x=y", "{a: 1}", 'a "b"', "#1; ls"]
NAMES += ["München", "two  spaces", "at 1.00\u202fPM", "$HOME `ls`", "back\\", "2026", "null"]
NAMES += ["!x", "חדר\u200e", "👩\u200d🚀"]
# Those that need most care, for what runs the program twice.
AWKWARD = ["left, near", "it's", 'a "b"', "$HOME `ls`", "at 1.00\u202fPM"]


@given(st.lists(st.text(TEXT, min_size=1).filter(str.strip), min_size=1, max_size=3))
def test_text_is_read_as_that_text(texts):
    for given_value in (texts, texts[0]):
        (word,) = shlex.split(to_type("a", given_value))
        read = PARSER.parse_override(word).value()
        assert read == given_value and type(read) is type(given_value)


def test_plain_words_stay_as_they_are():
    assert to_type("data.root", Path("/scenes/fox-2/a.b_c")) == "data.root=/scenes/fox-2/a.b_c"
    assert to_type("a", [1, 0.5, None, True, "b"]) == "'a=[1,0.5,null,true,b]'"
    assert to_type("a", ["b", Path("it's")]) == """'a=[b,"it'"'"'s"]'"""


# A place makes the situation in a folder of its own: what is typed, and what the printed words say.
Said = dict[str, str | list[str]]
Place = Callable[[Path, str], tuple[str, Said]]
SCENE = "transforms_train.json"


def put(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def a_file_of_a_scene(place: Path, name: str) -> tuple[str, Said]:
    file = put(Path(name, SCENE))
    return f"data.root={file}", {"data.root": name}


def a_part_of_a_scene(place: Path, name: str) -> tuple[str, Said]:
    put(Path(name, SCENE))
    Path(name, "images").mkdir()
    return f"data.root={name}/images", {"data.root": f"{place / name}"}


def a_folder_around_a_scene(place: Path, name: str) -> tuple[str, Said]:
    put(Path("around", name, SCENE))
    return "data.root=around", {"data.root": f"around/{name}"}


def photographs(place: Path, name: str) -> tuple[str, Said]:
    put(Path(name, "images/0.jpg"))
    into = {"capture.static": f"{name}/images", "capture.into": f"scenes/{name}"}
    return f"data.root=./{name}", into


def a_video(place: Path, name: str) -> tuple[str, Said]:
    file = put(Path(f"{name}.mp4"))
    return f"data.root={file}", {"capture.static": f"{file}", "capture.into": f"scenes/{name}"}


def videos(place: Path, name: str) -> tuple[str, Said]:
    files = [f"there/{name}{k}.mp4" for k in range(12)]  # the line is as long as it has to be
    for file in files:
        put(Path(file))
    first, *others = sorted(files)
    return "data.root=there", {"capture.static": first, "capture.views": others}


PLACES = [a_file_of_a_scene, a_part_of_a_scene, a_folder_around_a_scene]
PLACES += [photographs, a_video, videos]


SITUATIONS = [(a_file_of_a_scene, name) for name in NAMES]
SITUATIONS += [(place, name) for place in PLACES[1:] for name in AWKWARD]


def words_in(line: str) -> list[str]:
    """The words that a line says to type."""
    (words,) = re.findall(r"(?:; write|make a scene of it:) (.*?)(?:, or with .*)?$", line)
    return shlex.split(words)


@pytest.mark.parametrize(("place", "name"), SITUATIONS)
def test_the_words_of_a_line_are_read_as_the_names(tmp_path, monkeypatch, place: Place, name):
    monkeypatch.chdir(tmp_path)
    typed, said = place(tmp_path, name)
    with pytest.raises(DevrfError) as refusal:
        completed([typed])
    read = parsed(words_in(str(refusal.value)))
    assert {word.key_or_group: word.value() for word in read if word.key_or_group in said} == said


@pytest.mark.parametrize("place", PLACES)
def test_the_words_of_a_line_reach_the_config(devrf, tmp_path, monkeypatch, place: Place):
    monkeypatch.chdir(tmp_path)
    typed, said = place(tmp_path, "it's, a (1)")
    outcome = devrf(typed)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    composed = devrf(*words_in(outcome.err), "--cfg", "job")
    assert (composed.status, composed.err) == (0, "")
    config = OmegaConf.create(composed.out)
    assert {key: OmegaConf.select(config, key) for key in said} == said


@pytest.mark.parametrize("name", AWKWARD)
def test_the_words_of_another_way_do_too(devrf, tmp_path, name):
    (tmp_path / f"{name}.mp4").touch()
    line = devrf(f"data.root={name}.mp4").err
    (word,) = shlex.split(line.partition(", or with ")[2].partition(" in place of ")[0])
    assert PARSER.parse_override(word).value() == [f"{name}.mp4"]
    assert line.endswith(" in place of capture.static if things move\n")


@pytest.mark.parametrize("name", [name for name in NAMES if "=" not in name])
def test_a_folder_without_its_key_is_named_with_it(devrf, tmp_path, name):
    (tmp_path / "in" / name).mkdir(parents=True)
    (word,) = shlex.split(devrf(f"in/{name}").err.partition("did you mean ")[2].rstrip("?\n"))
    assert value(parsed(completed(["data=inward", word]).words), "data.root") == f"in/{name}"


@pytest.mark.parametrize(
    ("typed", "key", "read"),
    [
        ("data.name=a (1)", "data.name", "a (1)"),
        ("data.name=it's", "data.name", "it's"),
        ("capture.views=[it's (1).mp4, b.mp4]", "capture.views", ["it's (1).mp4", "b.mp4"]),
        ("data.name=a, it's", "data.name", "a, it's"),
    ],
)
def test_a_value_that_is_not_understood_is_printed_as_it_may_be_typed(devrf, typed, key, read):
    outcome = devrf("data=inward", typed)
    assert outcome.status == 2 and outcome.err.startswith(f"devrf: {typed}: ")
    assert outcome.err.count("\n") == 1
    (word,) = re.findall(r"write (.*?)(?:, else see .*|, as a list .*)?$", outcome.err)
    composed = devrf("data=inward", *shlex.split(word), "--cfg", "job")
    assert OmegaConf.select(OmegaConf.create(composed.out), key) == read


def test_a_command_that_goes_on_names_the_present_run(devrf, tmp_path):
    place = tmp_path / "it's, a (1)"
    command = command_line("stage=view", to_type("hydra.run.dir", place))
    assert command.startswith("python -m devrf stage=view ")
    composed = devrf(*shlex.split(command)[3:], "--cfg", "hydra")
    assert OmegaConf.create(composed.out).hydra.run.dir == str(place)


def test_a_run_ends_with_commands_that_work(devrf, tiny_data, short, tmp_path):
    root, run = "it's, a\u202f👩\u200d🚀", "outputs/it's, a (1)"
    assert devrf(*tiny_data, "stage=prepare", f'prepare.into="{root}"').status == 0
    quick = (*short, "evaluation.metrics=[]", "video.frames=1")
    done = devrf(f"data.root={root}", *quick, f'hydra.run.dir="{run}"')
    assert (done.status, done.err) == (0, "")
    still, view, report = re.findall("  python -m devrf (.*)", done.out)
    shown = devrf(*shlex.split(still))
    assert (shown.status, shown.err) == (0, "")
    (learned,) = re.findall("as it was learned, with (.*)", shown.out)
    assert value(parsed(shlex.split(learned)), "data.root") == str(tmp_path / root)
    assert value(parsed(shlex.split(view)), "hydra.run.dir") == run
    assert report == "stage=report"
    # Beside outputs/, where a report looks.
    done = devrf(*tiny_data, *quick, "hydra.run.dir=runs/one")
    assert "  python -m devrf stage=report report.runs=runs\n" in done.out + "\n"


# Commas in paths


def test_a_comma_belongs_to_a_name_that_is_there(devrf, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("a,b", "a", "c"):
        put(Path(folder, SCENE))
    for typed in ("data.root=a,b", "data.root='a,b'", f"data.root={tmp_path}/a,b"):
        (root, *_) = completed([typed]).words
        assert str(PARSER.parse_override(root).value()).endswith("a,b")
    words = completed(["-m", "data.root=a,c"]).words[1:]
    assert values(parsed(words), "data.root") == ["a", "c"]
    outcome = devrf("data.root=a,c")
    assert outcome.status == 2 and "'data.root=a,c' 1. To use it as a list" in outcome.err


def test_a_name_that_no_config_can_hold_is_one_line(devrf, tmp_path):
    put(tmp_path / "${a}" / SCENE)
    outcome = devrf("data.root=${a}")
    assert outcome.err == (
        "devrf: ${a}: its name holds ${, where a config puts another key; rename it\n"
    )
    assert outcome.status == 2 and not (tmp_path / "outputs").exists()
