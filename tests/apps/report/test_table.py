"""Cells, means, marks and averages, by hand."""

from __future__ import annotations

import pandas as pd
import pytest

from devrf.apps.report.table import GPU, LPIPS, PSNR, TIME, TITLES, published, ranked, shown
from devrf.apps.report.text import caption
from devrf.errors import DevrfError

FULL = "Ours w/ c2f, tv, cycle, flow"


def texts(block):
    """The texts of each row, by name."""
    return {name: [cell.text for cell in cells] for name, cells in block.cells.T.items()}


def ranks(block, column):
    return [cell.rank for cell in block.cells[column.heading]]


def paper(block):
    """The names of the paper's rows."""
    return [name for name in block.cells.index if name.startswith("†")]


@pytest.mark.parametrize(
    ("value", "column", "text"),
    [
        (29.4249, PSNR, "29.42"),
        (0.00744, LPIPS, "0.0074"),
        (9.96, TIME, "10 s"),
        (99.6, TIME, "1.7 min"),
        (22.4 * 3600, TIME, "22.4 h"),
    ],
)
def test_digits_are_the_papers_and_times_are_in_the_unit_that_reads_best(value, column, text):
    assert shown(value, column) == text


def test_seeds_are_averaged_with_their_spread_where_all_have_a_value(table, ran):
    # 29, 30, 31: mean 30, sample standard deviation 1. 240, 360 and 300 s: 5 ± 1 min.
    rows = [(29, 100, 0.1), (30, 220, 0.1), (31, 160, None)]
    for seed, (psnr, seconds, lpips) in enumerate(rows):
        scores = {"psnr": psnr, "lpips": lpips}
        ran(str(seed), scores=scores, seconds=(140, seconds), seed=seed)
    ((name, cells),) = texts(table().blocks[0]).items()
    assert name == f"{FULL} (n = 3)" and cells == [
        "30.00 ± 1.00",
        "0.950 ± 0.000",
        "–",
        "–",
        "5.0 ± 1.0 min",
    ]


def test_scores_of_what_moves_have_a_column_and_masks_of_two_rules_a_note(table, ran):
    ran("one", scores={"psnr_moving": 21.25}, motion_masks="exact")
    ran("other", ablation="base", scores={"psnr_moving": 20.0}, motion_masks="exact")
    assert next(iter(table().blocks)).cells["PSNR moving ↑"].map(lambda c: c.text).tolist() == [
        "21.25",
        "20.00",
    ]
    assert [cell.rank for cell in table().blocks[0].cells["PSNR moving ↑"]] == [1, 2]
    assert "no comparison" not in "".join(table().notes)
    ran("third", ablation="c2f", scores={"psnr_moving": 19.0}, motion_masks="given: /masks")
    notes = "".join(table().notes)
    differ = "the runs differ in motion masks (exact; given: /masks)."
    assert f"robot: no comparison of PSNR moving: {differ}" in notes
    assert {cell.rank for cell in table().blocks[0].cells["PSNR moving ↑"]} == {0}
    ran("fourth", scores={"psnr_moving": 23.25}, motion_masks="given: /masks")
    assert not any("(n = 2)" in name for name in texts(table().blocks[0]))


def test_novel_times_have_a_column_where_a_run_has_them(table, ran):
    ran("one", scene="lego", scores={"novel_times": {"psnr": 25.5}})
    ran("other", scene="lego", ablation="base")
    (block,) = table().blocks
    headings = ["PSNR ↑", "PSNR at novel times ↑", "SSIM ↑", "LPIPS ↓", "GPU (GB) ↓", "Time ↓"]
    assert list(block.cells) == headings
    assert texts(block).pop(FULL)[1] == "25.50"
    # The paper has no such column.
    assert {cells[1] for name, cells in texts(block).items() if name != FULL} == {"–"}


