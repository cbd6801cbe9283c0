"""Files of ``stage=export`` for other programs: geometry that moves."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from devrf.apps.captured_cameras import named_cameras
from devrf.apps.export.geometry import ExportSettings, MovingMesh, UpFrame, carried
from devrf.apps.export.gltf import write_gltf
from devrf.apps.export.sequence import FRAME, mesh_files, point_file, write_files
from devrf.apps.export.splats import MovingGaussians, write_splats, write_usd_splats
from devrf.apps.export.surface import surface_of
from devrf.apps.export.tracks import write_tracks
from devrf.apps.export.usd import write_usd
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.rendering.seen_points import seen_points
from devrf.scenes.scene import background_value
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# What index.json says of files of meshes.
SURFACE = {"content": "surface", "frame": FRAME}
# Formats that move one mesh: the name of what is written, and how.
SINGLE: dict[str, tuple[str, Any]] = {
    "gltf": ("scene.glb", write_gltf),
    "usd": ("scene.usdc", write_usd),
}
# Formats of Gaussians.
SPLATS: dict[str, tuple[str, Any]] = {
    "splats": ("splats", write_splats),
    "usd": ("splats.usdc", write_usd_splats),
}


def export_scene(
    model: Renderable, viewpoints: Viewpoints, settings: ExportSettings, folder: Path
) -> None:
    """Write the learned scene's surface as it moves, Gaussians, coloured points, or tracks.

    Raises:
        DevrfError: the method has no such geometry, or it is empty.
    """
    times = settings.export_times(viewpoints.clock) if model.moves else (0.0,)
    if settings.as_tracks:
        path = write_tracks(folder, model, viewpoints, settings, times)
        points = len(settings.tracks or settings.pixels or ())
        log.info("tracks: points %d, times %d; written to %s", points, len(times), path)
        return
    own = MovingGaussians.of_model(model, times) if settings.as_splats else None
    if own is not None:
        path = _write_whole(folder, own, viewpoints, settings)
        count = len(own.of_time[0].means)
        log.info("%d Gaussians at %d times written to %s", count, len(times), path)
    elif not _takes_surface(model, settings):
        path = folder / "points"
        max_points = _write_points(path, model, viewpoints, settings, times)
        log.info(
            "%d coloured points at most at %d times written to %s", max_points, len(times), path
        )
        if max_points == 0:
            log.warning("the files are empty: nothing that the cameras see hides what is behind it")
    elif (field := model.surface()) is None:
        path = folder / settings.format
        meshes = followed(_meshes(model, viewpoints, settings, times), len(times), "meshes")
        name = "frame_{:04d}." + settings.format
        write_files(path, name, meshes, times, settings.seconds, SURFACE)
        log.info("a mesh of its own at %d times written to %s", len(times), path)
    else:
        surface = surface_of(model, field, viewpoints.static, settings)
        mesh = carried(surface, model, times)
        path = _write_mesh(folder, mesh, viewpoints, settings)
        faces = len(mesh.faces)
        vertices = mesh.vertices.shape[1]
        log.info(
            "%d faces, %d vertices at %d times written to %s", faces, vertices, len(times), path
        )


def _takes_surface(model: Renderable, settings: ExportSettings) -> bool:
    """Whether a surface is exported, not points; refuses geometry that the method lacks."""
    gaussians = model.gaussians_at(0.0) is not None
    carries = model.surface() is not None and model.forward_warp(0.0) is not None
    has = carries or model.surface_at(0.0) is not None
    wanted = has if settings.content == "auto" else settings.content != "points"
    if settings.content == "splats" and settings.format not in ("splats", "usd"):
        raise DevrfError(
            f"export.content: splats are written as splats or usd, not as {settings.format}; give "
            "export.format=splats"
        )
    if wanted and not has:
        raise DevrfError(
            f"export.content: method={model.name} has no surface; give "
            + ("export.format=splats" if gaussians else "export.content=points export.format=ply")
        )
    if wanted and not carries and settings.format in (*SINGLE, *SPLATS):
        raise DevrfError(
            f"export.format: method={model.name} has a mesh of its own at each time, and "
            f"{settings.format} moves one; give export.format=ply or obj"
        )
    if not wanted and settings.format != "ply":
        if gaussians and settings.content == "auto":
            raise DevrfError(
                f"export.format: method={model.name} has Gaussians, and no surface for "
                f"{settings.format}; give export.format=splats, export.format=usd "
                "export.content=splats, or export.format=ply for coloured points"
            )
        why = "" if has else f"method={model.name} is exported as coloured points, and "
        raise DevrfError(
            f"export.format: {why}points are written as ply, not as {settings.format}; give "
            "export.format=ply"
        )
    return wanted


def _write_mesh(
    folder: Path, mesh: MovingMesh, viewpoints: Viewpoints, settings: ExportSettings
) -> Path:
    """Write in the wanted format; the file, or the folder of files."""
    if settings.as_splats:
        return _write_whole(folder, MovingGaussians.on_surface(mesh), viewpoints, settings)
    if settings.format in SINGLE:
        return _write_whole(folder, mesh, viewpoints, settings)
    path = folder / settings.format
    files = mesh_files(mesh, settings.format, viewpoints.offset)
    name = "frame_{:04d}." + settings.format
    write_files(path, name, files, mesh.times, settings.seconds, SURFACE)
    return path


def _write_whole(
    folder: Path,
    moving: MovingMesh | MovingGaussians,
    viewpoints: Viewpoints,
    settings: ExportSettings,
) -> Path:
    """Write what moves by a format's own motion; the file, or the folder of files."""
    writers = SPLATS if isinstance(moving, MovingGaussians) else SINGLE
    name, write = writers[settings.format]
    frame = UpFrame.of(viewpoints.static, settings.up, settings.metres, viewpoints.offset)
    write(folder / name, moving, named_cameras(viewpoints), frame, settings.seconds)
    return folder / name


def _meshes(
    model: Renderable,
    viewpoints: Viewpoints,
    settings: ExportSettings,
    times: tuple[float, ...],
) -> Iterator[bytes]:
    """A file of the surface at each time, of a method that carries none through time."""
    for time in times:
        field = model.surface_at(time)
        assert field is not None
        surface = surface_of(model, field, viewpoints.static, settings)
        vertices = model.space.to_world(surface.points)[None]
        mesh = MovingMesh((time,), vertices, surface.faces, surface.colors)
        yield from mesh_files(mesh, settings.format, viewpoints.offset)


def _write_points(
    folder: Path,
    model: Renderable,
    viewpoints: Viewpoints,
    settings: ExportSettings,
    times: tuple[float, ...],
) -> int:
    """Write the points that static cameras see at each time; return the most points of a time."""
    renderer = Renderer(model, times=1)
    behind = background_value(viewpoints.background)
    max_points = 0

    def files() -> Iterator[bytes]:
        nonlocal max_points
        for time in times:
            points, colors = seen_points(renderer, viewpoints.static, time, behind, settings.points)
            max_points = max(max_points, len(points))
            yield point_file(points, colors, viewpoints.offset)

    clouds = followed(files(), len(times), "points")
    index = {"content": "points", "frame": FRAME}
    write_files(folder, "frame_{:04d}.ply", clouds, times, settings.seconds, index)
    return max_points
