"""Videos of a scene's rows side by side."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np

from devrf.apps.report.write import write_report
from devrf.apps.settings import ReportSettings

TRUTH, DEPTH = (40, 40, 40), (200, 200, 200)


def film(folder, colors, height=48):
    """A run's video of its held-out views: truth, rendering in some colour, depth."""
    (folder / "videos").mkdir()
    pictures = np.empty((len(colors), height, 3 * height, 3), np.uint8)
    for picture, color in zip(pictures, colors, strict=True):
        for column, shown in enumerate((TRUTH, color, DEPTH)):
            picture[:, column * height : (column + 1) * height] = shown
    iio.imwrite(folder / "videos" / "held_out.mp4", pictures, fps=10)


def test_each_row_is_a_tile_beside_the_truth_at_the_same_time(runs, ran):
    red, green, blue = (220, 30, 30), (30, 180, 30), (30, 30, 220)
    film(ran("a", method="devrf", protocol="two_stage"), [red, red, green])
    film(ran("b", method="dnerf", protocol="joint"), [blue, blue], height=64)
    ran("c", method="nsff", protocol="joint")  # filmed nothing
    text = write_report(ReportSettings(runs)).path.read_text(encoding="utf-8")
    assert "(<videos/side_by_side_robot.mp4>)" in text
    pictures = iio.imread(runs / "report" / "videos" / "side_by_side_robot.mp4")
    assert len(pictures) == 2  # as many as the shorter video
    # Labels stand above pictures of 48 pixels.
    for picture, first in zip(pictures, (red, green), strict=True):
        tiles = [picture[46, 24], picture[46, 76], picture[46, 128]]
        for found, wanted in zip(tiles, (TRUTH, first, blue), strict=True):
            assert np.abs(found.astype(int) - wanted).max() < 24


def test_one_filmed_row_needs_no_comparison(runs, ran):
    film(ran("a"), [(0, 0, 0)])
    ran("b", ablation="base")
    write_report(ReportSettings(runs))
    assert not (runs / "report" / "videos").exists()
