"""Tracks of chosen points: CSV, JSON, or USD."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import torch

from devrf.apps.export.geometry import ExportSettings, UpFrame
from devrf.apps.export.sequence import FRAME
from devrf.apps.export.usd import SceneFile
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.rendering.renderable import Renderable
from devrf.rendering.tracks import track
from devrf.system.files import atomic_write, write_json


def write_tracks(
    folder: Path,
    model: Renderable,
    viewpoints: Viewpoints,
    settings: ExportSettings,
    times: Sequence[float],
) -> Path:
    """Write where the points ``export.tracks``, given at rest, are at the times; the file.

    Points are in the capture's world; those of USD in metres with y up.

    Raises:
        DevrfError: the method follows no points.
    """
    offset = torch.tensor(viewpoints.offset, dtype=torch.float64)
    points = torch.tensor(settings.tracks, dtype=torch.float64) - offset
    tracks = track(model, points.float().to(model.device), 0.0, times)
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
        for code, of_time in zip(scene.codes, frame.points(tracks), strict=True):
            shape.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(of_time.numpy()), code)
        scene.write(path, {})
    return path
