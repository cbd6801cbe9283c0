"""What was typed, completed: the command line that Hydra composes.

* Paths get the quotes that Hydra's grammar needs, and ``~`` is filled in.
* A run that is named (``ckpt=``, ``hydra.run.dir=``, ``hydra.sweep.dir=``) brings the overrides
  that it was learned with. What is typed comes after them: only that differs.
* ``experiment=NAME`` is taken in its form for the scene: ``best_small_forward``, ``paper_lego``.
* A scene's folder without a reader gets ``data=auto``: the reader that fits its files.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from devrf.cli.config import OF_A_CHECKPOINT, config_folder, group_choices, rows, scene_folder_name
from devrf.cli.messages import in_quotes
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Keys whose values are files or folders.
PATHS = {
    *("data.root", "data.export", "data.flow_cache", "ckpt", "fetch.into", "export.into"),
    *("capture.static", "capture.into", "video.path"),
    *("report.runs", "report.into", "evaluation.lpips_weights"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}
# `viewer` is a group, whose choices Hydra wants to be text.
SHORTHAND = {f"viewer={value}": f"viewer.training={value}" for value in ("true", "false")}
KEY_VALUE = re.compile(r"(\+{0,2}([\w./@-]+)=)(.*)", re.DOTALL)

# Overrides that say what to do with a run, on which machine, and what to log, not what the run is.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
OF_A_COMMAND |= {"hydra", "report", "still", "export", "trainer", "logger", "callbacks", "kernels"}
OF_A_COMMAND |= {"viewer"}
# Names code to be run, which a checkpoint, perhaps a stranger's, may not choose.
CODE = "_target_"
# Values that are relative to the folder in which they were typed.
RELATIVE = {"data.root", "evaluation.lpips_weights"}

# Readers whose scenes are forward-facing, and those of the embedded scenes.
FORWARD = {"forward", "neural_3d_video", "procedural_forward"}
EMBEDDED = {"procedural", "procedural_forward"}
# What conf/data/auto.yaml names, and keys that are not passed on with its options.
AUTOMATIC = "devrf.data.recorded.recognised_datamodule"
NOT_PASSED = ("_target_", "reader", "flow_cache")

# Where the present command's settings come from, until a log is there to say so.
_source: list[str] = []


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line that Hydra composes for what was typed.

    Args:
        arguments: of the command line, without the program's name.

    Raises:
        DevrfError: a scene's folder cannot be recognised, or an experiment has no one form for all
            scenes of a sweep.
    """
    _source.clear()
    multirun = not {"-m", "--multirun"}.isdisjoint(arguments)
    words = [_quoted_path(SHORTHAND.get(word.lower(), word), multirun) for word in arguments]
    at = [k for k, w in enumerate(words) if w[:1] != "-" and ("=" in w or w[:1] == "~")]
    texts = [words[k] for k in at]
    try:
        typed = parsed(texts)
    except HydraException:  # reported when Hydra parses them
        return words
    if not typed:
        return words
    before = _of_named_run(typed, multirun)
    texts = _in_form(texts, before)
    both = parsed([*before, *texts])
    if values(both, "data.root") and not any(one.key_or_group == "data" for one in both):
        if not any(map(_reads_files, values(both, "experiment"))):
            before.append("data=auto")
    # Hydra takes all overrides from one place.
    after = [words[k] for k in range(at[0], len(words)) if k not in at]
    return [*words[: at[0]], *before, *texts, *after]


def log_source() -> None:
    """Say where the settings come from that were not typed."""
    for line in _source:
        log.info("%s", line)


def parsed(overrides: Iterable[str]) -> list[Override]:
    """Overrides by Hydra's grammar.

    Raises:
        HydraException: one is not understood.
    """
    read: list[Override] = OverridesParser.create().parse_overrides(list(overrides))
    return read


def values(overrides: Sequence[Override], key: str) -> list[str]:
    """The last value of ``key``, of a sweep all of them; none where there is none."""
    for override in reversed(overrides):
        if override.key_or_group == key and not override.is_delete():
            if override.is_choice_sweep():
                return [str(getattr(v, "text", v)) for v in override.sweep_iterator()]
            return [] if override.value() is None else [str(override.value())]
    return []


def value(overrides: Sequence[Override], key: str) -> str | None:
    """The last value of ``key``; None where there is none, or several."""
    several = values(overrides, key)
    return several[0] if len(several) == 1 else None


def recorded(overrides: Iterable[str]) -> list[str]:
    """What a checkpoint keeps of a command's overrides; paths of files are made absolute.

    What it keeps of these again is the same.

    Raises:
        HydraException: an override is not understood.
    """
    kept = []
    for override in parsed(overrides):
        key, text = override.key_or_group, str(override.input_line)
        if _root(key) in OF_A_COMMAND or CODE in text:
            continue
        path = None if override.is_delete() else override.value()
        if key in RELATIVE and isinstance(path, str) and "${" not in path:
            text = f"{key}={_quoted(str(Path(path).expanduser().absolute()))}"
        kept.append(text)
    return kept


def _root(key: str) -> str:
    """The first part of a key: ``data`` of ``data.root``."""
    return re.split("[./]", key)[0]


