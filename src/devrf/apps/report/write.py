"""The report's files: collected, tabulated, plotted, filmed and written into one folder."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
import torch

from devrf.apps.report.plots import file_name, plots
from devrf.apps.report.runs import SKIPPED, collect
from devrf.apps.report.table import Table, tabulate
from devrf.apps.report.text import latex, markdown, plain
from devrf.apps.settings import ReportSettings
from devrf.errors import DevrfError
from devrf.pictures.figures import write_figure
from devrf.pictures.images import image_grid, scaled
from devrf.pictures.video_file import write_pictures
from devrf.system.files import refuse_links, write_text
from devrf.system.printed import csv_cell

log = logging.getLogger(__name__)

# Pictures a second of the videos that show rows side by side.
FPS = 10


def write_report(settings: ReportSettings) -> str:
    """Write ``report.md``, ``report.csv``, ``report.tex``, the plots and the videos.

    Returns:
        The tables for a terminal, and where the report is.

    Raises:
        DevrfError: no such folder, or nothing below it that a run left, or a link where the report
            is written; nothing is written.
    """
    collection = collect(Path(settings.runs))
    folder = settings.folder
    if collection.runs.empty and collection.failures.empty:
        why = f" ({collection.skipped[0]})" if collection.skipped else ""
        raise DevrfError(
            f"report.runs: no finished run below {settings.runs}{why}; give the folder of runs "
            "that were scored (stage=pipeline or stage=evaluate)"
        )
    refuse_links(folder, itself=settings.into is None)
    table = tabulate(collection)
    figures = _write_plots(table, folder)
    videos = _write_videos(table, folder)
    write_text(folder / "report.md", markdown(table, figures, videos))
    write_text(folder / "report.tex", latex(table))
    write_text(folder / "report.csv", csv(table))
    return f"{plain(table)}\nreport written to {folder / 'report.md'}"


def csv(table: Table) -> str:
    """A row for each run and failure, with all of ``metrics.json`` by dotted name."""
    runs = table.collection.runs.drop(columns=["path", "row"], errors="ignore").copy()
    runs.insert(3, "row", table.runs["label"])
    failures = table.collection.failures.drop(columns="path")
    rows = pd.concat([runs, failures], ignore_index=True)
    rows = rows.map(_csv_cell).rename(columns=csv_cell)
    return str(rows.to_csv(index=False, lineterminator="\n"))


def _csv_cell(value: object) -> str:
    """Text as it was recorded: a column of integers stays one where some are unknown."""
    if isinstance(value, list):
        return csv_cell(" ".join(map(str, value)))
    if isinstance(value, bool):
        return str(value).lower()
    return "" if pd.isna(value) else csv_cell(str(value))


def _write_plots(table: Table, folder: Path) -> dict[str, str]:
    """Write the plots as PNG and PDF; returns links to the former, by their captions."""
    links: dict[str, str] = {}
    for plot in plots(table):
        for suffix in (".png", ".pdf"):
            write_figure(folder / "figures" / f"{plot.name}{suffix}", plot.figure)
        links[plot.shows] = f"figures/{plot.name}.png"
    return links


def _write_videos(table: Table, folder: Path) -> dict[str, str]:
    """Write a video of all rows for each scene that has several; links as of the plots."""
    links: dict[str, str] = {}
    for scene in table.runs["scene"].unique():
        pictures = scene_video(table, scene)
        if pictures is not None:
            name = f"{file_name(f'side_by_side_{scene}')}.mp4"
            write_pictures(folder / "videos" / name, pictures, FPS)
            links[f"{scene}: truth and renderings side by side"] = f"videos/{name}"
    return links


# Columns of each run's video of the held-out views: truth, rendering, depth.
COLUMNS = 3


def scene_video(table: Table, scene: str) -> Iterator[np.ndarray] | None:
    """Pictures (H, W, 3) uint8 of the truth and of each row's rendering while time runs.

    The first run of a row that has a video stands for it. Pictures have the size of the first
    row's truth. There are as many pictures as frames in
    the shortest video. None if fewer than two rows have a video.
    """
    runs = table.runs[table.runs["scene"] == scene]
    videos = dict[str, tuple[Path, int]]()
    for label, folder in zip(runs["label"], runs["path"], strict=True):
        path = Path(folder) / "videos" / "held_out.mp4"
        if label not in videos and path.is_file() and (count := _frame_count(path)):
            videos[label] = path, count
    return _pictures(videos) if len(videos) > 1 else None


def _frame_count(path: Path) -> int:
    """The number of readable frames of a video; a line in the log if there is none."""
    try:
        with path.open("rb") as file:
            if file.read(8)[4:] != b"ftyp":  # FFmpeg would follow what a list of files says
                raise ValueError
        return sum(1 for _ in iio.imiter(path))
    except Exception:  # what decoders raise depends on the damage
        log.warning(SKIPPED, path)
        return 0


def _pictures(videos: Mapping[str, tuple[Path, int]]) -> Iterator[np.ndarray]:
    times = np.linspace(0, 1, min(count for _, count in videos.values()))
    streams = (
        _frames_at([round(time * (count - 1)) for time in times], path)
        for path, count in videos.values()
    )
    across = math.ceil(math.sqrt(1 + len(videos)))
    for frames in zip(*streams, strict=True):
        columns = [torch.from_numpy(frame).tensor_split(COLUMNS, dim=1) for frame in frames]
        truth = columns[0][0]
        tiles = [truth, *(scaled(rendering, *truth.shape[:2]) for _, rendering, _ in columns)]
        tiles += [torch.full_like(truth, 255)] * (-len(tiles) % across)
        names = ["truth", *videos, *[""] * len(tiles)]
        rows = (slice(k, k + across) for k in range(0, len(tiles), across))
        yield torch.cat([image_grid([tiles[row]], names[row]) for row in rows]).numpy()


def _frames_at(positions: Iterable[int], path: Path) -> Iterator[np.ndarray]:
    """A video's frames at increasing ``positions``, of which one at a time is in memory."""
    frames = enumerate(iio.imiter(path))
    at, frame = next(frames)
    for position in positions:
        while at < position:
            at, frame = next(frames)
        yield frame
