"""``stage=render``, ``still``, ``view`` and ``export``: products of a learned scene."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.utils import instantiate

from devrf.apps.captured_cameras import write_thumbnails
from devrf.apps.export.geometry import ExportSettings
from devrf.apps.export.scene import export_scene
from devrf.apps.render import Video, videos
from devrf.apps.settings import ViewerSettings
from devrf.apps.still import StillSettings, write_still
from devrf.apps.still import still as rendered
from devrf.apps.video import VideoSettings
from devrf.apps.viewer.page import PAGE, PICTURES, PageServer, is_current
from devrf.apps.web.pack import drawable, page
from devrf.checkpoints.checkpoint import Viewpoints, check_scene, metadata_of
from devrf.checkpoints.file_metadata import digest_of
from devrf.cli.context import RunContext
from devrf.cli.restore_config import root
from devrf.cli.resume import unfinished
from devrf.cli.view import serve
from devrf.errors import DevrfError
from devrf.evaluation.predictions import picture_name
from devrf.pictures.images import write_image
from devrf.pictures.video_file import write_pictures
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.rendering.seen_points import scene_radius
from devrf.rendering.tracks import moving_pixels
from devrf.scenes.scene import Scene, background_value
from devrf.system.files import refuse_links, write_text
from devrf.system.memory import free_cache
from devrf.system.progress import followed

if TYPE_CHECKING:
    from devrf.apps.viewer.session import Session

log = logging.getLogger(__name__)

# The page inside another one.
FRAME = (
    f'<iframe src="{PAGE}" width="800" height="500" style="border: 0" '
    'allow="fullscreen; clipboard-write"></iframe>'
)
# Times whose views stay at hand in the viewer: both ends, the rest state, and the current ones.
CACHED = 6
MASKS = Path("images", "motion_masks")


def render(run: RunContext) -> bool:
    """Write the videos that ``video`` asks for; False if one is left out for lack of images."""
    settings: VideoSettings = instantiate(run.config.video)
    model, viewpoints = _learned(run)
    if settings.motion_masks:
        return _write_motion_masks(run, model, viewpoints)
    held_out = None
    without = "held_out.mp4, which shows its images, is left out"
    if settings.path is None and (scene := _with_images(run, without)) is not None:
        held_out = (scene.dynamic if scene.moves else scene.static).test
    renderer = Renderer(model)
    for video in videos(renderer, viewpoints, settings, held_out):
        write_video(run, video)
    return settings.path is not None or held_out is not None


def _write_motion_masks(run: RunContext, model: Renderable, viewpoints: Viewpoints) -> bool:
    """Write a PNG for each held-out image, white where the model shows something that moves.

    False if there are no images.
    """
    scene = _with_images(run, "masks of its held-out images are left out")
    if scene is None:
        return False
    views, renderer, folder = scene.dynamic.test, Renderer(model), run.folder / MASKS
    size, times = scene_radius(model, viewpoints.static), (0.0, *viewpoints.clock.times)
    for index in followed(range(len(views)), len(views), "motion masks"):
        camera, time = views.cameras.single(index), float(views.times[index])
        mask = moving_pixels(renderer, camera, time, times, size)
        if mask is None:
            raise DevrfError(
                f"video.motion_masks: method={model.name} follows no points; leave it out"
            )
        name = picture_name(views, index)
        write_image(folder / name, mask[..., None].expand(-1, -1, 3).float())
    log.info("%d motion masks written to %s", len(views), folder)
    return True


def write_video(run: RunContext, video: Video) -> None:
    """Write a video into the run's folder, and show it to trackers."""
    path = run.folder / "videos" / f"{video.name}.mp4"
    pictures = (picture.numpy() for picture in video.pictures)
    write_pictures(path, followed(pictures, video.frames, path.name), video.fps)
    free_cache(run.device)  # the C library keeps 0.2 GB of a video's memory
    log.info("video written to %s", path)
    for tracker in run.trackers:
        tracker.show_video(f"videos/{video.name}", path)


def still(run: RunContext) -> None:
    """Render the scene from one camera at one time; earlier pictures stay."""
    settings: StillSettings = instantiate(run.config.still)
    model, viewpoints = _learned(run)
    camera = settings.camera(viewpoints)
    behind = background_value(viewpoints.background)
    renderer = Renderer(model)
    color, depth = rendered(renderer, camera, settings.time, behind)
    write_still(run.folder / "images" / f"{settings.name(model.moves)}.png", color, depth)