@pytest.mark.parametrize(
    ("values", "column", "expected"),
    [
        ([20, 24, 22, 21], PSNR, [0, 1, 2, 3]),
        # Kuka's LPIPS in the paper: three methods share the best value.
        ([0.105, 0.0147, 0.0176, 0.0147, 0.0147], LPIPS, [3, 1, 2, 1, 1]),
        # What looks the same is the same.
        ([29.421, 29.419, 28], PSNR, [1, 1, 2]),
        ([None, 22, 22], PSNR, [0, 0, 0]),
    ],
)
def test_the_best_three_values_are_marked(values, column, expected):
    assert list(ranked(pd.Series(values, dtype=float), column)) == expected


def test_a_block_by_hand(table, ran):
    ran("0", ablation="base", scores={"psnr": 20.068, "ssim": 0.834, "lpips": 0.2}, gpu=(1.0, 2.0))
    ran("1", ablation="c2f", scores={"psnr": 23.98, "ssim": 0.932}, seconds=(17, 60), gpu=(2.5, 2))
    ran("2", ablation="full", scores={"psnr": 29.42, "ssim": 0.977, "lpips": 0.1}, gpu=(1.0, 2.0))
    (block,) = table().blocks
    assert block.title == "robot"
    assert texts(block) == {
        "Ours (base)": ["20.07", "0.834", "0.2000", "2.0", "30 s"],
        "Ours w/ c2f": ["23.98", "0.932", "–", "2.5", "77 s"],
        FULL: ["29.42", "0.977", "0.1000", "2.0", "30 s"],
    }
    assert ranks(block, PSNR) == [3, 2, 1]
    assert ranks(block, LPIPS) == [2, 0, 1]
    assert ranks(block, GPU) == [1, 2, 1]
    assert ranks(block, TIME) == [1, 2, 1]
    ran("3", ablation="c2f_tv", device="another processor")
    found = table()
    # Of several devices nothing is ranked that depends on them.
    assert not any(ranks(found.blocks[0], TIME))
    differ = "the runs differ in device (a processor; another processor)."
    assert f"robot: no comparison of Time: {differ}" in found.notes


def test_it_says_what_scores_are_measured_with(table, ran):
    ran("0", scores={"psnr": 20.0})
    (note,) = (note for note in table().notes if "made smaller" in note)
    assert "INTER_AREA" in note and "colours in [0, 1]" in note and "LPIPS" not in note
    ran("1", scores={"psnr": 20.0, "lpips": 0.1}, lpips_network="alex")
    (note,) = (note for note in table().notes if "made smaller" in note)
    assert note.endswith("LPIPS is that of alex, on images in [-1, 1].")


def test_the_average_is_over_scenes_that_a_configuration_was_run_on(table, ran):
    for scene, psnr in (("robot", 30.0), ("flower", 33.0)):
        ran(f"{scene}_full", scene, scores={"psnr": psnr})
        ran(f"{scene}_a_base_0", scene, ablation="base", scores={"psnr": psnr - 10}, seed=0)
    ran("robot_base_1", ablation="base", scores={"psnr": 22.0}, seed=1)
    ran("robot_c2f", ablation="c2f")
    *scenes, average = table().blocks
    assert [block.title for block in scenes] == ["flower", "robot"]
    assert average.title == "average over 2 scenes"
    # Base: (23 + (20 + 22) / 2) / 2 = 22. c2f was run on the robot alone.
    psnr = {name: cells[0] for name, cells in texts(average).items()}
    assert psnr == {"Ours (base)": "22.00", FULL: "31.50"}
    assert ranks(average, PSNR) == [2, 1]
    # There is none over scenes that are not alike.
    ran("small", "bush", image_size=[24, 24])
    assert [block.title for block in table().blocks] == ["flower", "robot", "bush"]