def _quoted(text: str) -> str:
    """A value as Hydra's grammar takes it literally, in quotes where it needs them."""
    return text if re.fullmatch(r"[A-Za-z0-9_./-]+", text) else in_quotes(text)


def _quoted_path(argument: str, multirun: bool) -> str:
    """An argument as typed; if it names a file, as Hydra's grammar takes just that name.

    In a multirun a comma separates paths, as it does other values.
    """
    parts = KEY_VALUE.fullmatch(argument)
    if not parts or parts[2] not in PATHS or "${" in parts[3]:
        return argument
    try:
        (override,) = parsed([argument])
    except HydraException:
        paths = parts[3].split(",") if multirun else [parts[3]]
        return parts[1] + ",".join(in_quotes(os.path.expanduser(path)) for path in paths)
    read = override.value()
    if override.is_sweep_override() or read in (None, ""):
        return argument
    # A folder's name may look like a number or a list.
    path = os.path.expanduser(read if isinstance(read, str) else parts[3])
    return argument if read == path else parts[1] + in_quotes(path)


# A run that knows itself


def _of_named_run(typed: Sequence[Override], multirun: bool) -> list[str]:
    """The overrides that the run was learned with which the command names, and its folder."""
    checkpoints = [Path(path) for path in values(typed, "ckpt")]
    folder, sweep = value(typed, "hydra.run.dir"), value(typed, "hydra.sweep.dir")
    if value(typed, "stage") == "report":
        return []
    if sweep is not None and not checkpoints:
        return _of_sweep(typed, Path(sweep))
    source = ", ".join(map(str, checkpoints))
    if folder is not None and not checkpoints and not multirun:
        source = folder
        if (last := _last_checkpoint(Path(folder))) is not None:
            checkpoints = [last]
    commands = [_command(path) for path in checkpoints if path.is_file()]
    if not commands or len(commands) < len(checkpoints):
        return []  # a file that is missing is reported by the step that loads it
    if None in commands:
        _source.append(
            f"{checkpoints[commands.index(None)]}: does not say how it was learned; data and "
            "settings are those typed, and the defaults"
        )
        return []
    first, *others = [command or [] for command in commands]
    shared = [text for text in first if all(text in other for other in others)]
    put = _beside(typed, shared, source)
    if multirun:
        # The sweep is the one that is typed, not that of an experiment.
        return put if values(typed, "hparams_search") else [*put, "hydra.sweeper.params=null"]
    put.append("hydra.mode=RUN")
    if folder is None and value(typed, "stage") in OF_A_CHECKPOINT:
        put.append(f"hydra.run.dir={_quoted(str(_folder_for(checkpoints[0])))}")
    return put


def _of_sweep(typed: Sequence[Override], folder: Path) -> list[str]:
    """What the sweep in ``hydra.sweep.dir`` was started with, unless another is typed."""
    record = folder / "multirun.yaml"
    if any(override.is_sweep_override() for override in typed) or not record.is_file():
        return []
    begun = OmegaConf.select(OmegaConf.load(record), "hydra.overrides.task") or []
    return [*_beside(typed, recorded(begun), str(folder)), "hydra.mode=MULTIRUN"]


def _beside(typed: Sequence[Override], command: Sequence[str], source: str) -> list[str]:
    """The recorded overrides that stay beside what is typed.

    Another option of a group begins from its own values. Another method takes over data and seed.
    """
    before = parsed(command)
    keys = {override.key_or_group for override in typed if not override.is_add()}
    changed = tuple(f"{k}." for k in keys if values(typed, k) != values(before, k))
    method = value(typed, "method")
    other = method not in (None, value(before, "method") or "devrf")
    stay = []
    for override in before:
        key = override.key_or_group
        replaced = key.startswith(changed) or (key in keys and not override.is_add())
        if not replaced and (not other or _root(key) in ("data", "seed")):
            stay.append(str(override.input_line))
    if stay:
        _source.append(f"{source}: as it was learned, with {' '.join(stay)}")
    return stay


def _folder_for(checkpoint: Path) -> Path:
    """Where what is made of a checkpoint goes.

    Into the folder of its run if it is the last of it, else into a folder below that has the
    checkpoint's name; of a file that stands alone, into ``outputs/<scene>/<name>``.
    """
    if checkpoint.parent.name == "checkpoints":
        run = checkpoint.parent.parent
        last = _last_checkpoint(run)
        same = last is not None and last.resolve() == checkpoint.resolve()
        return run if same else run / checkpoint.stem
    from devrf.checkpoints.checkpoint import metadata_of

    return Path("outputs") / scene_folder_name(metadata_of(checkpoint).scene) / checkpoint.stem


def _command(checkpoint: Path) -> list[str] | None:
    """The command that a checkpoint was learned with; None where it is not known."""
    from devrf.checkpoints.checkpoint import metadata_of  # loads torch

    # A damaged file is reported when the whole of it is read.
    with suppress(DevrfError, OSError, HydraException):
        command = metadata_of(checkpoint).command
        return None if command is None else recorded(command)
    return None


