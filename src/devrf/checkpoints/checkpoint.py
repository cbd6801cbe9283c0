"""Checkpoints: metadata and a model's state, checksummed, and read without running code."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import CheckpointIO
from pydantic import JsonValue, ValidationError

from devrf.checkpoints.checkpoint_file import (
    read_checkpoint_file,
    read_description,
    write_checkpoint_file,
)
from devrf.checkpoints.file_metadata import latest_checkpoint
from devrf.checkpoints.progress import Progress
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Background, Scene
from devrf.scenes.validation import check_poses
from devrf.system.files import UNREADABLE
from devrf.system.memory import OutOfMemoryError, is_oom
from devrf.system.plain_data import Line, validate
from devrf.system.printed import shown
from devrf.system.stored_class import StoredClass, stored_class

# The stage's attribute that holds the model: the prefix of its entries of a state.
MODEL = "scene_model."
# As OWN_REST, of a checkpoint that was given.
GIVEN_REST = "ckpt"
# A whole number in a model's config (layers, units, samples of a ray) is at most this.
LARGEST = 2**14
# Numbers of a file are at most this: their squares, too, are float32.
FARTHEST = 1e12
# Errors that parts of a file raise which contradict each other.
UNFIT = (*UNREADABLE, DevrfError, RuntimeError, AssertionError)
# A model may have so many more values than its file: small grids that take the stored shape.
UNSTORED = 2**16
# The most pixels along the side of an image.
SIDE = 2**14
# The most that one side of an image is longer than the other.
ASPECT = 16
# Mean colours of the same images, read with other settings, differ by no more than this.
SAME_LOOK = 0.02
# Figures of a training, by name: numbers, and words that say how it ran.
TrainingFigures = dict[str, int | float | str | list[float] | None]


@dataclass(frozen=True)
class CheckpointMetadata:
    """Metadata of a checkpoint, in plain data.

    Attributes:
        scene: the scene's name.
        fingerprint: the scene's cameras, times and image sizes, hashed.
        stage: the stage that wrote it.
        model: the path of the model's class (``class``) and its config.
        protocol: the stages, their data and parts; None outside a composed run.
        records: figures of the training, by stage.
        training_config: the settings that decided what was learned, by config key; empty for a
            stage that was not trained from a config.
        earlier_configs: the same of the stages that this one builds on, by name.
        command: options of config groups, by ``/group``, and plain values, by config key, of the
            command that learned it, but for those that only say what to do.
        complete: whether the stage has gone through its whole schedule.
        moves: whether the scene was seen at more than one time; None in a file of an earlier
            version.
        look: the scene's, for those that share all cameras; empty in a file of an earlier version.
    """

    scene: Line
    fingerprint: str
    stage: Line
    model: dict[str, Any]
    protocol: Line | None = None
    records: dict[str, TrainingFigures] = field(default_factory=dict)
    training_config: dict[str, JsonValue] = field(default_factory=dict)
    earlier_configs: dict[str, dict[str, JsonValue]] = field(default_factory=dict)
    command: dict[str, JsonValue] = field(default_factory=dict)
    complete: bool = True
    moves: bool | None = None
    look: tuple[float, ...] = ()


@dataclass(frozen=True)
class Viewpoints:
    """The cameras that saw a scene, and their times: all that is known without its images.

    Attributes:
        background: behind the alpha mask.
        clock: the times of the training images.
        static: cameras of the static training images.
        dynamic: cameras of the training images in motion, a fixed one once.
        held_out: the camera of the first held-out image of the moving scene: one camera.
        followed: the times of the ``dynamic`` cameras, if they are those of one moving camera; else
            empty.
        offset: subtracted from the positions (:mod:`devrf.geometry.offset`).
    """

    background: Background
    clock: FrameClock
    static: Cameras
    dynamic: Cameras
    held_out: Cameras
    followed: tuple[float, ...] = ()
    offset: Offset = NO_OFFSET

    @classmethod
    def of(cls, scene: Scene) -> Viewpoints:
        """The viewpoints of a scene."""
        train = scene.dynamic.train
        views = torch.unique(train.view) if scene.moves else ()
        first = [int((train.view == view).nonzero()[0]) for view in views]
        static = scene.static.train.cameras
        held_out = scene.dynamic.test.cameras.single(0)
        moving = scene.moves and train.by_moving_camera and len(train) > 1
        times = tuple(train.times[first].tolist()) if moving else ()
        dynamic = train.cameras[first]
        return cls(scene.background, scene.clock, static, dynamic, held_out, times, scene.offset)

    @classmethod
    def stored(cls, entry: dict[str, Any]) -> Viewpoints | None:
        """The viewpoints of which a checkpoint holds ``asdict``; None in an earlier version's."""
        if "clock" not in entry:
            return None
        cameras = {name: Cameras(**entry[name]) for name in ("static", "dynamic", "held_out")}
        if not len(cameras["static"]) or not len(cameras["held_out"]):
            raise ValueError("no camera")
        for camera in cameras.values():
            camera.check()
            check_poses(camera.camera_to_world, lambda index: f"camera {index}")
            sizes = {(camera.width, camera.height), *map(tuple, camera.extents.tolist())}
            for sides in map(sorted, sizes):
                if not 0 < sides[0] <= sides[1] <= min(SIDE, ASPECT * sides[0]):
                    raise ValueError("an image of a size that cannot be")
        followed = validate(tuple[float, ...], entry.get("followed", ()))
        if len(followed) not in (0, len(cameras["dynamic"])):
            raise ValueError("times of other cameras")
        clock = validate(FrameClock, entry["clock"])
        offset = validate(tuple[float, float, float], entry.get("offset", NO_OFFSET))
        if not all(map(math.isfinite, offset)):
            raise ValueError("an offset without end")
        return cls(**{**entry, **cameras, "clock": clock, "followed": followed, "offset": offset})


