"""The step that makes a scene of footage: ``stage=capture``."""

from __future__ import annotations

import logging
import shlex

from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.apps.settings import CaptureSettings
from devrf.cli.config import config_folder
from devrf.cli.context import RunContext
from devrf.cli.inspect_scene import inspect

log = logging.getLogger(__name__)


def capture(run: RunContext) -> None:
    """Make a scene of the footage ``capture.…``, and report on it as ``stage=inspect`` does."""
    settings: CaptureSettings = instantiate(run.config.capture, _convert_="all")
    folder = scene_from_footage(settings)
    config = run.config.copy()
    config.data = OmegaConf.load(config_folder() / "data" / "nerfstudio.yaml")
    config.data.root, config.data.name = str(folder), folder.resolve().name
    config.data.flow_cache = str(run.folder / "flow.npz")
    captured = RunContext(config, run.folder)
    inspect(captured)
    # The default field is one for cameras around a scene.
    given = (
        [] if captured.scene.kind == "inward" else ["experiment=best_small_forward", "data=auto"]
    )
    log.info("next:")
    log.info("  %s", shlex.join(["python", "-m", "devrf", *given, f"data.root={folder}"]))
