"""What documentation and workflows name exists: tests, files, links, anchors, commands, keys."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from omegaconf import OmegaConf

from devrf.cli.complete import completed
from devrf.cli.config import config_folder, group_choices, known_stages
from devrf.cli.config_check import check_config

REPOSITORY = Path(__file__).parents[2]
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"]
PAGES += sorted((REPOSITORY / "docs").rglob("*.md"))
# What continuous integration runs; a source distribution has none of it.
SCRIPTS = [*sorted((REPOSITORY / ".github/workflows").glob("*.yml")), REPOSITORY / ".ci/run"]
SCRIPTS = [script for script in SCRIPTS if script.is_file()]
# What else says commands: the help, and comments, docstrings among them.
TOLD = [REPOSITORY / "Makefile", REPOSITORY / "benchmarks" / "README.md"]
TOLD += [REPOSITORY / "conf" / "hydra" / "help" / "devrf.yaml"]
COMMENTED = sorted((REPOSITORY / "conf").rglob("*.yaml"))
COMMENTED += sorted((REPOSITORY / "src").rglob("*.py"))
COMMENTED += sorted((REPOSITORY / "benchmarks").glob("*.py"))

SPAN = re.compile(r"`([^`\n]+)`")
TEST = re.compile(r"(tests/[\w/]+\.py)(?:::(\w+))?")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)")
EQUATION = re.compile(r"\\\((.+?)\\\)|\\\[(.+?)\\\]", re.S)
# `python -m devrf`, or the installed program: VENV/bin/devrf.
ARGUMENT = r"['\"]?\+{0,2}[\w./]+=[^\s`]+"
COMMAND = re.compile(rf"(?:python -m |/bin/)devrf\"? ((?:-m )?{ARGUMENT}(?: {ARGUMENT})*)")
COMMENT = re.compile(r'"""(.*?)"""|# ([^\n]*)', re.DOTALL)
# In a comment: arguments alone, without what ends the sentence.
SETTING = r"'?[a-z_][\w./]*=[^\s`\"]*[^\s`\".,:;)]"
SETTINGS = re.compile(rf"(?<![\w.])((?:-m )?{SETTING}(?: {SETTING})*)")
PLACEHOLDER = re.compile("NAME|CHOICE|PROTOCOL|FILE|hparams_search|stiff_small|=(choice|option|…)$")
MAKE = re.compile(r"(?:^ *|[`&;] ?)make ((?:[a-z-]+ ?)+)", re.MULTILINE)
GROUPS = "callbacks|data|evaluation|export|field|sampling|schedule|still|video|viewer"
KEY = re.compile(rf"([a-z_]+(?:\.[a-z_]+)+)=|^((?:{GROUPS})(?:\.[a-z_]+)+)$")
ROOTS = ("src/", "conf/", "tests/", "docs/", "notebooks/", "benchmarks/")
PACKAGE = REPOSITORY / "src" / "devrf"
CHOICES = [f"data={name}" for name in ("procedural", "procedural_forward", "inward", "forward")]
CHOICES += ["data=nerfstudio", "data=nerfies", "data=neural_3d_video"]
CHOICES += ["logger=wandb", "method=nerfies", "method=nsff", "method=hypernerf"]
CHOICES += ["method=dnerf", "method=neural_volumes", "method=tineuvox", "method=kplanes"]
CHOICES += ["method=gaussians"]


def shell(file: Path) -> str:
    """A file's text; of a workflow what its steps run. A command is on one line.

    A command that is shown with the error that it ends in is left out.
    """
    text = file.read_text()
    if file.suffix == ".yml":
        jobs = yaml.safe_load(text)["jobs"].values()
        text = "\n".join(step.get("run", "") for job in jobs for step in job["steps"])
    return re.sub(r"\\\n\s*|\$ .*\ndevrf: .*", "", text)


def commands() -> list[str]:
    """Those without a placeholder or a package of one's own; of several that set the same, one."""
    different: dict[frozenset[str], str] = {}
    texts = [shell(file) for file in [*PAGES, *SCRIPTS, *TOLD]]
    written = [command for text in texts for command in COMMAND.findall(text)]
    written += [words for words in in_comments() if " " in words]
    for command in written:
        if not PLACEHOLDER.search(command):
            words = (re.sub(r"(.*\..*)=.*", r"\1", word) for word in command.split())
            different.setdefault(frozenset(words), command)
    return sorted(different.values())


