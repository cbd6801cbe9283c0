"""A command that is repeated in the same folder goes on there; nothing is done twice.

Each checkpoint holds the settings that decided its result:

* a finished checkpoint with the present settings: the stage is skipped;
* a progress file with the present settings: the stage goes on from there;
* either with other settings: the run is refused, naming the first that differs;
* a deformation on top of another canonical field than the run's: it is learned anew.

What shows or scores a finished checkpoint, or builds on it, refuses such settings, too, where they
are typed.

Settings of logging, scoring, rendering, the device, callbacks that only look, and the place of the
data may differ.

A pipeline does not score and render again either: a step notes what decided its results
(checkpoint, settings, data, loggers, version).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import TypeAdapter

import devrf
from devrf.checkpoints.checkpoint import (
    GIVEN_REST,
    CheckpointMetadata,
    metadata_in,
    metadata_of,
)
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, read_description
from devrf.checkpoints.file_metadata import OWN_REST, digest_of
from devrf.checkpoints.progress import progress_files
from devrf.cli.config import command_line, leaves, set_at, stage_section
from devrf.cli.context import RunContext
from devrf.cli.deciding_callbacks import deciding_callbacks
from devrf.cli.restore_config import root
from devrf.errors import DevrfError
from devrf.system.files import LARGEST_RECORD, read_record, write_json
from devrf.system.folder_lock import PLACE
from devrf.system.override import to_type

log = logging.getLogger(__name__)

# The config group that decides a step's results, and these, by step; other steps are always done.
DECIDES = {"evaluate": ("evaluation", "metrics.json"), "render": ("video", "videos/*.mp4")}
NOTE = "done.json"  # in the folder of the lock
NOTES = TypeAdapter(dict[str, str])
# Settings of a datamodule or a stage that do not change the result.
UNDECISIVE = {"root", "name", "flow_cache", "export", "store"}
# Sections that say how to show or score what was learned, and with which images to compare it; the
# last ones are no settings, but what a stage builds on.
OF_WHAT_IS_SHOWN = {"data", "rehearse", "evaluation", "video", "callbacks"}
OF_WHAT_IS_SHOWN |= {root(OWN_REST), root(GIVEN_REST)}
# Settings of data that are of the learned room alone; and those by which an embedded scene is
# another one, whose cameras are the same.
OF_THE_ROOM = {f"data.{name}" for name in ("near", "far", "box", "bound_scale", "space", "flow")}
OF_THE_ROOM |= {f"data.{name}" for name in ("shape", "scene_seed", "sliding", "surroundings")}
OF_THE_ROOM |= {f"data.{name}" for name in ("texture", "speed", "light")}


@dataclass(frozen=True)
class ResumePoint:
    """The start of a stage.

    Attributes:
        training_config: the present settings that decide the result.
        progress: the file to go on from.
        iterations_done: iterations that were carried out by then, by which curves are numbered.
    """

    training_config: dict[str, Any]
    progress: Path | None = None
    iterations_done: int = 0


def deciding_settings(config: DictConfig, stage: str) -> dict[str, Any]:
    """The settings that decide a stage's result, by the key at which the user sets them."""
    settings = {"method": config.method, "seed": config.seed}
    section = stage_section(config, stage)
    # Of a stage of its own the protocol decides nothing.
    for part in ("data", section, *(() if section == stage else ("protocol",))):
        settings |= _values(config, part)
    for key, usual in (("schedule.seconds", None), ("priors", "all"), ("rehearse", False)):
        if (value := OmegaConf.select(config, key)) != usual:
            settings[key] = value
    settings |= deciding_callbacks(config)
    # As a checkpoint's JSON gives it back.
    plain: dict[str, Any] = json.loads(json.dumps(settings, sort_keys=True))
    return plain


def _values(config: DictConfig, path: str) -> dict[str, Any]:
    """The deciding values below a key, by the keys at which the user sets them."""
    values = leaves(config, path).items()
    return {set_at(config, names): v for names, v in values if names[-1] not in UNDECISIVE}


def beginning(run: RunContext, stage: str) -> ResumePoint | None:
    """The start of ``stage`` in the run's folder; None if there is nothing left to learn.

    Raises:
        DevrfError: a checkpoint there was learned with other settings, has another format, or is
            finished and damaged.
    """
    training_config = deciding_settings(run.config, stage)
    below = run.protocol[stage].builds_on
    if below is not None:
        rest = run.checkpoint(below)
        training_config[OWN_REST if run.config.ckpt is None else GIVEN_REST] = digest_of(rest)
    path = run.own_checkpoint(stage)
    if path.is_file():
        metadata = metadata_in(path, read_checkpoint_file(path))
        if _agrees(path, metadata, training_config) and metadata.complete:
            log.info("%s: learned already (%s); resume=false learns it anew", stage, path)
            remove_progress(path.parent, stage)
            return None
    for progress in progress_files(path.parent, stage):
        try:
            content = read_checkpoint_file(progress)
            metadata = metadata_in(progress, content)
            if content.get("progress") is None:
                raise DevrfError(f"{progress}: does not say where its stage was left")
        except DevrfError as error:
            log.warning("%s; the file before it is taken", error)
            progress.unlink()
            continue
        if _agrees(progress, metadata, training_config):
            position = content["progress"]
            log.info("%s: goes on at iteration %d", stage, position["iteration"])
            return ResumePoint(training_config, progress, position["iterations_done"])
        break
    remove_progress(path.parent, stage)
    return ResumePoint(training_config)