def test_gains_are_over_three_scenes_or_more_and_name_the_worst(table, ran):
    found = {"robot": (30.0, 31.0), "flower": (33.0, 32.5), "bush": (27.0, 29.0)}
    for scene, (base, full) in found.items():
        ran(f"{scene}_base", scene, ablation="base", scores={"psnr": base}, seconds=(10, 20))
        ran(f"{scene}_full", scene, scores={"psnr": full}, seconds=(10, 50))
    # (1 − 0.5 + 2) / 3 = 0.83; twice the time in each.
    assert texts(table().blocks[-1]) == {
        "Ours (base)": ["30.00", "27.00", "+0.00", "+0.00 (bush)", "1.00×"],
        FULL: ["30.83", "29.00", "+0.83", "-0.50 (flower)", "2.00×"],
    }
    ran("room", "room", image_size=[24, 24])
    assert [block.title for block in table().blocks] == ["bush", "flower", "robot", "room"]


def test_a_multiple_of_time_is_unknown_where_a_scene_has_no_seconds(table, ran):
    for scene, seconds in (("robot", 20), ("flower", 20), ("bush", None)):
        ran(f"{scene}_base", scene, ablation="base")
        ran(f"{scene}_full", scene, seconds=(10, seconds))
    assert [cells[-1] for cells in texts(table().blocks[-1]).values()] == ["1.00×", "–"]


def test_published_rows_stand_below_runs_of_the_same_scene_and_data(table, ran):
    ran("a", "lego")
    ran("at_rest", "lego", at_rest=True)
    ran("b", "robot")
    ran("c", "kuka", benchmark=None)
    ran("d", "daisy", benchmark="devrf 2")
    found = table()
    lego, at_rest, robot, kuka, daisy = found.blocks
    assert (lego.title, at_rest.title) == ("lego", "lego (at rest)")
    assert len(paper(lego)) == 17
    assert not any(map(paper, (at_rest, robot, kuka, daisy)))
    said = "The paper's rows are of benchmark devrf 1, and left out: kuka, daisy."
    assert found.notes[-1] == said
    first = ["5.958", "0.369", "0.8314", "19.4", "22.4hrs"]
    assert texts(lego)["† Neural Volumes"] == first


def test_rows_of_different_benchmarks_are_no_rows_of_one_table(table, ran):
    ran("a", benchmark="embedded 1")
    ran("b", "lego")
    assert not any("no comparison" in note for note in table().notes)
    words = caption(table())
    assert "Benchmark embedded 1: robot. Benchmark devrf 1: lego." in words
    ran("c", scores={"psnr": 20.0})
    assert ranks(table().blocks[0], PSNR) == [0, 0]
    assert "Benchmark embedded 1" not in caption(table())
    differ = "the runs differ in benchmark (embedded 1; none)."
    assert f"robot: no comparison of PSNR, SSIM: {differ}" in table().notes
    ran("d", benchmark="embedded 2", scores={"psnr": 30.0})
    with pytest.raises(DevrfError, match=r"^report.runs: robot .* 1 \(a\) and .* 2 \(d\)"):
        table()


@pytest.mark.parametrize(
    ("key", "values", "said"),
    [
        ("image_size", ([48, 40], [24, 20]), "image size ([48, 40]; [24, 20])"),
        ("test_frames", (20, 10), "test frames (20; 10)"),
        ("exposure", (None, "equal"), "exposure (none; equal)"),
    ],
)
def test_scores_of_other_images_are_not_ranked(table, ran, key, values, said):
    one, other = values
    for scene in ("robot", "flower", "bush"):
        ran(f"{scene}_a", scene, scores={"psnr": 20.0}, **{key: one})
        ran(f"{scene}_b", scene, scores={"psnr": 22.0}, ablation="base", **{key: other})
    found = table()
    # Nor are their averages, and none gains over the other.
    assert [block.title for block in found.blocks][3:] == ["average over 3 scenes"]
    assert {rank for block in found.blocks for rank in ranks(block, PSNR)} == {0}
    differ = f"no comparison of PSNR, SSIM: the runs differ in {said}."
    assert f"bush, flower, robot: {differ}" in found.notes


