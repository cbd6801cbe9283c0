"""Checkpoints that know what they are: written whole or not at all, read without running code."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer

from devrf.errors import DevrfError
from devrf.fields.architecture import Architecture
from devrf.fields.deformation import DeformationField
from devrf.fields.occupancy import Occupancy
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space
from devrf.rendering.model import SceneModel
from devrf.rendering.render import RenderSettings
from devrf.scenes.scene import Scene

FORMAT = 1


@dataclass(frozen=True)
class Passport:
    """What a checkpoint says of itself, in plain data.

    Attributes:
        scene: the scene's name.
        fingerprint: the scene's cameras, times and image sizes, hashed.
        architecture: sizes of the canonical field.
        settings: how rays are sampled.
        space: the space that the fields live in.
        records: what training took, by stage.
        format: version of this layout.
    """

    scene: str
    fingerprint: str
    architecture: Architecture
    settings: RenderSettings
    space: Space = WORLD
    records: dict[str, dict[str, float | None]] = field(default_factory=dict)
    format: int = FORMAT


@dataclass(frozen=True)
class Stored:
    """A learned scene and where it came from.

    Attributes:
        passport: which scene, and how it was learned.
        model: the scene, ready to render.
    """

    passport: Passport
    model: SceneModel


def save_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write what the trainer's stage has learned; an earlier file stays until the new is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        trainer.save_checkpoint(partial, weights_only=True)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def load_checkpoint(path: Path, scene: Scene | None = None) -> Stored:
    """Read a learned scene, on the host.

    Args:
        path: a checkpoint of either stage.
        scene: the scene it must belong to; None takes any.

    Raises:
        DevrfError: no such file, not a devrf checkpoint, a newer one, or of another scene.
    """
    if not path.is_file():
        raise DevrfError(f"{path}: no such checkpoint; run the stage that makes it, or set ckpt")
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # noise in a file makes the unpickler raise whatever it likes
        raise DevrfError(
            f"{path}: damaged, or not a checkpoint; expected one written by devrf"
        ) from None
    if not isinstance(data, dict) or not isinstance(data.get("devrf"), dict):
        raise DevrfError(f"{path}: not a devrf checkpoint; set ckpt to one that devrf wrote")
    passport = _passport(path, data["devrf"])
    if scene is not None and passport.fingerprint != scene.fingerprint:
        raise DevrfError(
            f"{path}: belongs to another scene ({passport.scene}: other cameras, times or image "
            f"sizes than {scene.name}); train this scene, or set ckpt to its own checkpoint"
        )
    return Stored(passport, _model(path, passport, data.get("state_dict") or {}))


def _passport(path: Path, stored: dict[str, Any]) -> Passport:
    if stored.get("format") != FORMAT:
        raise DevrfError(
            f"{path}: has format {stored.get('format')!r}, this version reads {FORMAT}; use the "
            "version of devrf that wrote it, or train again"
        )
    try:
        return Passport(
            scene=stored["scene"],
            fingerprint=stored["fingerprint"],
            architecture=Architecture(**stored["architecture"]),
            settings=RenderSettings(**stored["settings"]),
            space=NormalizedDevice(**stored["space"]) if stored["space"] else WORLD,
            records=stored["records"],
        )
    except (KeyError, TypeError) as error:
        raise DevrfError(
            f"{path}: its description lacks or has an unknown entry ({error}); train again"
        ) from None


def _model(path: Path, passport: Passport, state: dict[str, Any]) -> SceneModel:
    """Build a model of any size and let the stored state give it its shapes."""
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    own = {k.removeprefix("scene_model."): v for k, v in state.items()}
    build = passport.architecture
    # A stage that was stopped in its search has no decoder yet.
    searched = not any(key.startswith("canonical.decoder.") for key in own)
    model = SceneModel(
        build.search_field(box, 8) if searched else build.radiance_field(box, 8, 8),
        Occupancy.full((2, 2, 2), box),
        passport.settings,
        space=passport.space,
    )
    if any(key.startswith("deformation.") for key in own):
        model.deformation = DeformationField(box, FrameClock((0.0, 1.0)), voxels=8)
    try:
        model.load_state_dict(own)
    except (RuntimeError, KeyError, ValueError, TypeError):
        raise DevrfError(f"{path}: its fields do not fit its description; train again") from None
    return model