@dataclass(frozen=True)
class LoadedCheckpoint:
    """A learned scene and where it came from.

    Attributes:
        metadata: the scene, and the settings that it was learned with.
        model: a :class:`~devrf.rendering.renderable.Renderable`, to be shown: what goes on learning
            it calls ``train``.
        viewpoints: the cameras that saw the scene; None if the file does not say.
    """

    metadata: CheckpointMetadata
    model: Any
    viewpoints: Viewpoints | None = None


class ChecksummedCheckpointIO(CheckpointIO):
    """Makes Lightning write and read checkpoint files of this format."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write ``checkpoint`` to ``path``, whole or not at all."""
        write_checkpoint_file(Path(path), checkpoint)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint onto the host, without running code; other arguments are ignored.

        Raises:
            DevrfError: the file is damaged, or not devrf's.
            ValueError: its model has numbers that nothing can be computed with.
        """
        content = read_checkpoint_file(Path(path))
        state = content.get("state_dict", {})
        _check_numbers({name: value for name, value in state.items() if MODEL in name})
        return content

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove the file."""
        Path(path).unlink(missing_ok=True)


def load_checkpoint(
    path: str | Path, scene: Scene | None = None, device: torch.device | str = "cpu"
) -> LoadedCheckpoint:
    """Read a learned scene onto ``device`` from a checkpoint of any stage; None takes any scene.

    Raises:
        DevrfError: no such file, a damaged one, not a devrf checkpoint, one of another format, or
            of another scene.
    """
    path = Path(path)
    if not path.is_file():
        raise DevrfError(f"{path}: no such checkpoint; run the stage that makes it, or set ckpt")
    data = read_checkpoint_file(path)
    metadata = metadata_in(path, data)
    if scene is not None:
        check_scene(path, metadata, scene)
    model_class = _model_class(path, metadata)
    try:
        _check_numbers((metadata.model, data["state_dict"], data.get("viewpoints")))
        state = {k.removeprefix(MODEL): v for k, v in data["state_dict"].items() if MODEL in k}
        model = _build_checked(model_class, metadata.model, state).to(device).eval()
        model.load_stored_state(state)
        viewpoints = Viewpoints.stored(data.get("viewpoints", {}))
        if viewpoints is not None:
            # One ray, which goes through all parts: those that do not fit are noticed here.
            camera = viewpoints.held_out.resized(width=1, height=1)
            Renderer(model).view(camera, index=0, time=1.0, background=1.0)
    except OutOfMemoryError as shortage:
        raise OutOfMemoryError(f"{path}: {shortage}") from None
    except UNFIT as error:
        if is_oom(error):
            raise
        raise unfit(path, error) from error
    return LoadedCheckpoint(metadata, model, viewpoints)


