"""Which runs share a row, and what rows are called."""

from __future__ import annotations

import pytest

from devrf.reporting.rows import rows_of
from devrf.reporting.runs import collect


@pytest.fixture
def rows(runs):
    """``rows()``: (scene, label, seeds) of each row of what lies in the folder."""

    def read():
        found = rows_of(collect(runs).runs)
        return [(row.scene, row.label, [run.setup.seed for run in row.runs]) for row in found]

    return read


def test_ablations_are_called_and_ordered_as_in_the_paper(rows, ran):
    for k, ablation in enumerate(("full", "c2f_tv", "base", "c2f_tv_cycle", "c2f")):
        ran(str(k), ablation=ablation, overrides=[f"ablation={ablation}"])
    assert rows() == [
        ("robot", "Ours (base)", [0]),
        ("robot", "Ours w/ c2f", [0]),
        ("robot", "Ours w/ c2f, tv", [0]),
        ("robot", "Ours w/ c2f, tv, cycle", [0]),
        ("robot", "Ours w/ c2f, tv, cycle, flow", [0]),
    ]


def test_runs_that_differ_in_the_seed_alone_share_a_row(rows, ran):
    for seed in (0, 1, 2):
        ran(str(seed), seed=seed, overrides=[f"seed={seed}", f"hydra.run.dir={seed}"])
    assert rows() == [("robot", "Ours w/ c2f, tv, cycle, flow", [0, 1, 2])]


def test_what_is_the_same_for_all_runs_of_a_scene_is_not_said(rows, ran):
    for k, shape in enumerate(("robot", "flower")):
        ran(
            str(k),
            shape,
            choices={"schedule": "quick"},
            train_views=4 - k,
            overrides=[f"data.shape={shape}", "field.width=16"],
        )
    label = "Ours w/ c2f, tv, cycle, flow"
    assert rows() == [("robot", label, [0]), ("flower", label, [0])]


@pytest.mark.parametrize(
    ("one", "other", "labels"),
    [
        (
            {"choices": {"schedule": "fast"}},
            {"choices": {"schedule": "paper"}},
            ["; schedule=fast", "; schedule=paper"],
        ),
        (
            {"choices": {"experiment": "quickstart"}},
            {"choices": {"experiment": None}},
            ["", "; experiment=quickstart"],
        ),
        ({"train_views": 1}, {"train_views": 2}, ["; 1 view", "; 2 views"]),
        ({"overrides": ["+loss.deformation.tv=0.5"]}, {}, ["", "; loss.deformation.tv=0.5"]),
        ({"test_frames": 3}, {"test_frames": 14}, ["; 14 held-out images", "; 3 held-out images"]),
        ({"device": "GPU"}, {"device": "CPU"}, ["; on CPU", "; on GPU"]),
        (
            {"git": "ab" * 20},
            {"git": "ab" * 20 + "-dirty"},
            ["; at ababababa", "; at ababababa-dirty"],
        ),
        ({"devrf": "1.0"}, {"devrf": "2.0"}, ["; devrf 1.0", "; devrf 2.0"]),
    ],
)
def test_two_different_runs_never_share_a_row(rows, ran, one, other, labels):
    ran("a", seed=0, **one)
    ran("b", seed=1, **other)
    full = "Ours w/ c2f, tv, cycle, flow"
    assert [label for _, label, _ in rows()] == [full + label for label in labels]


@pytest.mark.parametrize("seed", [0, None])
def test_the_same_seed_again_or_an_unknown_one_is_no_further_seed(rows, ran, seed):
    ran("a", seed=seed)
    ran("b", seed=seed)
    full = "Ours w/ c2f, tv, cycle, flow"
    assert [label for _, label, _ in rows()] == [f"{full}; a", f"{full}; b"]


def test_the_most_telling_difference_is_said_and_what_follows_from_it_is_not(rows, ran):
    ran(
        "a",
        choices={"experiment": "quickstart", "schedule": "quick", "field": "small"},
        overrides=["experiment=quickstart"],
    )
    ran(
        "b",
        choices={"experiment": "paper_inward", "schedule": "paper_inward", "field": "inward"},
        overrides=["experiment=paper_inward"],
    )
    full = "Ours w/ c2f, tv, cycle, flow"
    assert [label for _, label, _ in rows()] == [
        f"{full}; experiment=paper_inward",
        f"{full}; experiment=quickstart",
    ]


def test_how_a_run_is_watched_makes_no_row(rows, ran):
    ran("a", seed=0, choices={"logger": "csv"}, overrides=["video.frames=3"])
    ran("b", seed=1, choices={"logger": "wandb"}, overrides=["logger=wandb"])
    assert [seeds for _, _, seeds in rows()] == [[0, 1]]


def test_a_run_that_does_not_say_what_it_is_goes_by_its_folder(rows, ran, runs):
    ran("known")
    for name, scene in (("old/a", "robot"), ("old/b", "flower")):
        folder = ran(name, scene)
        text = (folder / "metrics.json").read_text().replace('"choices"', '"earlier"')
        (folder / "metrics.json").write_text(text)
    found = rows_of(collect(runs).runs)
    assert [(row.scene, row.label) for row in found] == [
        ("robot", "Ours w/ c2f, tv, cycle, flow"),
        ("robot", "Ours; old/a"),
        ("flower", "Ours; old/b"),
    ]
    # Nor is it taken for the same on another scene.
    assert len({row.identity for row in found}) == 3


def test_a_row_knows_its_views_and_its_method_without_them(ran, runs):
    for views in (1, 3):
        ran(str(views), train_views=views, overrides=[f"data.train_views={views}"])
    found = rows_of(collect(runs).runs)
    assert [row.views for row in found] == [1, 3]
    assert {row.method for row in found} == {"Ours w/ c2f, tv, cycle, flow"}


def test_an_ablation_of_ones_own_keeps_its_name(rows, ran):
    ran("a", ablation="no_tv")
    ran("b", ablation=None)
    assert [label for _, label, _ in rows()] == ["Ours", "Ours (no_tv)"]
