"""Cells, means, marks and averages, by hand."""

from __future__ import annotations

import pytest

from devrf.reporting.columns import (
    COLUMNS,
    GPU,
    LPIPS,
    PSNR,
    SSIM,
    TIME,
    Cell,
    cell,
    ranked,
    shown,
)
from devrf.reporting.runs import collect
from devrf.reporting.table import tabulate


@pytest.fixture
def table(runs):
    """``table(…)``: the table of what lies in the folder."""
    return lambda *published: tabulate(collect(runs), *published)


def texts(row):
    return [cell.text for cell in row.cells]


def ranks(rows, column):
    return [row.cells[COLUMNS.index(column)].rank for row in rows]


@pytest.mark.parametrize(
    ("value", "column", "text"),
    [
        (29.4249, PSNR, "29.42"),
        (0.9765, SSIM, "0.977"),
        (0.00744, LPIPS, "0.0074"),
        (3.25, GPU, "3.2"),
        (0.31, TIME, "0.3 s"),
        (9.94, TIME, "9.9 s"),
        (9.96, TIME, "10 s"),
        (55.4, TIME, "55 s"),
        (99.6, TIME, "1.7 min"),
        (540, TIME, "9.0 min"),
        (22.4 * 3600, TIME, "22.4 h"),
    ],
)
def test_digits_are_the_papers_and_times_are_in_the_unit_that_reads_best(value, column, text):
    assert shown(value, column) == text


def test_seeds_are_averaged_with_their_spread():
    # 29, 30, 31: mean 30, sample standard deviation 1.
    assert cell([29.0, 30.0, 31.0], PSNR) == Cell(30.0, "30.00 ± 1.00")
    assert cell([240.0, 360.0], TIME) == Cell(300.0, "5.0 ± 1.4 min")  # 60·√2 s
    assert cell([29.0], PSNR) == Cell(29.0, "29.00")


def test_a_mean_of_fewer_seeds_than_the_row_has_is_not_shown():
    assert cell([29.0, None], PSNR) == Cell(None, "–")
    assert cell([None], LPIPS) == Cell(None, "–")


@pytest.mark.parametrize(
    ("values", "column", "expected"),
    [
        ([20, 24, 22, 21], PSNR, [None, 1, 2, 3]),
        ([0.3, 0.1, 0.2, 0.4], LPIPS, [3, 1, 2, None]),
        # Kuka's LPIPS in the paper: three methods share the best value.
        ([0.105, 0.0147, 0.0176, 0.0147, 0.0147], LPIPS, [3, 1, 2, 1, 1]),
        # What looks the same is the same.
        ([29.421, 29.419, 28], PSNR, [1, 1, 2]),
        ([None, 22, 21], PSNR, [None, 1, 2]),
        ([22], PSNR, [None]),
        ([22, 22], PSNR, [None, None]),
        ([None, None], PSNR, [None, None]),
        ([None, 22], PSNR, [None, None]),
    ],
)
def test_the_best_three_values_are_marked(values, column, expected):
    cells = [cell([value], column) for value in values]
    assert [c.rank for c in ranked(cells, column)] == expected


def test_a_block_by_hand(table, ran):
    ran("0", ablation="base", scores={"psnr": 20.068, "ssim": 0.834, "lpips": 0.2}, gpu=(1.0, 2.0))
    ran("1", ablation="c2f", scores={"psnr": 23.98, "ssim": 0.932}, seconds=(17, 60), gpu=(2.5, 2))
    ran("2", ablation="full", scores={"psnr": 29.42, "ssim": 0.977, "lpips": 0.1}, gpu=(1.0, 2.0))
    (block,) = table().blocks
    assert block.title == "robot" and block.published == ()
    assert [(row.label, *texts(row)) for row in block.measured] == [
        ("Ours (base)", "20.07", "0.834", "0.2000", "2.0", "30 s"),
        ("Ours w/ c2f", "23.98", "0.932", "–", "2.5", "77 s"),
        ("Ours w/ c2f, tv, cycle, flow", "29.42", "0.977", "0.1000", "2.0", "30 s"),
    ]
    assert ranks(block.measured, PSNR) == [3, 2, 1]
    assert ranks(block.measured, LPIPS) == [2, None, 1]
    assert ranks(block.measured, GPU) == [1, 2, 1]
    assert ranks(block.measured, TIME) == [1, 2, 1]