def unfit(path: Path, error: Exception) -> DevrfError:
    """The one line on the parts of a file that contradict each other, by their error."""
    why = f"{type(error).__name__}: {error}"
    if isinstance(error, ValidationError):
        issue = error.errors()[0]
        why = ": ".join([*map(str, issue["loc"]), issue["msg"]])
    return DevrfError(
        f"{path}: its parts do not fit together ({shown(why)[:120]}); take a copy that is whole, "
        "or train again (resume=false)"
    )


def _build_checked(
    model_class: Any, description: Mapping[str, Any], state: Mapping[str, Any]
) -> Any:
    """The model that a checkpoint describes, before it takes its state.

    Raises:
        ValueError: it would have more values than the file, or numbers that no model has.
    """
    config = {key: value for key, value in description.items() if key != "class"}
    sizes = _leaves(config, model_class.unbuilt)
    if any(isinstance(value, int) and abs(value) > LARGEST for value in sizes):
        raise ValueError("a number that is too large")
    with torch.device("meta"):  # takes no memory
        outline = model_class.from_config(config)
    values = sum(tensor.numel() for tensor in (*outline.parameters(), *outline.buffers()))
    tensors = {id(value): value for value in _leaves(state) if isinstance(value, torch.Tensor)}
    stored = sum(tensor.numel() for tensor in tensors.values())
    if values > stored + UNSTORED:
        raise ValueError("more values than are stored")
    return model_class.from_config(config)


def _check_numbers(parts: Any) -> None:
    """ValueError if a number in nested data is not finite, or too large to be computed with.

    Settings may be infinite: how far away something may be.
    """
    for value in _leaves(parts):
        if isinstance(value, torch.Tensor) and value.is_floating_point() and value.numel():
            low, high = map(float, value.aminmax())
            valid = -FARTHEST <= low and high <= FARTHEST  # NaN compares false
        else:
            is_number = isinstance(value, int | float)
            valid = not is_number or abs(value) <= FARTHEST or value in (math.inf, -math.inf)
        if not valid:
            raise ValueError("a number that is not finite, or too large")


def _leaves(value: Any, without: Collection[str] = ()) -> Iterator[Any]:
    """The leaves of nested mappings, lists and tuples, but for entries of some names."""
    if isinstance(value, Mapping):
        value = [item for key, item in value.items() if key not in without]
    if not isinstance(value, list | tuple):
        yield value
        return
    for item in value:
        yield from _leaves(item, without)


def check_scene(path: Path, metadata: CheckpointMetadata, scene: Scene) -> None:
    """Check that a checkpoint belongs to ``scene``.

    Raises:
        DevrfError: it does not.
    """
    alike = all(abs(a - b) <= SAME_LOOK for a, b in zip(metadata.look, scene.look, strict=False))
    if metadata.fingerprint != scene.fingerprint or not alike:
        raise DevrfError(
            f"{path}: belongs to another scene ({metadata.scene}: other cameras, times, images or "
            f"image sizes than {scene.name}); train this scene, or set ckpt to its own checkpoint"
        )


def metadata_of(path: Path) -> CheckpointMetadata:
    """The metadata of a checkpoint, read without its tensors and without its checksum.

    Raises:
        DevrfError: the file is not devrf's, or has no metadata.
    """
    return metadata_in(path, read_description(path))


def learned_with(run: Path, checkpoint: str | Path | None = None) -> dict[str, Any]:
    """The settings of the ``checkpoint``, else of a run's latest one; none without one."""
    path = Path(checkpoint or latest_checkpoint(run) or "")
    return metadata_of(path).training_config if path.is_file() else {}


def metadata_in(path: Path, data: dict[str, Any]) -> CheckpointMetadata:
    """The metadata in the content of a checkpoint.

    Raises:
        DevrfError: there is none, or it has other entries.
    """
    if not isinstance(data, dict) or not isinstance(data.get("devrf"), dict):
        raise DevrfError(f"{path}: not a devrf checkpoint; set ckpt to one that devrf wrote")
    try:
        metadata = validate(CheckpointMetadata, data["devrf"])
        if data.get("progress") is not None:
            validate(Progress, data["progress"])
    except UNFIT as error:
        raise unfit(path, error) from error
    return metadata


def _model_class(path: Path, metadata: CheckpointMetadata) -> Any:
    """The model's class."""
    try:
        return stored_class(metadata.model.get("class"), StoredClass)
    except LookupError as error:
        raise DevrfError(
            f"{path}: was learned by {error.args[0][:200]!r}, which is not known here; install "
            "or import the method first"
        ) from None
