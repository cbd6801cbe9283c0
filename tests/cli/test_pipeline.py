"""The main job, stage by stage and all at once, on a tiny embedded scene."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import imageio.v3 as iio
import pytest

MASKED = {"psnr_masked", "ssim_masked", "lpips_masked"}
FURTHER = {"ms_ssim", "lpips", "depth_error", "flow_error"} | MASKED
TRAINING = {"seconds", "iterations", "iterations_per_second", "peak_gpu_gb", "num_rollbacks"}
CANONICAL_KEYS = {"psnr", "ssim"} | TRAINING | FURTHER
DEFORMATION_KEYS = CANONICAL_KEYS | {"rest_pose_psnr", "checkpoint_mb"}


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_metrics_have_the_documented_keys(trained):
    folder, outcome = trained
    assert (outcome.status, outcome.err) == (0, "")
    found = metrics(folder)
    sections = {"static", "canonical", "dynamic", "deformation"}
    assert set(found) == {"scene", "method", "protocol", "run", *sections}
    assert (found["scene"], found["method"], found["protocol"]) == ("robot", "devrf", "two_stage")
    # DeVRF's sections have the names of its stages, too.
    assert found["static"] == found["canonical"] and found["dynamic"] == found["deformation"]
    assert set(found["canonical"]) == CANONICAL_KEYS
    assert set(found["deformation"]) == DEFORMATION_KEYS
    assert found["canonical"]["iterations"] == 6
    assert found["deformation"]["iterations"] == 12  # (2 + 2) for each of 3 frames
    assert found["deformation"]["checkpoint_mb"] == pytest.approx(
        (folder / "checkpoints" / "deformation.ckpt").stat().st_size / 1e6, abs=1e-3
    )


def test_what_is_known_of_an_embedded_scene_is_measured(trained):
    found = metrics(trained[0])
    for section in (found["canonical"], found["deformation"]):
        # 24 x 20 pixels are too few for MS-SSIM's scales.
        assert section["ms_ssim"] is None
        assert section["psnr_masked"] > 0 and section["ssim_masked"] < 1
        assert section["depth_error"] is None or section["depth_error"] > 0
    assert found["canonical"]["flow_error"] is None
    assert found["deformation"]["flow_error"] > 0


def test_a_run_says_how_it_came_about(trained):
    ran = metrics(trained[0])["run"]
    assert set(ran["execution"]) == {"canonical", "deformation"}
    for how in ran["execution"].values():
        assert (how["kernels"], how["graph_captures"], how["short_lists"]) == ("torch", 0, 0)
    assert ran["parameters"] > 1000 and ran["device"] and ran["torch"]
    assert ran["choices"]["data"] == "procedural" and ran["choices"]["ablation"] == "full"
    assert ran["choices"]["experiment"] is None and "hydra/launcher" not in ran["choices"]
    assert "data.frames=3" in ran["overrides"]
    assert (ran["seed"], ran["train_views"], ran["test_frames"]) == (0, 2, 3)
    found = metrics(trained[0])
    for stage in ("canonical", "deformation"):
        assert ran["wall_seconds"][stage] >= found[stage]["seconds"] > 0
        took = found[stage]["iterations"] / found[stage]["iterations_per_second"]
        assert took == pytest.approx(found[stage]["seconds"], abs=0.01)
    assert ran["wall_seconds"]["evaluate"] > 0


def test_every_frame_has_a_row(trained):
    with (trained[0] / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["capture"] for row in rows] == ["static"] * 2 + ["dynamic"] * 3
    assert [float(row["time"]) for row in rows[2:]] == [0, 0.5, 1]
    found = metrics(trained[0])["deformation"]
    for name in ("psnr", "ssim", "psnr_masked", "rest_pose_psnr"):
        mean = sum(float(row[name]) for row in rows[2:]) / 3
        assert mean == pytest.approx(found[name], rel=1e-4)
    assert rows[2]["flow_error"] == ""  # nothing comes before the first frame


def test_fewer_metrics_may_be_asked_for(devrf, tmp_path, tiny, trained):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    outcome = devrf(
        *tiny,
        "stage=evaluate",
        f"ckpt={checkpoint}",
        "hydra.run.dir=few",
        "evaluation.metrics=[psnr_masked]",
    )
    assert (outcome.status, outcome.err) == (0, "")
    assert "LPIPS" not in outcome.out
    found = metrics(tmp_path / "few")["canonical"]
    assert set(found) == CANONICAL_KEYS - FURTHER | {"psnr_masked"}


def test_everything_lies_in_the_run_folder(trained):
    folder, _ = trained
    made = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert {
        ".hydra/config.yaml",
        "run.log",
        "metrics.json",
        "frames.csv",
        "checkpoints/canonical.ckpt",
        "checkpoints/deformation.ckpt",
        "images/static.png",
        "images/dynamic.png",
        "images/training_canonical.png",
        "images/training_deformation.png",
        "videos/held_out.mp4",
        "videos/orbit.mp4",
    } <= made
    assert not [name for name in made if "partial" in name]


def test_pictures_and_videos_can_be_read(trained):
    folder, _ = trained
    sheet = iio.imread(folder / "images" / "dynamic.png")
    assert sheet.ndim == 3 and sheet.shape[2] == 3
    video = iio.imread(folder / "videos" / "held_out.mp4")
    assert len(video) == 4
    # Truth, rendering and depth, 48 x 40 px each, side by side below a line of text.
    assert video.shape[1:] == (18 + 40, 3 * 48 + 2 * 4, 3)


def test_stages_one_by_one_find_the_checkpoints_and_come_to_the_same(
    devrf, tmp_path, tiny, trained
):
    folder = tmp_path / "run"
    for stage in ("canonical", "deformation", "evaluate", "render"):
        outcome = devrf(*tiny, f"stage={stage}", f"hydra.run.dir={folder}")
        assert (outcome.status, outcome.err) == (0, "")
    assert (folder / "videos" / "orbit.mp4").is_file()
    ours, whole = metrics(folder), metrics(trained[0])
    # Each step ran by itself; the checkpoints say how long the earlier ones took.
    assert all(seconds > 0 for seconds in ours["run"]["wall_seconds"].values())
    for section in ("canonical", "deformation"):
        assert ours[section]["psnr"] == pytest.approx(whole[section]["psnr"], abs=0.01)


def test_the_canonical_stage_alone_can_be_scored(devrf, tmp_path, tiny):
    for stage in ("canonical", "evaluate"):
        outcome = devrf(*tiny, f"stage={stage}", "data.shape=flower", "ablation=c2f")
        assert (outcome.status, outcome.err) == (0, "")
    found = metrics(tmp_path / "outputs" / "flower" / "quickstart-c2f")
    assert list(found) == ["scene", "method", "protocol", "static", "canonical", "run"]
    assert found["run"]["wall_seconds"]["deformation"] is None


def test_a_checkpoint_from_elsewhere_is_scored(devrf, tmp_path, tiny, trained):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    outcome = devrf(*tiny, "stage=evaluate", f"ckpt={checkpoint}", "hydra.run.dir=scores")
    assert (outcome.status, outcome.err) == (0, "")
    scores, whole = metrics(tmp_path / "scores"), metrics(trained[0])
    assert {**scores, "run": None} == {**whole, "run": None}


def test_a_deformation_of_another_canonical_field_is_not_passed_off_as_its_own(
    devrf, tmp_path, tiny, trained
):
    folder = tmp_path / "retrained"
    shutil.copytree(trained[0], folder)
    assert devrf(*tiny, "stage=canonical", "seed=1", "hydra.run.dir=other").status == 0
    other = tmp_path / "other" / "checkpoints" / "canonical.ckpt"
    other.replace(folder / "checkpoints" / "canonical.ckpt")
    outcome = devrf(*tiny, "stage=evaluate", f"hydra.run.dir={folder}")
    assert outcome.status == 0
    assert "deformation.ckpt: left out, it belongs to another canonical.ckpt" in outcome.out
    assert not {"dynamic", "deformation"} & set(metrics(folder))
