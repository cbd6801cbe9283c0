"""``stage=view``: a learned scene in a browser."""

from __future__ import annotations

import logging
from contextlib import closing
from threading import Event

from hydra.utils import instantiate

from devrf.apps.settings import ViewerSettings
from devrf.checkpoints.checkpoint import Viewpoints, check_scene
from devrf.cli.context import RunContext
from devrf.errors import DevrfError
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene
from devrf.system.process import handle_signals

log = logging.getLogger(__name__)

# Times whose views stay at hand: both ends, the rest state, and where time runs.
CACHED = 6


def view(run: RunContext) -> None:
    """Show the run's checkpoint on a page until a signal arrives."""
    from devrf.apps.viewer.drawing import Drawing
    from devrf.apps.viewer.session import Session  # an extra

    settings: ViewerSettings = instantiate(run.config.viewer)
    stored = run.load(unread=True)
    scene: Scene | None = None
    try:
        check_scene(run.checkpoint(), stored.metadata, run.scene)
        scene = run.scene
    except DevrfError as error:
        if stored.viewpoints is None:
            raise
        log.warning("%s; its training cameras are shown without pictures", error)
    viewpoints = stored.viewpoints if scene is None else Viewpoints.of(scene)
    assert viewpoints is not None
    renderer = Renderer(stored.model.to_view(run.device), times=CACHED)
    drawing, stop = Drawing(renderer, background_value(viewpoints.background)), Event()
    with (
        handle_signals(lambda _: stop.set()),
        closing(Session(settings, viewpoints, scene, run.folder, stop)) as session,
    ):
        session.present(drawing)
        log.info("the scene is at %s; Ctrl-C ends the viewer", settings.address)
        session.serve()
    log.info("the viewer has ended")