def test_lpips_of_other_networks_is_not_ranked(table, ran):
    ran("a", scores={"lpips": 0.1}, lpips_network="alex")
    ran("b", scores={"lpips": 0.2, "psnr": 20.0}, ablation="base", lpips_network="vgg")
    found = table()
    assert set(ranks(found.blocks[0], LPIPS)) == {0} and set(ranks(found.blocks[0], PSNR)) == {1, 2}
    differ = "no comparison of LPIPS: the runs differ in lpips network (alex; vgg)."
    assert f"robot: {differ}" in found.notes


def test_scenes_with_other_numbers_of_images_are_averaged_and_ranked(table, ran):
    for scene, frames in (("robot", 20), ("flower", 10)):
        ran(f"{scene}_a", scene, scores={"psnr": 20.0}, test_frames=frames)
        ran(f"{scene}_b", scene, scores={"psnr": 22.0}, ablation="base", test_frames=frames)
    found = table()
    assert ranks(found.blocks[-1], PSNR) == [2, 1]
    assert not any("no comparison" in note for note in found.notes)


def test_rows_of_one_name_stay_apart_and_a_note_says_in_what_they_differ(table, ran):
    for k, (psnr, device) in enumerate(((20.0, "CPU"), (22.0, "CPU"), (30.0, "GPU"))):
        ran(str(k), scores={"psnr": psnr}, seed=k, device=device)
    found = table()
    assert list(found.rows["PSNR"]) == [21.0, 30.0] and len(found.rows.index.unique()) == 1
    assert f"robot: the rows called {FULL} differ in run.device (CPU; GPU)." in found.notes


def test_runs_scored_at_rest_only_are_named_and_not_tabulated(table, ran):
    ran("a")
    ran("b", scores={"psnr": None})
    ran("c", scores={"psnr": float("nan")})
    found = table()
    assert len(found.rows) == 1
    assert "Scored at rest only, and therefore not in the tables: b, c." in found.notes


def test_a_checkpoint_that_was_scored_twice_counts_once(table, ran):
    for k, psnr in enumerate((20.0, 21.0, 30.0)):
        date = f"2026-01-0{k + 1}T00:00:00+00:00"
        ran(str(k), scores={"psnr": psnr}, checkpoint="ab"[k == 2], date=date)
    found = table()
    assert list(found.rows["count"]) == [2] and list(found.rows["PSNR"]) == [25.5]
    assert any("same checkpoint: 0." in note for note in found.notes)


# The published rows are those of the paper, cell by cell.

SCENES = ("lego", "floating_robot", "daisy", "glove", "kuka")


def test_every_scene_and_method_of_the_three_tables_is_there():
    paper = published()
    counts = paper.texts.groupby("scene")["method"].nunique()
    assert counts.to_dict() == {**dict.fromkeys(SCENES, 17), "pig_toy": 9}
    assert paper.values.notna().all(axis=None) and paper.values.shape == (5 * 17 + 9, 5)


def test_single_cells_as_printed():
    def cells(*key):
        return tuple(published().texts.loc[key, TITLES])

    full = ("29.25", "0.964", "0.0250", "4.1", "9mins")
    assert cells("lego", "DeVRF w/ c2f, tv, cycle, flow") == full
    values = published().values.loc["lego"]
    assert list(values.loc["DeVRF (base)"]) == [17.83, 0.799, 0.206, 4.1, 480.0]
    assert values.loc["D-NeRF-2 stage", "Time"] == pytest.approx(18.5 * 3600)
    # Odd, between 0.996 and 0.996, but so it stands.
    assert cells("daisy", "DeVRF w/ c2f, tv") == ("38.55", "0.950", "0.0048", "4.2", "6mins")
    assert cells("kuka", "NSFF-dynamic") == ("18.59", "0.865", "0.1986", "15.7", "14.8hrs")
    assert cells("pig_toy", "DeVRF w/ c2f") == ("21.11", "0.956", "0.0595", "10.8", "8mins")