def _agrees(path: Path, metadata: CheckpointMetadata, training_config: Mapping[str, Any]) -> bool:
    """Whether a checkpoint has the present settings; False if only its canonical field differs.

    Raises:
        DevrfError: another setting differs.
    """
    old = metadata.training_config
    if old == training_config:
        return True
    if OWN_REST in old and {**training_config, OWN_REST: old[OWN_REST]} == old:
        log.info("%s: belongs to another canonical field; learned anew", path)
        return False
    key = next(k for k in [*training_config, *old] if old.get(k) != training_config.get(k))
    raise DevrfError(
        f"{_made_otherwise(path, key, old, training_config)}; give resume=false to begin "
        "afresh (what is there is kept in previous-<n>/), or hydra.run.dir=FOLDER for another run"
    )


def check_as_learned(run: RunContext, learning: str | None = None) -> None:
    """Check that nothing was typed that the run's checkpoint would have to be learned with.

    Defaults that have changed since then are no mistake of the command. Where a stage is
    ``learning``, the checkpoint is the one that it builds on, and its own settings are its own.

    Raises:
        DevrfError: a typed setting, or one of a typed option, is another than it was learned with.
    """
    path = run.checkpoint(None if learning is None else run.protocol[learning].builds_on)
    own = {} if learning is None else deciding_settings(run.config, learning)
    does = "learns nothing" if learning is None else "builds on that file"
    metadata = metadata_of(path)
    learned = {**metadata.earlier_configs, metadata.stage: metadata.training_config}
    typed = {key for key, v in run.command.items() if metadata.command.get(key, ...) != v}
    typed = {key for key in typed if root(key) not in OF_WHAT_IS_SHOWN or key in OF_THE_ROOM}
    # A stage that is learned may have another option than those before it.
    by_option = learning is None and any(key[0] == "/" for key in typed)
    for stage, before in learned.items():
        now = deciding_settings(run.config, stage) if before else {}
        for key in {**now, **before}:
            asked = key in typed or (by_option and root(key) not in OF_WHAT_IS_SHOWN)
            if asked and key not in own and now.get(key) != before.get(key):
                raise DevrfError(
                    f"{_made_otherwise(path, key, before, now)}; stage={run.config.stage} {does}: "
                    "leave it out, or learn another run with it (hydra.run.dir=FOLDER)"
                )


def _made_otherwise(path: Path, key: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """In which setting a file and the present command differ."""
    old, new = (json.dumps(of[key])[:40] if key in of else "nothing" for of in (before, now))
    return f"{key}: {path} was made with {old}, now it is {new}"


def remove_progress(folder: Path, stage: str) -> None:
    """Remove the progress files of a stage that is finished, or that begins anew."""
    for path in progress_files(folder, stage):
        path.unlink(missing_ok=True)


def unfinished(run: RunContext) -> str | None:
    """The progress of the run's last stage, and how to go on; None if it is finished."""
    path = run.checkpoint()
    content = read_description(path)
    metadata_in(path, content)  # or an error: a progress that cannot be
    if (at := content.get("progress")) is None:
        return None
    stands = f"iteration {at['iteration']} of {at['total']} of the {at['stage']} stage"
    return f"{path}: {stands}; {command_line(to_type('hydra.run.dir', run.place))} goes on"


def done(run: RunContext, step: str) -> bool:
    """Whether a step has been done with the same checkpoint and settings; says so."""
    if step not in DECIDES or _notes(run.folder).get(step) != _made_with(run, step):
        return False
    log.info("%s: done already; stage=%s does it again", step, step)
    return True


def note_done(run: RunContext, step: str) -> None:
    """Note what has decided the results of a step."""
    if step in DECIDES and run.config.evaluation.predictions is None:
        note = {step: _made_with(run, step)}
        write_json(run.folder / PLACE / NOTE, _notes(run.folder) | note)


def _made_with(run: RunContext, step: str) -> str:
    """A digest of all that decides a step's results, and of their names."""
    data = run.config.data.get("root")
    keyframes = Path(str(run.config.video.path))
    is_path = keyframes.is_file() and keyframes.stat().st_size <= LARGEST_RECORD
    group, results = DECIDES[step]
    made = (
        *(digest_of(run.checkpoint()), devrf.__version__, sorted(run.config.get("logger") or ())),
        *(_values(run.config, "data"), data and Path(data).resolve(), _values(run.config, group)),
        step == "evaluate" and run.datamodule.validation,
        step == "render" and is_path and keyframes.read_bytes(),
        sorted(path.name for path in run.folder.glob(results)),
    )
    return sha256(repr(made).encode()).hexdigest()


def _notes(folder: Path) -> dict[str, str]:
    """What decided the results of steps, by step."""
    try:
        return NOTES.validate_json(read_record(folder / PLACE / NOTE))
    except (OSError, ValueError):
        return {}
