"""``stage=still``: one picture, for which no image of the scene is read."""

from __future__ import annotations

import logging
from itertools import count
from pathlib import Path

from hydra.utils import instantiate

from devrf.apps.images import write_image
from devrf.apps.still import StillSettings, still
from devrf.checkpoints.checkpoint import CheckpointMetadata, Viewpoints
from devrf.cli.context import RunContext
from devrf.cli.overrides import Overrides
from devrf.cli.resume import deciding_settings
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer

log = logging.getLogger(__name__)


def picture(run: RunContext) -> None:
    """Render the scene from one camera at one time; earlier pictures stay."""
    settings: StillSettings = instantiate(run.config.still)
    stored = run.load(unread=True)
    viewpoints = stored.viewpoints
    if viewpoints is None or not _is_its_data(run, stored.metadata):
        stored = run.load()  # refuses another scene
        viewpoints = Viewpoints.of(run.scene)
    camera = settings.camera(viewpoints)
    renderer = Renderer(stored.model.to_view(run.device), half=settings.half)
    color, depth = still(renderer, camera, settings.time, background_value(viewpoints.background))
    path = _unused(run.folder / "images" / f"{settings.name}.png")
    for place, image in ((path, color), (path.with_stem(f"{path.stem}_depth"), depth)):
        write_image(place, image)
        log.info("picture written to %s", place)


def _is_its_data(run: RunContext, metadata: CheckpointMetadata) -> bool:
    """Whether the configured data is, by its settings, what the checkpoint was learned from."""
    data = {k: v for k, v in metadata.training_config.items() if k.startswith("data.")}
    present = deciding_settings(run.config, metadata.stage)
    if metadata.command is None or data != {k: present[k] for k in present if k in data}:
        return False
    root, before = run.config.data.get("root"), Overrides.of(metadata.command).value("data.root")
    return root is None or (before is not None and Path(root).resolve() == Path(before).resolve())


def _unused(path: Path) -> Path:
    """The path, with a number where a file of that name is there: ``NAME_2.png``."""
    names = (path.with_stem(f"{path.stem}_{k}") for k in count(2))
    return path if not path.exists() else next(name for name in names if not name.exists())
