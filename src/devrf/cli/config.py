"""The configuration: folder and resolvers, the stages' names, and the present Hydra job."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from devrf.apps.settings import ReportSettings
from devrf.cli.config_source import read_fast

# A value that is another key's.
REFERENCE = re.compile(r"\$\{([\w.]+)\}")
PIPELINE = "pipeline"
# A sweep's config, with what was typed: in its folder.
SWEEP_RECORD = "multirun.yaml"
# Stages for which the run's scene need not be right.
SCENELESS_STAGES = ("report", "fetch", "capture", "selfcheck")
# Stages that learn nothing; the protocol's stages come beside these.
STEPS = ("prepare", "inspect", "evaluate", "render", "still", "view", "export", *SCENELESS_STAGES)
# Those of them that use a checkpoint.
OF_A_CHECKPOINT = ("evaluate", "render", "still", "view", "export")
# Keys whose values are files or folders.
PATHS = {
    *("data.root", "prepare.into", "data.flow_cache", "ckpt", "fetch.into", "export.into"),
    *("capture.static", "capture.into", "capture.masks", "capture.alpha_masks", "video.path"),
    *("report.runs", "report.into", "fetch.catalogue", "evaluation.lpips_weights"),
    *("evaluation.predictions", "evaluation.motion_masks", "outputs"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}


def config_folder() -> Path:
    """The folder ``conf/``: inside an installed package, else beside ``src/`` in a checkout."""
    installed = Path(__file__).parents[1] / "conf"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "conf"


@cache
def group_choices() -> Mapping[str, Sequence[str]]:
    """The names that each ``group=NAME`` takes."""
    names: dict[str, list[str]] = {}
    folder = config_folder()
    for path in sorted(folder.glob("*/**/*.yaml")):
        group = path.parent.relative_to(folder)
        names.setdefault(group.as_posix(), []).append(path.stem)
    return names


def known_stages() -> list[str]:
    """Every stage there is, of all protocols."""
    files = sorted((config_folder() / "protocol").glob("*.yaml"), reverse=True)
    learning = [stage for file in files for stage in OmegaConf.load(file).stages]
    return [PIPELINE, *dict.fromkeys(learning), *STEPS]


def scene_name(config: DictConfig) -> str:
    """The scene's name for folders and tables: typed, that of its data, else its folder's."""
    data = config.data
    root = "scene" if OmegaConf.is_missing(data, "root") else str(data.get("root"))
    named = config.scene or data.get("name") or data.get("shape") or Path(root).resolve().name
    return scene_folder_name(str(named))


def scene_folder_name(scene: str) -> str:
    """A scene's name as a folder may be called."""
    return re.sub(r"[^\w.-]+", "_", scene).lstrip(".") or "scene"


def foreign_program(config: Any) -> str:
    """The name of the program whose pictures are scored: given, or that of their folder."""
    return str(config.evaluation.program or Path(config.evaluation.predictions).resolve().name)


def run_folder(_root_: Any) -> str:
    """A run's folder; for a report, the report's.

    It is named after scene and experiment, and the choices that are not the usual ones. Without an
    experiment DeVRF learns as by ``experiment=quickstart``: they are one run. Each trial of
    ``wandb agent`` is one of its own, named after sweep and trial.
    """
    stage = _root_.stage
    outputs = _root_.outputs
    report = _root_.report
    options = _root_.hydra.runtime.choices
    if stage in ("fetch", "selfcheck"):
        return f"{outputs}/{stage}"
    if stage == "capture":
        into = Path(str(_root_.capture.into or "scene"))
        return f"{outputs}/{scene_folder_name(into.name)}/capture"
    if stage == "report":
        # A misspelt folder is not created: the step reports that there is none.
        runs = report.runs if Path(str(report.runs)).is_dir() else outputs
        return str(ReportSettings(runs, report.into).folder)
    trial = [os.environ.get(name) for name in ("WANDB_SWEEP_ID", "WANDB_RUN_ID")]
    if all(trial):
        return "/".join([outputs, "sweeps", *map(str, trial)])
    if stage == "evaluate" and _root_.evaluation.predictions is not None:
        program = scene_folder_name(foreign_program(_root_))
        return f"{outputs}/{scene_name(_root_)}/{program}-pictures"
    parts = [options.experiment or "quickstart"]
    if options.ablation not in (None, "full"):
        parts.append(options.ablation)
    if (options.method, options.protocol) != ("devrf", "two_stage"):
        parts += [options.method, options.protocol]
    if _root_.rehearse:
        parts.append("rehearsal")
    return f"{outputs}/{scene_name(_root_)}/{'-'.join(parts)}"


