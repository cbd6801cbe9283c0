"""Which runs share a row, and what rows are called."""

from __future__ import annotations

import pytest

from devrf.apps.report.labels import labelled
from devrf.apps.report.runs import collect

FULL = "Ours w/ c2f, tv, cycle, flow"


@pytest.fixture
def rows(runs):
    """``rows()``: (scene, label, folders) of each row of what lies in the folder."""

    def read():
        groups = labelled(collect(runs).runs).groupby(["scene", "label"], sort=False)
        return [(*key, list(folders)) for key, folders in groups["folder"]]

    return read


@pytest.fixture
def labels(rows):
    return lambda: [label for _, label, _ in rows()]


def test_ablations_are_called_and_ordered_as_in_the_paper(labels, ran):
    for k, ablation in enumerate(("full", "c2f_tv", "base", "c2f_tv_cycle", "c2f", "no_tv", None)):
        ran(str(k), ablation=ablation)
    c2f = "Ours w/ c2f"
    known = ["Ours (base)", c2f, f"{c2f}, tv", f"{c2f}, tv, cycle", FULL]
    assert labels() == [*known, "Ours (no_tv)", "Ours"]


@pytest.mark.parametrize(
    ("one", "other", "endings"),
    [
        ({"choices": {"field": "a"}}, {"choices": {"field": "b"}}, ["; field=a", "; field=b"]),
        ({"train_views": 1}, {"train_views": 2}, ["; 1 view", "; 2 views"]),
        ({"device": "GPU"}, {"device": "CPU"}, ["; on GPU", "; on CPU"]),
        ({"protocol": "joint"}, {}, ["; joint", "; two_stage"]),
        ({"choices": {"method": "devrf_big"}}, {}, ["; method=devrf_big", ""]),
    ],
)
def test_two_different_runs_never_share_a_row(labels, ran, one, other, endings):
    ran("a", seed=0, **one)
    ran("b", seed=1, **other)
    assert labels() == [FULL + ending for ending in endings]


def test_methods_have_rows_of_their_own_after_ours(labels, ran):
    ran("a", method="nsff", protocol="dynamic")
    ran("b", method="dnerf", protocol="joint")
    ran("c", method="mine", protocol="joint", ablation="small")
    ran("d")
    ran("e", method="dnerf", protocol="dynamic")
    others = ["D-NeRF; joint", "D-NeRF; dynamic", "NSFF; dynamic", "mine (small); joint"]
    assert labels() == [f"{FULL}; two_stage", *others]


SETTINGS = {"data.frames": 14, "data.width": 96, "data.near": None, "seed": 0}


@pytest.fixture
def learned(ran):
    """``learned(name, settings, …)``: leaves a run that records its settings."""

    def write(name, settings=(), seed=0, **how):
        own = {**SETTINGS, **dict(settings), "seed": seed}
        ran(name, seed=seed, settings=own, **how)

    return write


def test_equal_runs_share_a_row_whatever_was_typed(rows, learned):
    learned("a")
    learned("b", seed=1, choices={"experiment": "quickstart"}, overrides=["data.width=96"])
    learned("b/previous-1", overrides=["resume=false", "ckpt=x"], choices={"field": "small"})
    learned("c", ablation="base", overrides=["seed=3", "data.frames=14"], seed=3)
    assert rows() == [("robot", "Ours (base)", ["a", "b", "b/previous-1", "c"])]


@pytest.mark.parametrize(
    ("one", "other", "endings"),
    [
        ({"data.width": 48}, {}, ["; data.width=48", "; data.width=96"]),
        ({"data.near": 0.5}, {}, ["; data.near=0.5", "; data.near=null"]),
        ({"data.sides": [4, 8]}, {}, ["; data.sides=[4, 8]", ""]),
    ],
)
def test_unequal_runs_say_what_differs(labels, learned, one, other, endings):
    # Not what was typed, and not the name of an experiment that has the defaults.
    learned("a", one, choices={"experiment": "quickstart"})
    learned("b", other, choices={"experiment": None}, seed=1)
    assert labels() == [FULL + ending for ending in endings]


def test_every_typed_difference_is_said_with_the_digits_that_it_needs(labels, ran):
    for k, (tv, cycle) in enumerate(((0.12345678, 1.0), (0.1234999, 10.0))):
        # The rate follows from the name of the schedule.
        settings = {"loss.tv": tv, "loss.cycle": cycle, "schedule.rate": k, "data.width": 48 * k}
        typed = [f"+loss.tv={tv}", f"loss={{cycle: {cycle}}}", "data.width=1", f"schedule={k}"]
        size = {"image_size": [48 * k, 40], "frames": 50 - k}
        ran(str(k), settings=settings, overrides=typed, **size, choices={"schedule": f"s{k}"})
    assert labels() == [
        f"{FULL}; 50 frames; 0×40; schedule=s0; loss.tv=0.12346; loss.cycle=1",
        f"{FULL}; 49 frames; 48×40; schedule=s1; loss.tv=0.1235; loss.cycle=10",
    ]


def test_a_scene_at_rest_is_one_of_its_own_without_ablations(rows, ran):
    ran("a", ablation="base", at_rest=True, settings={})
    ran("b", ablation="c2f", at_rest=True, settings={})
    ran("c", ablation="base")
    assert rows() == [
        ("robot (at rest)", "Ours", ["a", "b"]),
        ("robot", "Ours (base)", ["c"]),
    ]


def test_a_name_for_the_settings_is_said_where_all_equal_runs_have_it(labels, learned):
    for k, schedule in enumerate(("quick", "paper")):
        for seed in (0, 1):
            width = {"schedule.side": k, "data.width": 96 + k}
            learned(f"{k}{seed}", width, seed=seed, choices={"schedule": schedule})
    assert labels() == [f"{FULL}; schedule=quick", f"{FULL}; schedule=paper"]