def _last_checkpoint(run: Path) -> Path | None:
    """The checkpoint or progress file of the latest stage in a run's folder."""
    latest: list[tuple[int, int, Path]] = []
    for path in (run / "checkpoints").glob("*.ckpt"):
        from devrf.checkpoints.checkpoint import metadata_of

        with suppress(DevrfError, OSError):
            latest.append((len(metadata_of(path).records), path.stat().st_mtime_ns, path))
    return max(latest)[2] if latest else None


# The form of an experiment, and the reader of a scene


def _in_form(texts: list[str], before: Sequence[str]) -> list[str]:
    """The typed overrides, with ``experiment=NAME`` in its form for the scene.

    Of ``paper`` with ``data=lego`` that is ``paper_lego``, else ``paper_inward``, else ``paper``;
    of ``best_small`` with an embedded scene ``best_small_embedded``. Of a sweep over scenes with
    settings of their own, ``experiment=paper data=lego,plant``, it is one over such experiments,
    which name their data themselves.

    Raises:
        DevrfError: a sweep's scenes need different forms.
    """
    both = parsed([*before, *texts])
    names = values(both, "experiment")
    known = set(group_choices()["experiment"])
    if not any(other.startswith(f"{name}_") for name in names for other in known):
        return texts
    scenes: list[str | None] = [*values(both, "data")]
    if not scenes or "auto" in scenes:
        from devrf.scenes.formats import recognise  # loads numpy

        scenes = [recognise(root).choice for root in values(both, "data.root")]
    forms = [[_form(name, scene, known) for name in names] for scene in scenes or [None]]
    if len(names) == 1 and len(scenes) > 1 and forms == [[f"{names[0]}_{one}"] for one in scenes]:
        forms = [[form for own in forms for form in own]]
        texts = [text for text in texts if not text.startswith("data=")]
    if any(form != forms[0] for form in forms):
        needed = dict.fromkeys(form for own in forms for form in own)
        raise DevrfError(
            f"experiment={','.join(names)}: these scenes need different forms of it; sweep over "
            f"the scenes of each apart, with experiment={' and experiment='.join(needed)}"
        )
    form = f"experiment={','.join(forms[0])}"
    return [form if text.startswith("experiment=") else text for text in texts]


def _form(name: str, scene: str | None, known: set[str]) -> str:
    """The most specific form of an experiment for ``data=scene``; None where it is not said."""
    if scene is None:
        return name if name in known else f"{name}_inward"
    reader = _reader(scene)
    kinds = [scene, "embedded"] if reader == "procedural" else [scene]
    kinds.append("forward" if reader in FORWARD else "inward")
    return next((f"{name}_{kind}" for kind in kinds if f"{name}_{kind}" in known), name)


def _reader(option: str) -> str:
    """The reader that an option of ``data`` goes back to: ``inward`` of ``lego``."""
    path = config_folder() / "data" / f"{option}.yaml"
    content: Any = OmegaConf.load(path) if path.is_file() else {}
    below = [entry for entry in content.get("defaults", []) if isinstance(entry, str)]
    return _reader(below[0]) if below else option


def _reads_files(experiment: str) -> bool:
    """Whether an experiment chooses a reader of files itself."""
    path = config_folder() / "experiment" / f"{experiment}.yaml"
    content: Any = OmegaConf.load(path) if path.is_file() else rows("experiment").get(experiment)
    defaults = [] if content is None else content.get("defaults", [])
    for entry in defaults:
        if not isinstance(entry, str) and "override /data" in entry:
            return _reader(entry["override /data"]) not in EMBEDDED
    return any(_reads_files(entry) for entry in defaults if isinstance(entry, str))


def with_recognised_data(config: DictConfig) -> DictConfig:
    """The config with the reader that fits the scene's files in place of ``data=auto``.

    Options that are null have the reader's own defaults.

    Raises:
        DevrfError: the layout is unknown, or its reader has no such option.
    """
    data = config.data
    if data.get("_target_") != AUTOMATIC or config.stage == "report":
        return config
    if OmegaConf.is_missing(data, "root"):
        return config  # the check of the config says so
    # Imported here: --help and a misspelt key are answered before numpy and torch have loaded.
    from devrf.scenes.formats import recognise

    layout = recognise(data.root)
    own = OmegaConf.load(config_folder() / "data" / f"{layout.choice}.yaml")
    assert isinstance(own, DictConfig)
    raw: Any = OmegaConf.to_container(data)
    given = {k: v for k, v in raw.items() if v is not None and k not in NOT_PASSED}
    # As a list: a DictConfig does not "contain" what is required and not given.
    known = [str(name) for name in own if name not in NOT_PASSED]
    for key in given:
        if key not in known:
            raise DevrfError(
                f"data.{key}: {data.root} is read by data={layout.choice}, which takes "
                f"{', '.join(known)}"
            )
    with open_dict(config):
        config.data = OmegaConf.merge(own, given, {"flow_cache": raw["flow_cache"]})
    if HydraConfig.initialized():
        chosen: Any = HydraConfig.get().runtime.choices
        with open_dict(chosen), read_write(chosen):
            chosen.data = layout.choice  # as if it had been typed: reports compare choices
    return config