def job_folder(_root_: Any) -> str:
    """The folder of a sweep's job: number, scene, and varied values: ``0_robot_tv_0.5``."""
    hydra = _root_.hydra
    typed = OmegaConf.load(Path(hydra.sweep.dir) / SWEEP_RECORD).hydra.overrides.task
    parsed = OverridesParser.create().parse_overrides(list(typed))
    # What the sweeper chooses, whichever it is, is all that is not the same in each job.
    varied = {word.get_key_element(): word.is_sweep_override() for word in parsed}
    varied |= dict.fromkeys(("data", "data.root", "data.name", "data.shape"), False)
    pairs = [override.partition("=") for override in hydra.overrides.task]
    words = [f"{key.rpartition('.')[2]}_{v}" for key, _, v in pairs if varied.get(key, True)]
    name = "_".join([str(hydra.job.num), scene_name(_root_), *words])
    # Of a search's numbers, four digits.
    name = re.sub(r"\d*\.\d{5,}(e-?\d+)?", lambda number: f"{float(number[0]):.4g}", name)
    return scene_folder_name(name)[:150]


def output_dir() -> str:
    """The present job's folder; outside Hydra ``outputs``, until ``run_stage`` is given one."""
    config: Any = HydraConfig.instance().cfg or DictConfig({})
    return str(OmegaConf.select(config, "hydra.runtime.output_dir", default="outputs"))


def choice(group: str) -> str | None:
    """The present job's option of a config group; None where there is none, and outside Hydra."""
    return choices().get(group)


# For ``${devrf.run_folder:}`` in a config.
for _word in (run_folder, job_folder, output_dir, choice):
    OmegaConf.register_new_resolver(f"devrf.{_word.__name__}", _word, replace=True)
read_fast(config_folder())


def command_line(*words: str) -> str:
    """A command of ``words`` to type next; the present one's own folders of configs come again.

    Words with paths come from :func:`devrf.system.override.to_type`.
    """
    return " ".join(["python", "-m", "devrf", *map(shlex.quote, own_folders()), *words])


def own_folders() -> list[str]:
    """The words of the present command that name further folders of configs."""
    if not HydraConfig.initialized():
        return []
    job = HydraConfig.get()
    folders = [s.path for s in job.runtime.config_sources if s.provider == "command-line"]
    words = [word for folder in folders for word in ("--config-dir", folder)]
    return [*words, *(w for w in job.overrides.hydra if w.startswith("hydra.searchpath="))]


def choices() -> dict[str, str | None]:
    """The present job's option of each config group, without Hydra's own; empty outside Hydra."""
    if not HydraConfig.initialized():
        return {}
    options = HydraConfig.get().runtime.choices
    return {str(k): v for k, v in options.items() if not str(k).startswith("hydra/")}


def overrides() -> list[str]:
    """The present job's overrides, without Hydra's own; empty outside Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def in_sweep() -> bool:
    """Whether the present job is one of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def stage_section(config: DictConfig, stage: str) -> str:
    """The section of the config that says how a stage is built: its own, or of any ray stage."""
    return stage if stage in config else "ray_stage"


def set_at(config: DictConfig, names: Sequence[Any]) -> str:
    """The key at which the user sets a value: a reference on the way leads to another one.

    Names that a section does not have are passed over: of an item of a list, of a type.
    """
    node: Any = config
    for name in names:
        if isinstance(node, DictConfig) and name in node:
            raw: Any = node._get_node(name)
            node = raw._maybe_dereference_node()
    return str(node._get_full_key(None))


def leaves(config: DictConfig, key: str) -> dict[tuple[str, ...], Any]:
    """The plain values at and below a key, resolved, by the names that lead to them."""
    value = OmegaConf.select(config, key)
    plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    return dict(_flat(plain, tuple(key.split("."))))


def _flat(value: Any, names: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if not isinstance(value, Mapping):
        yield names, value
        return
    for name, below in value.items():
        yield from _flat(below, (*names, str(name)))
