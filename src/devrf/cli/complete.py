"""What was typed, completed: the command line that Hydra composes.

* Paths get the quotes that Hydra's grammar needs, and ``~`` is filled in.
* A run that is named (``ckpt=``, ``hydra.run.dir=``, ``hydra.sweep.dir=``) brings the overrides
  that it was learned with. What is typed comes after them: only that differs.
* A scene's folder brings what its files say and nothing else has said: ``data=``, ``facing=``, and
  for other methods than DeVRF ``protocol=dynamic`` if one camera filmed it.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf

from devrf.cli.config import APART, config_folder, group_choices
from devrf.cli.messages import in_quotes
from devrf.cli.restore_config import differing, of_named_run, parsed, value, values
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

# What the present command's scene has told, until a log is there to say so.
_told: list[str] = []


def completed(arguments: Sequence[str]) -> list[str]:
    """The command line that Hydra composes for what was typed, without the program's name.

    Raises:
        DevrfError: a scene's folder cannot be recognised, the scenes of a sweep need different
            options, or a group's choice is null.
    """
    _told.clear()
    multirun = not {"-m", "--multirun"}.isdisjoint(arguments)
    words = [quoted_path(SHORTHAND.get(word.lower(), word), multirun) for word in arguments]
    at = [k for k, w in enumerate(words) if w[:1] != "-" and ("=" in w or w[:1] == "~")]
    texts = [words[k] for k in at]
    try:
        typed = parsed(texts)
    except HydraException:  # reported when Hydra parses them
        return words
    if not typed:
        return words
    for override in typed:
        group, is_null = override.key_or_group, override.value() is None
        if is_null and not override.is_delete() and (options := group_choices().get(group)):
            raise DevrfError(
                f"{override.input_line}: choose one of {', '.join(options)}, or leave it out"
            )
    before = of_named_run(typed, multirun)
    texts += _told_by_files(values(typed, "data.root"), parsed([*before, *texts]))
    # Hydra takes all overrides from one place.
    after = [words[k] for k in range(at[0], len(words)) if k not in at]
    return [*words[: at[0]], *before, *texts, *after]


def quoted_path(argument: str, multirun: bool) -> str:
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


def log_told() -> None:
    """Say what the scene's files have told."""
    for line in _told:
        log.info("%s", line)


def _told_by_files(roots: Sequence[str], overrides: Sequence[Override]) -> list[str]:
    """What the files of the scenes in ``roots`` say that no override says.

    Raises:
        DevrfError: a layout is unknown, or the scenes need different options.
    """
    if not roots or value(overrides, "stage") in APART or any("${" in root for root in roots):
        return []
    options: Sequence[str | None] = values(overrides, "data")
    options = options or _of_experiments(values(overrides, "experiment")) or [None]
    words = [_told_by_scene(option, root, overrides) for option, root in product(options, roots)]
    if any(other != words[0] for other in words):
        needed = " and ".join(dict.fromkeys(" ".join(other) or "neither" for other in words))
        raise DevrfError(f"data.root: the scenes need {needed}; sweep over those of each apart")
    return words[0]


def _told_by_scene(option: str | None, root: str, overrides: Sequence[Override]) -> list[str]:
    """What the files of the scene in ``root`` say, which ``data=option`` reads, if it is known."""
    # Imported here: they load torch.
    from devrf.data.kind import by_one_camera, faces_forward
    from devrf.scenes.formats import recognise

    words, why, remark = [], "its cameras", ""
    if option is None:
        layout = recognise(root)
        option, why, remark = layout.choice, f"the layout of {layout.name}", layout.remark
        words.append(f"data={option}")
    space = value(overrides, "data.space")
    if not values(overrides, "facing") and faces_forward(option, root, space):
        words.append("facing=forward")
    known = any(values(overrides, key) for key in ("protocol", "comparison"))
    peer = value(overrides, "method") not in (None, "devrf")
    if peer and not known and by_one_camera(option, root):
        words.append("protocol=dynamic")
    if said := _published(root, overrides):
        _told.append(said)
    if words:
        _told.append(f"{root}: {why} ({' '.join(words)}){remark}")
    return words


def _published(root: str, overrides: Sequence[Override]) -> str | None:
    """What ``data=NAME`` would set where experiment=paper reads that scene by its folder alone."""
    from devrf.scenes.formats import recognise

    name = Path(root).expanduser().resolve().name.lower().replace("-", "_")
    own, paper = (config_folder() / f"{p}{name}.yaml" for p in ("data/", "for_scene/paper_"))
    wanted = values(overrides, "experiment") == ["paper"] and name not in values(overrides, "data")
    if not wanted or not (own.is_file() and paper.is_file()):
        return None
    if not recognise(root).name.startswith("DeVRF"):
        return None
    reader, _ = OmegaConf.load(own).defaults
    usual = OmegaConf.create({"data": OmegaConf.load(own.with_stem(reader))})
    del usual.data["_target_"]  # the scene's choice inherits it
    scene = OmegaConf.merge({"data": OmegaConf.load(own)}, OmegaConf.load(paper))
    typed = {"data.name", "data.defaults", *(override.key_or_group for override in overrides)}
    keys = (key for key in differing(scene, usual) if key not in typed)
    sets = ", ".join(f"{key}={OmegaConf.select(scene, key)}" for key in keys)
    return f"{root}: one of DeVRF's scenes; data={name} would set {sets}" if sets else None


def _of_experiments(names: Sequence[str]) -> list[str]:
    """The options of ``data`` that experiments choose."""
    chosen: list[str | list[str] | None] = []
    if not names:
        return []
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        for name in names:
            with suppress(HydraException):  # reported when Hydra composes it
                found = loader.compute_defaults_list("config", [f"experiment={name}"], RunMode.RUN)
                chosen.append(found.overrides.override_choices.get("data"))
    return [str(option) for option in chosen if option is not None]
