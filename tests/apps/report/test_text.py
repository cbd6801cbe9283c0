"""The same table as Markdown, plain text and LaTeX, read back."""

from __future__ import annotations

import re

import pytest

from devrf.apps.report.text import latex, markdown, plain

FULL = "Ours w/ c2f, tv, cycle, flow"
METRICS = ["PSNR ↑", "SSIM ↑", "LPIPS ↓", "GPU (GB) ↓", "Time ↓"]


@pytest.fixture
def pig_and_robot(table, ran):
    """Pig toy by three ablations, one of them with two seeds; and a run of the robot."""
    for k, (ablation, psnr, seed) in enumerate(
        [("base", 20.0, 0), ("c2f", 24.0, 0), ("full", 29.0, 0), ("full", 31.0, 1)]
    ):
        scores = {"psnr": psnr, "ssim": psnr / 40}
        ran(f"{k}_pig", "pig_toy", ablation=ablation, seed=seed, seconds=(k, 20), scores=scores)
    ran("robot", ablation="c2f", scores={"psnr": 25.0, "ssim": 0.9})
    return table


def rows_below(text, heading):
    """Cells of the Markdown table below a heading, without its rule."""
    section = text.split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line[1:-1].split(" | ")] for line in lines[:1] + lines[2:]]


def test_markdown_tables_read_back(pig_and_robot):
    text = markdown(pig_and_robot(), {})
    head, *rows = rows_below(text, "pig_toy")
    assert head == ["", *METRICS]
    assert rows[:3] == [
        ["Ours (base)", "*20.00*", "*0.500*", "–", "–", "**20 s**"],
        ["Ours w/ c2f", "<ins>24.00</ins>", "<ins>0.600</ins>", "–", "–", "<ins>21 s</ins>"],
        [f"{FULL} (n = 2)", "**30.00 ± 1.41**", "**0.750 ± 0.035**", "–", "–", "*22 ± 1 s*"],
    ]
    assert rows[3] == ["† D-NeRF", "31.23", "0.974", "0.0381", "12.4", "22.1hrs"]
    assert len(rows) == 3 + 9 and all(len(row) == 6 for row in rows)
    assert "NeurIPS 2022" in text and "- No run has LPIPS: " in text


def test_failures_are_listed_with_their_reason(pig_and_robot, failed, runs):
    failed("7_robot_frames_1", "data.frames: expected 2")
    failed("8_robot", "ZeroDivisionError: by zero", mistake=False)
    (runs / "9_robot").mkdir()
    (runs / "9_robot" / "metrics.json").write_text("{")
    found = pig_and_robot()
    first = "7_robot_frames_1: data.frames: expected 2"
    second = "8_robot: ZeroDivisionError: by zero (a fault of the program: see its run.log)"
    text = markdown(found, {})
    assert f"## Failed\n\n- {first}\n- {second}\n" in text
    assert f"## Skipped\n\n- {runs}/9_robot/metrics.json: skipped; it is damaged" in text
    assert f"failed: {first}\nfailed: {second}\n" in plain(found)
    assert f"% failed: {first}\n% failed: {second}\n" in latex(found)


def test_latex_has_a_table_a_scene(pig_and_robot):
    text = latex(pig_and_robot())
    assert text.isascii() and text.count("{") == text.count("}")
    pig, robot = text.split(r"\begin{tabular}{lrrrrr}")[1:]
    rows = [re.split(r" *(?<!\\)& *", line.strip()) for line in pig.splitlines() if "&" in line]
    assert len(rows) == 1 + 3 + 9 and {len(row) for row in rows} == {6}
    assert rows[2] == (
        ["Ours w/ c2f", r"\underline{24.00}", r"\underline{0.600}"]
        + ["--", "--", r"\underline{21 s} \\"]
    )
    assert rows[3][:2] == [f"{FULL} (n = 2)", r"\textbf{30.00 $\pm$ 1.41}"]
    assert rows[4][0] == r"$\dagger$ D-NeRF"
    assert r"}{!}{%" in text and r"\end{tabular}}" in text  # no wider than the page
    assert r"\caption{pig\_toy. Measured on" in text and r"\caption{robot. As above.}" in text
    assert re.search(r"^Ours w/ c2f +24.00² ", plain(pig_and_robot()), flags=re.MULTILINE)