def in_comments() -> list[str]:
    """Arguments in comments whose keys are groups or keys of the config: a command, or a part."""
    known = {*group_choices(), *OmegaConf.load(config_folder() / "config.yaml")}
    comments = [words for file in COMMENTED for words in COMMENT.findall(file.read_text())]
    written = [found for words in comments for found in SETTINGS.findall(" ".join(words))]
    keys = re.compile(rf"(?:(?:-m|'?(?:{'|'.join(sorted(known))})[.=]\S*)(?: |$))+")
    return [arguments for arguments in written if keys.fullmatch(arguments)]


def spans(page: Path) -> list[str]:
    return SPAN.findall(re.sub(r"```.*?```", "", page.read_text(), flags=re.S))


def test_tests_files_and_links_exist():
    for page in PAGES:
        for file, name in TEST.findall(page.read_text()):
            source = (REPOSITORY / file).read_text()
            assert not name or f"def {name}(" in source, f"{page.name}: {file} has no {name}"
        paths = [s for s in spans(page) if re.fullmatch(r"[\w./]+(\.\w+|/)", s) and "/" in s]
        named = [s for s in paths if s.startswith(ROOTS) or (PACKAGE / s.split("/")[0]).is_dir()]
        missing = [s for s in named if "NAME" not in s and not (REPOSITORY / s).exists()]
        assert not [s for s in missing if not (PACKAGE / s).exists()], page.name
        links = LINK.findall(page.read_text())
        assert not [link for link in links if not (page.parent / link).exists()], page.name


def test_docstrings_cite_anchors_of_the_method():
    anchors = re.findall(r"\{ #([\w-]+) \}", (REPOSITORY / "docs" / "method.md").read_text())
    assert len(anchors) == len(set(anchors))
    for source in PACKAGE.rglob("*.py"):
        cited = re.findall(r"docs/method\.md#([\w-]+)", source.read_text())
        assert set(cited) <= set(anchors), source


def words_of(command: str) -> dict[str, str]:
    """The command's arguments by key; of the values of a sweep the first, of a path ``scene``."""
    words = [word if "[" in word else word.split(",")[0] for word in shlex.split(command)]
    paths = r"=(PATH|FOLDER|…|mine|scenes/fox)$"
    words = [re.sub(paths, "=scene", word) for word in words if word != "-m"]
    return {word.partition("=")[0].lstrip("+~"): word for word in words}


def batches() -> list[list[dict[str, str]]]:
    """Commands that choose the same options and give no key two values: one config shows them."""
    found: dict[object, list[list[dict[str, str]]]] = {}
    for words in map(words_of, commands()):
        chosen = frozenset(word for key, word in words.items() if key in group_choices())
        known = found.setdefault((chosen, "data.root" in words), [])
        for batch in known:
            if not any(conflict(words, other) for other in batch):
                batch.append(words)
                break
        else:
            known.append([words])
    return [batch for known in found.values() for batch in known]


def conflict(words: dict[str, str], others: dict[str, str]) -> bool:
    """Whether one sets what the other sets otherwise, or a part of it; all may have a stage."""

    def overlap(key: str, other: str) -> bool:
        return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")

    pairs = ((key, other) for key in words for other in others if key != "stage")
    return any(overlap(*pair) and words[pair[0]] != others[pair[1]] for pair in pairs)


@pytest.mark.parametrize("batch", batches())
def test_commands_compose(batch, composed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "transforms_train.json").touch()  # so that a layout is recognised
    for words in batch:
        assert words.get("stage", "stage=pipeline").partition("=")[2] in known_stages()
    words = [word for words in batch for word in completed(list(words.values())).words]
    check_config(composed(*dict.fromkeys(words)))


