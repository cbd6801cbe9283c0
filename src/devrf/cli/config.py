"""The configuration: folder and resolvers, the stages' names, and the present Hydra job."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import OmegaConf

from devrf.apps.settings import ReportSettings
from devrf.errors import DevrfError

PIPELINE = "pipeline"
# Stages for which the run's scene need not be right.
APART = ("report", "fetch", "capture", "selfcheck")
# Stages that learn nothing; the protocol's stages come beside these.
STEPS = ("prepare", "inspect", "evaluate", "render", "still", "view", "export", *APART)
# Of these, what uses a checkpoint.
OF_A_CHECKPOINT = ("evaluate", "render", "still", "view", "export")


def config_folder() -> Path:
    """The folder ``conf/``: inside an installed package, else beside ``src/`` in a checkout."""
    installed = Path(__file__).parents[1] / "conf"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "conf"


def group_choices() -> dict[str, list[str]]:
    """The names that each ``group=NAME`` takes."""
    names: dict[str, list[str]] = {}
    for path in sorted(config_folder().glob("*/**/*.yaml")):
        place = path.parent.relative_to(config_folder())
        names.setdefault(place.as_posix(), []).append(path.stem)
    return names


def known_stages() -> list[str]:
    """Every stage there is, of all protocols."""
    learning: dict[str, None] = {}  # in order, each once
    for path in sorted((config_folder() / "protocol").glob("*.yaml"), reverse=True):
        learning |= dict.fromkeys(OmegaConf.select(OmegaConf.load(path), "stages"))
    return [PIPELINE, *learning, *STEPS]


def scene_name(data: Any) -> str:
    """A scene's name for folders and tables: ``name``, else ``shape``, else the folder's name."""
    if OmegaConf.is_missing(data, "root"):
        return "scene"
    chosen = data.get("name") or data.get("shape") or Path(str(data.get("root"))).resolve().name
    return scene_folder_name(str(chosen))


def scene_folder_name(scene: str) -> str:
    """A scene's name as a folder may be called."""
    return re.sub(r"[^\w.-]+", "_", scene).lstrip(".") or "scene"


def run_folder(stage: str, report: Any, capture: Any, scene: str, choices: Any) -> str:
    """A run's folder; of a report, where it is written.

    It is named after scene and experiment, and what else is chosen beside the usual. Without an
    experiment DeVRF learns as by ``experiment=quickstart``: they are one run.
    """
    if stage in ("fetch", "selfcheck"):
        return f"outputs/{stage}"
    if stage == "capture":
        return f"outputs/{scene_folder_name(Path(str(capture.into or 'scene')).name)}/capture"
    if stage == "report":
        # A misspelt folder is not created: the step reports that there is none.
        runs = report.runs if Path(report.runs).is_dir() else "outputs"
        return str(ReportSettings(runs, report.into).folder)
    parts = [choices.experiment or "quickstart"]
    if choices.ablation not in (None, "full"):
        parts.append(choices.ablation)
    if (choices.method, choices.protocol) != ("devrf", "two_stage"):
        parts += [choices.method, choices.protocol]
    return f"outputs/{scene}/{'-'.join(parts)}"


def config_record(stage: str) -> str | None:
    """Where in its folder a run's composed config is; a report may lie beside another run's.

    stage=fetch is no run; stage=view may look at one that goes on.
    """
    return None if stage in ("report", "fetch", "view") else ".hydra"


def job_folder(number: int, scene: str, sweep: str, overrides: Sequence[str], params: Any) -> str:
    """The folder of a sweep's job: number, scene, and what else is varied: ``0_robot_tv_0.5``."""
    record = Path(sweep) / "multirun.yaml"  # some searches write none; they name their params
    typed = overrides_in(record) if record.is_file() else []
    varied = dict.fromkeys(params or (), True)
    for override in OverridesParser.create().parse_overrides(typed):
        varied[override.get_key_element()] = override.is_sweep_override()
    varied |= dict.fromkeys(("data", "data.root", "data.name", "data.shape"), False)
    values = [override.partition("=") for override in overrides]
    words = [f"{key.rpartition('.')[2]}_{value}" for key, _, value in values if varied.get(key)]
    return scene_folder_name("_".join([str(number), scene, *words]))[:150]


def overrides_in(record: Path) -> list[str]:
    """The overrides in a sweep's record, ``multirun.yaml``.

    Raises:
        DevrfError: it is none.
    """
    try:
        text = record.read_text("utf-8")
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise ValueError("Hydra writes none, and what refers to itself has no end")
        content = yaml.safe_load(text)
        texts = content["hydra"]["overrides"]["task"]
        if all(isinstance(text, str) for text in texts):
            return [*texts]
    except (yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
        pass
    raise DevrfError(f"{record}: not the record of a sweep; type the sweep again")


def tracked_name(folder: str, otherwise: str | None) -> str | None:
    """A tracker's name of a sweep's job, or of a sweep: its folder's; of another run as given."""
    return Path(folder).name if in_sweep() else otherwise


@cache  # for the whole process
def register_config() -> None:
    """Make the resolvers ``${devrf.scene_name:…}`` … known to Hydra."""
    for word in (scene_name, run_folder, config_record, job_folder, tracked_name):
        OmegaConf.register_new_resolver(f"devrf.{word.__name__}", word, replace=True)


def search_path() -> list[str]:
    """The present command's own folders of configs, as they are typed."""
    words, folders = [], []
    for source in HydraConfig.get().runtime.config_sources if HydraConfig.initialized() else ():
        if source.provider == "command-line":
            words += ["--config-dir", source.path]
        elif source.provider == "hydra.searchpath in command-line":
            folders.append(f"{source.schema}://{source.path}")
    return [*words, f"hydra.searchpath=[{','.join(folders)}]"] if folders else words


def choices() -> dict[str, str | None]:
    """The present job's option of each config group, without Hydra's own; empty outside Hydra."""
    if not HydraConfig.initialized():
        return {}
    chosen = HydraConfig.get().runtime.choices
    return {str(k): v for k, v in chosen.items() if not str(k).startswith("hydra/")}


def overrides() -> list[str]:
    """The present job's overrides, without Hydra's own; empty outside Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def in_sweep() -> bool:
    """Whether the present job is one of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_search() -> bool:
    """Whether the sweeper optimises, and so needs the objective of each job."""
    return in_sweep() and "direction" in HydraConfig.get().sweeper
