"""Tracks of chosen points, or of what chosen pixels show: CSV, JSON, or USD."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from devrf.apps.captured_cameras import named_cameras
from devrf.apps.export.geometry import ExportSettings, UpFrame
from devrf.apps.export.sequence import FRAME
from devrf.apps.export.usd import SceneFile
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.metrics.geometric import SOLID
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.rendering.tracks import shown_points, track
from devrf.system.files import atomic_write, write_json
from devrf.system.options import abbreviated


def write_tracks(
    folder: Path,
    model: Renderable,
    viewpoints: Viewpoints,
    settings: ExportSettings,
    times: Sequence[float],
) -> Path:
    """Write where the chosen points are at the times; the file.

    They are ``export.tracks``, given at rest, or what ``export.pixels`` show. Points are in the
    capture's world; those of USD in metres with y up.

    Raises:
        DevrfError: the method follows no points; there is no such view or pixel, or nothing there.
    """
    offset = torch.tensor(viewpoints.offset, dtype=torch.float64)
    if settings.pixels is None:
        given = torch.tensor(settings.tracks, dtype=torch.float64) - offset
        points, since = given.float().to(model.device), 0.0
    else:
        points, since = _shown(model, viewpoints, settings), settings.pixels_time
    tracks = track(model, points, since, times)
    if tracks is None:
        raise DevrfError(f"export.content: method={model.name} follows no points; leave tracks out")
    tracks = tracks.float().cpu()
    places = (tracks.double() + offset).tolist()
    seconds = [time * settings.seconds for time in times]
    path = folder / f"tracks.{settings.format.replace('usd', 'usdc')}"
    if settings.format == "json":
        ways = [{"positions": list(way)} for way in zip(*places, strict=True)]
        times_of = {"times": list(times), "seconds": seconds}
        write_json(path, {"content": "tracks", "frame": FRAME, **times_of, "tracks": ways})
    elif settings.format == "csv":
        with atomic_write(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(["track", "time", "seconds", "x", "y", "z"])
            for time, second, of_time in zip(times, seconds, places, strict=True):
                table.writerows([k, time, second, *place] for k, place in enumerate(of_time))
    else:
        from pxr import UsdGeom, Vt  # an extra

        frame = UpFrame.of(viewpoints.static, settings.up, settings.metres, viewpoints.offset)
        scene = SceneFile(times, frame, settings.seconds)
        shape = UsdGeom.Points.Define(scene.stage, "/scene/tracks")
        scene.move_to_origin(shape)
        points = frame.points(tracks)
        for code, of_time in zip(scene.codes, points, strict=True):
            shape.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(of_time.numpy()), code)
        scene.write(path, {}, points)
    return path


def _shown(model: Renderable, viewpoints: Viewpoints, settings: ExportSettings) -> Tensor:
    """World points (K, 3) that ``export.pixels`` show, on the scene's device."""
    pixels, name, time = settings.pixels or (), settings.pixels_view, settings.pixels_time
    cameras = {"held_out": viewpoints.held_out, **named_cameras(viewpoints)}
    if name not in cameras:
        counts = {"static": len(viewpoints.static), "dynamic": len(viewpoints.dynamic)}
        known = [f"{kind}_0 to {kind}_{count - 1}" for kind, count in counts.items() if count]
        raise DevrfError(
            f"export.pixels_view: no camera {abbreviated(name)}; choose held_out, "
            f"{' or '.join(known)}"
        )
    camera = cameras[name].single(0)
    for x, y in pixels:
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise DevrfError(
                f"export.pixels: [{x:g}, {y:g}] is outside of the image of {name}, of "
                f"{camera.width}x{camera.height} px; give x and y from its top left corner"
            )
    points, opacity = shown_points(Renderer(model), camera, torch.tensor(pixels), time)
    for (x, y), share in zip(pixels, opacity.tolist(), strict=True):
        if share <= SOLID:
            raise DevrfError(
                f"export.pixels: [{x:g}, {y:g}] of {name} shows nothing at time {time:g}; give a "
                "pixel that shows something"
            )
    return points