def test_workflows_fit_githubs_schema(tmp_path):
    workflows = [file for file in SCRIPTS if file.suffix == ".yml"]
    if not workflows:
        pytest.skip("a source distribution has none")
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema"]
    command.append("vendor.github-workflows")
    done = subprocess.run([*command, *workflows], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    misspelt = tmp_path / "ci.yml"
    misspelt.write_text(workflows[0].read_text().replace("runs-on:", "run-on:"))
    done = subprocess.run([*command, misspelt], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "'runs-on' is a required property" in done.stdout


def test_workflows_run_actions_by_their_commits_and_few_may_write():
    for file in SCRIPTS:
        if file.suffix != ".yml":
            continue
        assert re.findall(r"uses: (.*)", file.read_text()) == re.findall(
            r"uses: ([\w/-]+@[0-9a-f]{40} # v[\d.]+)\n", file.read_text()
        )
        workflow = yaml.safe_load(file.read_text())
        assert workflow["permissions"] == {"contents": "read"}
        for job in workflow["jobs"].values():
            for step in job["steps"]:
                if step.get("uses", "").startswith("actions/checkout@"):
                    assert step["with"]["persist-credentials"] is False
                    assert "permissions" not in job  # what is checked out is run


def test_options_that_comments_name_exist():
    groups = {**group_choices(), "stage": known_stages()}
    words = [word for text in in_comments() for word in text.split()]
    words = [word for word in words if "=" in word and not PLACEHOLDER.search(word)]
    named = [(key, value.split(",")) for key, value in (word.split("=", 1) for word in words)]
    options = [(key, option) for key, values in named if key in groups for option in values]
    assert len(options) > 50
    missing = [(group, option) for group, option in options if option not in groups[group]]
    plugins = {("hydra/launcher", "joblib")}
    assert set(missing) <= {("viewer", "true"), ("viewer", "false"), *plugins}


@pytest.mark.parametrize("file", [*SCRIPTS, *PAGES[:2]], ids=lambda file: file.name)
def test_targets_of_make_exist(file):
    known = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    typed = [name for names in MAKE.findall(shell(file)) for name in names.split()]
    assert not set(typed) - set(known)


def test_keys_exist(composed):
    configs = [OmegaConf.to_container(composed(choice), resolve=False) for choice in CHOICES]
    known = {key for config in configs for key in dotted(config)}
    for page in PAGES:
        keys = {a or b for span in spans(page) for a, b in KEY.findall(span)}
        assert {key for key in keys if not key.startswith("hydra.")} <= known, page.name


def dotted(value: object, prefix: str = "") -> Iterator[str]:
    """The keys of nested mappings, from the root."""
    yield prefix.removesuffix(".")
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from dotted(inner, f"{prefix}{key}.")


def test_generated_tables_hold_every_choice():
    hook = load_hook("configuration")
    page = hook.reference()
    for path in sorted(hook.CONF.glob("*/**/*.y*ml")):
        assert hook.header(path), f"{path} does not begin with a comment that says what it is"
    for group, names in group_choices().items():
        assert group in hook.INTERNAL or all(f"`{name}`" in page for name in names)
    assert "| `seed` | `0` |" in page


def test_equations_become_mathml():
    hook = load_hook("equations")
    for page in sorted((REPOSITORY / "docs").rglob("*.md")):
        for line, display in EQUATION.findall(page.read_text()):
            # What the converter does not know stays a backslash with its name.
            mathml = hook.convert(line or display)
            assert mathml.startswith("<math") and "\\" not in mathml, line or display


def test_architecture_names_every_package():
    page = (REPOSITORY / "docs" / "architecture.md").read_text()
    packages = {init.parent.relative_to(PACKAGE) for init in PACKAGE.rglob("__init__.py")}
    assert not [str(name) for name in sorted(packages - {Path()}) if f"`{name}/`" not in page]


def test_packages_are_drawn_above_what_they_import():
    hook = load_hook("packages")
    edges = {"a": {"b", "c"}, "b": {"c"}, "c": set(), "d": {"c"}}
    assert hook.rows(edges) == [["a"], ["b", "d"], ["c"]]
    assert hook.reduced(edges)["a"] == {"b"}


def load_hook(name: str) -> ModuleType:
    path = REPOSITORY / "docs" / "hooks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"docs_hook_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