def test_times_of_different_devices_are_not_ranked(table, ran):
    ran("0", ablation="base", seconds=(1, 1))
    ran("1", seconds=(9, 9), device="another processor", scores={"psnr": 31})
    found = table()
    (block,) = found.blocks
    assert ranks(block.measured, TIME) == [None, None]
    assert ranks(block.measured, PSNR) == [2, 1]
    assert "Memory and time are marked only among rows of one device." in found.notes


def test_the_average_is_over_scenes_that_a_configuration_was_run_on(table, ran):
    for scene, psnr in (("robot", 30.0), ("flower", 33.0)):
        ran(f"{scene}_full", scene, scores={"psnr": psnr})
        ran(f"{scene}_base_0", scene, ablation="base", scores={"psnr": psnr - 10}, seed=0)
    ran("robot_base_1", ablation="base", scores={"psnr": 22.0}, seed=1)
    ran("robot_c2f", ablation="c2f")
    *scenes, average = table().blocks
    assert [block.title for block in scenes] == ["flower", "robot"]
    assert average.title == "average over 2 scenes"
    # Base: (23 + (20 + 22) / 2) / 2 = 22. c2f was run on the robot alone.
    assert [(row.label, row.cells[0].text, row.seeds) for row in average.measured] == [
        ("Ours (base)", "22.00", {1, 2}),
        ("Ours w/ c2f, tv, cycle, flow", "31.50", {1}),
    ]
    assert average.published == ()


def test_no_average_of_what_was_not_run_everywhere(table, ran):
    ran("a", "robot", ablation="base")
    ran("b", "flower", ablation="full")
    assert [block.title for block in table().blocks] == ["robot", "flower"]


def test_a_value_that_one_scene_lacks_has_no_average(table, ran):
    ran("a", "robot", scores={"lpips": 0.1})
    ran("b", "flower", scores={"lpips": None})
    assert table().blocks[-1].measured[0].cells[COLUMNS.index(LPIPS)].text == "–"


def test_published_rows_are_those_of_the_scenes_that_were_run(table, ran):
    ran("a", "lego")
    ran("b", "robot")
    lego, robot = table().blocks[:2]
    assert len(lego.published) == 17 and robot.published == ()
    assert texts(lego.published[0]) == ["5.958", "0.369", "0.8314", "19.4", "22.4hrs"]
    assert all(cell.rank is None for row in lego.published for cell in row.cells)
    assert not [block for block in table("none").blocks if block.published]
    everything = table("all").blocks
    assert [block.title for block in everything] == [
        "lego",
        "robot",
        "floating_robot",
        "daisy",
        "glove",
        "kuka",
        "pig_toy",
        "average over 2 scenes",
    ]
    assert everything[2].measured == () and len(everything[6].published) == 9


def test_published_rows_are_averaged_over_the_same_scenes(table, ran):
    for scene in ("lego", "pig_toy"):
        ran(scene, scene)
    average = table().blocks[-1].published
    rows = {row.label: texts(row) for row in average}
    # (29.25 + 30.85) / 2; (9 + 10) / 2 minutes.
    full = rows["DeVRF w/ c2f, tv, cycle, flow"]
    assert (full[0], full[-1]) == ("30.05", "9.5 min")
    assert "Neural Volumes" not in rows  # not in the table of pig toy


def test_a_column_that_nobody_has_is_explained(table, ran):
    ran("a")
    found = table()
    assert texts(found.blocks[0].measured[0])[2:4] == ["–", "–"]
    (lpips, gpu) = found.notes
    assert lpips.startswith("No run has LPIPS: ") and "evaluation.lpips_weights" in lpips
    assert gpu.startswith("No run has GPU (GB): ")


def test_what_was_scored_at_rest_only_is_named_and_not_tabulated(table, ran):
    ran("a")
    ran("still", scores={"psnr": None})
    found = table()
    assert len(found.rows) == 1
    assert "Scored at rest only, and therefore not in the tables: still." in found.notes