def view(run: RunContext) -> None:
    """Show the run's checkpoint on a page until a signal arrives."""
    settings: ViewerSettings = instantiate(run.config.viewer)
    model, viewpoints = _learned(run)
    server: PageServer | Session
    if settings.renderer == "browser" or (settings.renderer == "auto" and drawable(model)):
        folder = run.folder / "export"
        current = run.config.ckpt is None and is_current(run.folder)
        if not current or not any((folder / PICTURES).iterdir()):
            _write_with_pictures(run, model, viewpoints)
        server = PageServer(settings, folder)
    else:
        from devrf.apps.viewer.drawing import Drawing
        from devrf.apps.viewer.session import Session  # an extra

        scene = _with_images(run, "its cameras are shown without pictures")
        server = Session(settings, viewpoints, scene, run.folder, run.config.ckpt)
        background = background_value(viewpoints.background)
        parts = model.moving_and_still(scene_radius(model, viewpoints.static))
        renderers = {
            name: Renderer(part, times=CACHED, smooth=False) for name, part in parts.items()
        }
        server.present(Drawing(Renderer(model, times=CACHED, smooth=False), background, renderers))
    serve(server)


def export(run: RunContext) -> None:
    """Write geometry that moves, for other programs, or the page that browsers draw."""
    settings: ExportSettings = instantiate(run.config.export, _convert_="all")
    model, viewpoints = _learned(run)
    if settings.part != "all":
        parts = model.moving_and_still(scene_radius(model, viewpoints.static))
        if not parts:
            unknown = f"nothing moves, or all does, or method={model.name} cannot tell what does"
            raise DevrfError(f"export.part: {unknown}; give export.part=all")
        model = parts[settings.part]
    folder = run.folder / "export" if settings.into is None else Path(settings.into)
    refuse_links(folder)
    if settings.format == "html":
        text = _page(run, model, viewpoints, whole=settings.part == "all")
        write_text(folder / PAGE, text)
        log.info("the scene, for any browser, written to %s", folder / PAGE)
        log.info("in a page of your own beside it: %s", FRAME)
    else:
        export_scene(model, viewpoints, settings, folder)


def write_scene_page(run: RunContext) -> None:
    """Write the page that browsers draw, unless it is there, or they cannot draw the model."""
    if is_current(run.folder):
        return
    model, viewpoints = _learned(run)
    if drawable(model):
        _write_with_pictures(run, model, viewpoints)


def _write_with_pictures(run: RunContext, model: Renderable, viewpoints: Viewpoints) -> None:
    """Write the images of the page's cameras, if the run's images are there, and then the page."""
    folder = run.folder / "export"
    text = _page(run, model, viewpoints)
    scene = _with_images(run, "the cameras on its page are shown without pictures")
    if scene is not None:
        write_thumbnails(folder / PICTURES, scene, viewpoints)
    # Without them an empty folder says that the page is written.
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    write_text(folder / PAGE, text)


def _page(run: RunContext, model: Renderable, viewpoints: Viewpoints, *, whole: bool = True) -> str:
    """The page; one of a part names no checkpoint, lest ``stage=view`` serve it as the scene."""
    checkpoint = digest_of(run.checkpoint()) if whole else ""
    return page(model, viewpoints, run.config.scene, checkpoint)


def _learned(run: RunContext) -> tuple[Renderable, Viewpoints]:
    """The learned model, on the trainer's device, and its viewpoints; another scene is refused.

    The scene is read only if other data is typed than the checkpoint was learned from.
    """
    if (standing := unfinished(run)) is not None:
        log.warning("shown as far as it is learned: %s", standing)
    stored = run.load()
    viewpoints = stored.viewpoints
    commands = (run.command, stored.metadata.command)
    now, before = ({k: v for k, v in c.items() if root(k) == "data"} for c in commands)
    if viewpoints is None or now != before:
        check_scene(run.checkpoint(), stored.metadata, run.scene)
        viewpoints = Viewpoints.of(run.scene)
    return stored.model, viewpoints


def _with_images(run: RunContext, without: str) -> Scene | None:
    """The run's scene; None, and a line in the log that ends with ``without``, if it is missing."""
    try:
        check_scene(path := run.checkpoint(), metadata_of(path), run.scene)
        return run.scene
    except DevrfError as error:
        log.warning("%s; %s", error, without)
        return None
