"""The report's files: collected, tabulated, plotted, filmed and written into one folder."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, repeat
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
from PIL import Image, ImageDraw

from devrf.apps.report.plots import file_name, plots
from devrf.apps.report.runs import SKIPPED, collect
from devrf.apps.report.table import Table, tabulate
from devrf.apps.report.text import latex, markdown, plain
from devrf.apps.settings import ReportSettings
from devrf.errors import DevrfError
from devrf.pictures.figures import write_figure
from devrf.pictures.video_file import fitted_font, write_pictures
from devrf.system.files import refuse_links, write_text
from devrf.system.printed import csv_cell

log = logging.getLogger(__name__)

# Pictures a second of the videos that show rows side by side.
FPS = 10
# Frames of a run's video that are read, pixels of each, and of all, at most.
LONGEST = 2000
LARGEST = 8192 * 4320
MOST_PIXELS = 2**31
# Columns of each run's video of the held-out views, from the left: truth, rendering, depth.
COLUMNS = 3
TRUTH = 0
RENDERED = 1
# Pixels above each picture for its label, and between pictures.
BAND = 22
MARGIN = 4


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
    links = _write_plots(table, folder) | _write_videos(table, folder)
    write_text(folder / "report.md", markdown(table, links))
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
    """Write a video of all rows for each scene; returns links as of the plots.

    The first run of a name that has a video stands for it; a scene needs two of them.
    """
    links: dict[str, str] = {}
    for scene, runs in table.runs.groupby("scene", sort=False):
        videos = dict[str, tuple[Path, int]]()
        for label, run in zip(runs["label"], runs["path"], strict=True):
            path = Path(run) / "videos" / "held_out.mp4"
            if label not in videos and path.is_file() and (count := _frame_count(path)):
                videos[label] = path, count
        if len(videos) > 1:
            link = f"videos/{file_name(f'side_by_side_{scene}')}.mp4"
            write_pictures(folder / link, _pictures(videos), FPS)
            links[f"{scene}: truth and renderings side by side"] = link
    return links


def _frame_count(path: Path) -> int:
    """The number of frames of a video to read; 0, with a line in the log, for none."""
    try:
        with path.open("rb") as file:
            if file.read(8)[4:] != b"ftyp":  # FFmpeg would follow what a list of files says
                raise ValueError
        size = math.prod(iio.immeta(path)["size"])
        if size > LARGEST:
            raise ValueError
        most = min(LONGEST, MOST_PIXELS // size)
        return sum(1 for _ in islice(iio.imiter(path), most))
    except Exception:  # what decoders raise depends on the damage
        log.warning(SKIPPED, path)
        return 0


def _pictures(videos: Mapping[str, tuple[Path, int]]) -> Iterator[np.ndarray]:
    """Pictures (H, W, 3) uint8 of the truth and of each row's rendering while time runs.

    They have the size of the first row's truth. There are as many as frames in the shortest video.
    """
    times = np.linspace(0, 1, min(count for _, count in videos.values()))
    streams = (
        _frames_at([round(time * (count - 1)) for time in times], path)
        for path, count in videos.values()
    )
    for frames in zip(*streams, strict=True):
        truth = _column(frames[0], TRUTH)
        renderings = (_column(frame, RENDERED).resize(truth.size) for frame in frames)
        yield _page({"truth": truth, **dict(zip(videos, renderings, strict=True))})


def _frames_at(positions: Sequence[int], path: Path) -> Iterator[np.ndarray]:
    """A video's frames at increasing ``positions``, of which one at a time is in memory."""
    for k, frame in enumerate(islice(iio.imiter(path), positions[-1] + 1)):
        yield from repeat(frame, positions.count(k))


def _column(picture: np.ndarray, column: int) -> Image.Image:
    """A column of a video's frame."""
    width = picture.shape[1] / COLUMNS
    return Image.fromarray(picture[:, round(column * width) : round((column + 1) * width)])


def _page(tiles: Mapping[str, Image.Image]) -> np.ndarray:
    """Tiles in a nearly square grid, the label above each."""
    width, height = next(iter(tiles.values())).size
    across = math.ceil(math.sqrt(len(tiles) * (height + BAND) / width))
    down = math.ceil(len(tiles) / across)
    page = Image.new("RGB", (across * (width + MARGIN), down * (height + BAND + MARGIN)), "white")
    pen = ImageDraw.Draw(page)
    for number, (label, tile) in enumerate(tiles.items()):
        x = number % across * (width + MARGIN)
        y = number // across * (height + BAND + MARGIN)
        font = fitted_font(label, BAND // 2, width)
        pen.text((x + width / 2, y + BAND / 2), label, "black", font, "mm")
        page.paste(tile, (x, y + BAND))
    return np.asarray(page)
