"""``stage=render``, ``still``, ``view`` and ``export``: what is made of a learned scene."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path

from hydra.utils import instantiate

from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.scene import export_scene
from devrf.apps.images import to_bytes
from devrf.apps.render import videos
from devrf.apps.settings import ViewerSettings
from devrf.apps.still import StillSettings, still, write_still
from devrf.apps.video import VideoSettings
from devrf.apps.video_file import write_pictures
from devrf.checkpoints.checkpoint import CheckpointMetadata, Viewpoints, check_scene
from devrf.cli.context import RunContext
from devrf.cli.restore_config import parsed, value
from devrf.cli.resume import deciding_settings
from devrf.errors import DevrfError
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene
from devrf.system.process import handle_signals
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# Times whose views stay at hand in the viewer: both ends, the rest state, and where time runs.
CACHED = 6


def render(run: RunContext) -> list[Path]:
    """Write the videos that ``video`` asks for; return their files."""
    settings: VideoSettings = instantiate(run.config.video)
    stored, scene = run.load(), run.scene
    renderer = Renderer(stored.model.to_view(run.device), half=settings.half)
    paths = []
    for video in videos(renderer, scene, settings):
        path = run.folder / "videos" / f"{video.name}.mp4"
        pictures = (to_bytes(picture).numpy() for picture in video.pictures)
        write_pictures(path, followed(pictures, video.frames, path.name), video.fps)
        log.info("video written to %s", path)
        for tracker in run.trackers:
            tracker.show_video(f"videos/{video.name}", path)
        paths.append(path)
    return paths


def picture(run: RunContext) -> None:
    """Render the scene from one camera at one time; earlier pictures stay.

    No image of the scene is read where its data is that of the checkpoint.
    """
    settings: StillSettings = instantiate(run.config.still)
    stored = run.load(unread=True)
    viewpoints = stored.viewpoints
    if viewpoints is None or not _is_its_data(run, stored.metadata):
        stored = run.load()  # refuses another scene
        viewpoints = Viewpoints.of(run.scene)
    camera = settings.camera(viewpoints)
    renderer = Renderer(stored.model.to_view(run.device), half=settings.half)
    color, depth = still(renderer, camera, settings.time, background_value(viewpoints.background))
    write_still(run.folder / "images" / f"{settings.name(stored.model.moves)}.png", color, depth)


def _is_its_data(run: RunContext, metadata: CheckpointMetadata) -> bool:
    """Whether the configured data is, by its settings, what the checkpoint was learned from."""
    data = {k: v for k, v in metadata.training_config.items() if k.startswith("data.")}
    present = deciding_settings(run.config, metadata.stage)
    if metadata.command is None or data != {k: present[k] for k in present if k in data}:
        return False
    root, before = run.config.data.get("root"), value(parsed(metadata.command), "data.root")
    return root is None or (before is not None and Path(root).resolve() == Path(before).resolve())


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
    with (
        closing(Session(settings, viewpoints, scene, run.folder, run.config.ckpt)) as session,
        handle_signals(lambda _: session.stop()),
    ):
        session.present(Drawing(renderer, background_value(viewpoints.background)))
        session.serve()


def export(run: RunContext) -> None:
    """Write geometry that moves, for other programs."""
    settings: ExportSettings = instantiate(run.config.export, _convert_="all")
    model = run.load().model.to_view(run.device)
    export_scene(model, run.scene, settings, run.folder / "export")
