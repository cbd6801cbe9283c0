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
        groups = labelled(collect(runs).runs).groupby(["scene", "label", "identity"], sort=False)
        return [(scene, label, list(f)) for (scene, label, _), f in groups["folder"]]

    return read


@pytest.fixture
def labels(rows):
    return lambda: [label for _, label, _ in rows()]


def test_ablations_are_called_as_in_the_paper(labels, ran):
    for k, ablation in enumerate(("base", "c2f", "c2f_tv", "c2f_tv_cycle", None, "no_tv")):
        ran(str(k), ablation=ablation)
    c2f = "Ours w/ c2f"
    known = ["Ours (base)", c2f, f"{c2f}, tv", f"{c2f}, tv, cycle", FULL]
    assert labels() == [*known, "Ours (no_tv)"]


def test_methods_have_rows_of_their_own_after_ours(labels, ran):
    ran("a", method="nsff", protocol="dynamic")
    ran("b", method="dnerf", protocol="joint", choices={"experiment": "peer_small"})
    ran("c", method="mine", protocol="joint", ablation="small")
    ran("d", choices={"experiment": "best_small"})
    ran("e", method="dnerf")
    ran("f", choices={"experiment": "quickstart"})
    ran("g", method="Splats (pictures)", predictions="/elsewhere")
    others = ["D-NeRF; joint; peer_small", "D-NeRF; two_stage", "NSFF; dynamic"]
    # DeVRF without an experiment learns as by the quickstart, and in two stages.
    assert labels() == [
        f"{FULL}; best_small",
        FULL,
        *others,
        "mine (small); joint",
        "Splats (pictures)",
    ]


def test_pictures_of_another_program_say_which_images_they_are_of(labels, ran):
    method = "Splats (pictures)"
    typed = ["stage=evaluate", "data.root=/a", "evaluation.predictions=/b", "+data.downscale=8"]
    ran("a", method=method, predictions="/b", settings={}, overrides=typed[:3])
    ran("b", method=method, predictions="/b", settings={}, overrides=typed)
    assert labels() == [method, f"{method}; data.downscale=8"]


SETTINGS = {"data.frames": 14, "loss.tv": 0.5, "data.near": None, "seed": 0, "schedule.seconds": 9}


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("loss.tv=0.12345678", "; loss.tv=0.12345678"),
        ("+data.near=null", "; data.near=null"),
        ("schedule=quick", "; schedule=quick"),
        ("method=devrf_big", "; method=devrf_big"),
        ("method=devrf", ""),
        # Neither how it is watched, nor what the titles say, nor what has a part of its own.
        ("video.frames=1", ""),
        ("data.root=/a", ""),
        ("data=inward", ""),
        ("seed=0", ""),
        ("schedule.seconds=9", ""),
        ("ablation=full", ""),
    ],
)
def test_what_was_typed_is_in_the_name_whatever_other_rows_there_are(labels, ran, typed, said):
    ran("a", settings=SETTINGS, overrides=[typed])
    assert labels() == [FULL + said]
    ran("b", settings={**SETTINGS, "loss.tv": 0.7}, overrides=["loss.tv=0.7"])
    assert labels() == [FULL + said, f"{FULL}; loss.tv=0.7"]


@pytest.mark.parametrize(
    ("one", "other", "count"),
    [
        ({"settings": {"loss.tv": 1.0}}, {"settings": {"loss.tv": 2.0}}, 2),
        ({"settings": {"data.near": None}}, {"settings": {}}, 2),
        ({"train_views": 1}, {"train_views": 2}, 2),
        ({"device": "GPU"}, {"device": "CPU"}, 2),
        ({"git": "a"}, {"git": "b"}, 2),
        ({"settings": {"seed": 1}, "seed": 1}, {"settings": {"seed": 2}, "seed": 2}, 1),
        ({"settings": {"objective": "a"}}, {"overrides": ["video.frames=1"], "settings": {}}, 1),
    ],
)
def test_two_different_runs_never_share_a_row(rows, ran, one, other, count):
    ran("a", **one)
    ran("a/previous-1", **other)
    folders = [folders for *_, folders in rows()]
    assert folders == [[["a", "a/previous-1"]], [["a"], ["a/previous-1"]]][count - 1]


def test_callbacks_that_decide_are_rows_of_their_own_and_in_their_names(rows, ran):
    usual = {"loss.tv": 1.0}
    ran("a", settings=usual)
    ran("b", settings={**usual, "callbacks.learning_rate_decay._target_": "ramp.RampedDecay"})
    ran("c", settings={**usual, "callbacks.es.patience": 1, "callbacks.divergence_guard": None})
    assert rows() == [
        ("robot", FULL, ["a"]),
        ("robot", f"{FULL}; callbacks.learning_rate_decay._target_=ramp.RampedDecay", ["b"]),
        ("robot", f"{FULL}; callbacks.es.patience=1; callbacks.divergence_guard=null", ["c"]),
    ]


def test_a_scene_at_rest_is_one_of_its_own_without_ablations(rows, ran):
    ran("a", ablation="base", at_rest=True, settings={})
    ran("b", ablation="c2f", at_rest=True, settings={})
    ran("c", ablation="base")
    assert rows() == [
        ("robot (at rest)", "Ours", ["a", "b"]),
        ("robot", "Ours (base)", ["c"]),
    ]


def test_a_name_is_one_line_of_few_letters(labels, ran):
    ran("a", settings={"loss.tv": 1}, overrides=["loss.tv=\x1b[2J" + "\u202e" * 9000])
    (label,) = labels()
    assert label.startswith(f"{FULL}; loss.tv=?[2J???") and len(label) == 258
