"""Videos of all rows of a scene side by side, put together from the runs' own videos."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
from PIL import Image, ImageDraw

from devrf.apps.lettering import fitted_font
from devrf.apps.report.table import Table

# What each run's video of the held-out views shows from left to right: truth, rendering, depth.
COLUMNS, TRUTH, RENDERED = 3, 0, 1
BAND, MARGIN = 22, 4  # pixels: above each picture for its label, and between them
Frames = list[np.ndarray]


def scene_film(table: Table, scene: str) -> Iterator[np.ndarray] | None:
    """Pictures (H, W, 3) uint8 of the truth and of each row's rendering while time runs.

    The first run of a row that has a video stands for it. Pictures have the size of the first
    row's, and as many frames as the shortest video.

    Returns:
        None where fewer than two rows have a video.
    """
    runs = table.runs[table.runs["scene"] == scene]
    videos = {str(label): _video(group) for label, group in runs.groupby("label", sort=False)}
    shown = {label: video for label, video in videos.items() if video is not None}
    return _pictures(shown) if len(shown) > 1 else None


def _video(runs: pd.DataFrame) -> Path | None:
    """The held-out video of the first of these runs that has one."""
    paths = (Path(folder) / "videos" / "held_out.mp4" for folder in runs["path"])
    return next((path for path in paths if path.is_file()), None)


def _pictures(videos: Mapping[str, Path]) -> Iterator[np.ndarray]:
    films = {label: list(iio.imiter(path)) for label, path in videos.items()}
    count = min(map(len, films.values()))
    first = next(iter(films.values()))
    size = _column(first[0], RENDERED).size
    for index in range(count):
        tiles = {"truth": _column(_at(first, index, count), TRUTH)}
        for label, film in films.items():
            tiles[label] = _column(_at(film, index, count), RENDERED).resize(size)
        yield _page(tiles)


def _at(film: Frames, index: int, count: int) -> np.ndarray:
    """The picture of a film at the time of picture ``index`` of ``count``."""
    return film[round(index * (len(film) - 1) / max(count - 1, 1))]


def _column(picture: np.ndarray, column: int) -> Image.Image:
    width = picture.shape[1] / COLUMNS
    return Image.fromarray(picture[:, round(column * width) : round((column + 1) * width)])


def _page(tiles: Mapping[str, Image.Image]) -> np.ndarray:
    """Tiles in a nearly square grid, the label above each."""
    width, height = next(iter(tiles.values())).size
    across = math.ceil(math.sqrt(len(tiles) * (height + BAND) / width))
    down = math.ceil(len(tiles) / across)
    page = Image.new("RGB", (across * (width + MARGIN), down * (height + BAND + MARGIN)), "white")
    pen = ImageDraw.Draw(page)
    for place, (label, tile) in enumerate(tiles.items()):
        x, y = place % across * (width + MARGIN), place // across * (height + BAND + MARGIN)
        pen.text(
            (x + width / 2, y + BAND / 2),
            label,
            "black",
            fitted_font(label, BAND // 2, width),
            "mm",
        )
        page.paste(tile, (x, y + BAND))
    return np.asarray(page)
