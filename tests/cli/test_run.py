"""The main job, stage by stage and all at once, on a tiny embedded scene."""

from __future__ import annotations

import csv
import json
import shlex
import shutil
from pathlib import Path

import imageio.v3 as iio
import pytest

from devrf import selfcheck
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.checkpoints.file_metadata import digest_of
from devrf.errors import DevrfError
from devrf.evaluation.objective import check_objective, objective
from devrf.scenes.export import export
from devrf.scenes.procedural import ProceduralScene

TRAINING = {"seconds", "iterations", "iterations_per_second", "peak_gpu_gb", "num_rollbacks"}
TRAINING |= {"lost_frames"}
FURTHER = {"ms_ssim", "lpips", "depth_error", "flow_error"}
NO_METRICS = "evaluation.metrics=[]"  # beside PSNR and SSIM
MASKED = {"psnr_masked", "ssim_masked", "lpips_masked", "ssim_covisible", "lpips_covisible"}
MOVING = {"psnr_moving", "ssim_moving", "lpips_moving"}
CANONICAL_KEYS = {"psnr", "ssim"} | TRAINING | FURTHER | MASKED | MOVING
DEFORMATION_KEYS = CANONICAL_KEYS | {"rest_pose_psnr", "flicker", "pck_t", "checkpoint_mb"}


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def scores(folder: Path) -> dict[str, float]:
    sections = metrics(folder)
    return {
        f"{section}.{name}": value
        for section in ("static", "dynamic")
        for name, value in sections[section].items()
        if value is not None and "second" not in name and name != "checkpoint_mb"
    }


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
    size = (folder / "checkpoints" / "deformation.ckpt").stat().st_size
    assert found["deformation"]["checkpoint_mb"] == pytest.approx(size / 1e6, abs=1e-3)
    # 24 x 20 pixels are too few for MS-SSIM's scales; the flow of what is at rest has no error.
    assert found["canonical"]["ms_ssim"] is None and found["canonical"]["flow_error"] is None
    assert found["deformation"]["psnr_masked"] > 0 and found["deformation"]["flow_error"] > 0
    # Of three frames the first is at rest: the two others are learned one by one.
    assert found["canonical"]["lost_frames"] is None and found["deformation"]["lost_frames"] == 0
    fitted = found["run"]["frame_psnr"]
    assert set(fitted) == {"deformation"} and len(fitted["deformation"]) == 2
    assert all(5 < psnr < 60 for psnr in fitted["deformation"])


def test_a_run_says_how_it_came_about(trained):
    found = metrics(trained[0])
    ran = found["run"]
    assert set(ran["execution"]) == {"canonical", "deformation"}
    assert ran["parameters"] > 1000 and ran["device"] and ran["torch"]
    assert ran["choices"]["data"] == "procedural" and ran["choices"]["ablation"] is None
    assert ran["choices"]["experiment"] is None and "hydra/launcher" not in ran["choices"]
    assert "data.frames=3" in ran["overrides"]
    assert (ran["seed"], ran["train_views"], ran["test_frames"], ran["frames"]) == (0, 2, 3, 3)
    assert (ran["kind"], ran["image_size"]) == ("inward", [24, 20])
    for stage in ("canonical", "deformation"):
        assert ran["wall_seconds"][stage] >= found[stage]["seconds"] > 0


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


def test_everything_lies_in_the_run_folder(trained):
    folder, _ = trained
    made = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    pictures = ("static", "dynamic", "training_canonical", "training_deformation")
    assert {
        *(".hydra/config.yaml", "run.log", "metrics.json", "frames.csv"),
        *("checkpoints/canonical.ckpt", "checkpoints/deformation.ckpt"),
        *(f"images/{name}.png" for name in pictures),
        *("videos/held_out.mp4", "videos/orbit.mp4", "export/scene.html"),
    } <= made
    assert not [name for name in made if "partial" in name]
    video = iio.imread(folder / "videos" / "held_out.mp4")
    # Truth, rendering and depth, 48 x 40 px each, side by side below a line of text.
    assert video.shape == (4, 18 + 40, 3 * 48 + 2 * 4, 3)


def test_the_last_lines_are_commands_that_work(devrf, tmp_path, trained):
    folder, outcome = trained
    lines = outcome.out.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("results:"))
    results = "(metrics.json, images, videos, checkpoints)"
    assert lines[at] == f"results: outputs/robot/quickstart {results}"
    assert lines[at + 1] == "the scene, for any browser: outputs/robot/quickstart/export/scene.html"
    commands = [shlex.split(line) for line in lines[at + 3 :]]
    assert [words[:3] for words in commands] == [["python", "-m", "devrf"]] * 3
    copy = tmp_path / "outputs" / "robot" / "quickstart"
    shutil.copytree(folder, copy)
    done = devrf(*commands[0][3:])
    assert (done.status, done.err) == (0, "")
    assert list(copy.glob("images/still*.png"))


def test_stages_one_by_one_come_to_the_same_in_another_process(warm, tmp_path, tiny, trained):
    for stage in ("canonical", "deformation", "evaluate"):
        outcome = warm(tmp_path, *tiny, "deterministic=true", f"stage={stage}", "hydra.run.dir=run")
        assert outcome.status == 0, outcome.out
    found = metrics(tmp_path / "run")
    assert all(seconds > 0 for seconds in found["run"]["wall_seconds"].values())
    expected = scores(trained[0])
    assert len(expected) > 8
    assert scores(tmp_path / "run") == pytest.approx(expected, abs=1e-6, rel=0)


def test_the_canonical_stage_alone_can_be_scored(devrf, tmp_path, tiny):
    for stage in ("canonical", "evaluate"):
        outcome = devrf(*tiny, f"stage={stage}", "data.shape=flower", "ablation=c2f", NO_METRICS)
        assert (outcome.status, outcome.err) == (0, "")
    found = metrics(tmp_path / "outputs" / "flower" / "quickstart-c2f")
    assert list(found) == ["scene", "method", "protocol", "static", "canonical", "run"]
    assert found["run"]["wall_seconds"]["deformation"] is None


def test_a_deformation_of_another_canonical_field_is_not_passed_off_as_its_own(
    devrf, tmp_path, tiny, trained
):
    folder = tmp_path / "retrained"
    shutil.copytree(trained[0] / "checkpoints", folder / "checkpoints")
    path = folder / "checkpoints" / "canonical.ckpt"
    content = read_checkpoint_file(path)
    content["devrf"]["records"] = {}  # the same field, learned another time
    write_checkpoint_file(path, content)
    outcome = devrf(*tiny, "stage=evaluate", f"hydra.run.dir={folder}", "evaluation.metrics=[]")
    assert outcome.status == 0
    assert "deformation.ckpt: left out, it belongs to another canonical.ckpt" in outcome.out
    assert not {"dynamic", "deformation"} & set(metrics(folder))
    assert outcome.out.count("left out") == 1
    outcome = devrf("stage=export", f"hydra.run.dir={folder}", "export.format=html")
    assert (outcome.status, outcome.err) == (0, "")
    page = (folder / "export" / "scene.html").read_text("utf-8")
    assert f'data-checkpoint="{digest_of(path)}"' in page


# What is done already


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the folder of a whole tiny run."""
    return Path(shutil.copytree(trained[0], tmp_path / "run"))


def stamps(run: Path) -> dict[str, int]:
    paths = [*run.glob("*.json"), *run.glob("*.csv"), *run.glob("images/*"), *run.glob("videos/*")]
    paths += run.glob("checkpoints/*")
    return {path.name: path.stat().st_mtime_ns for path in paths}


def test_a_finished_run_says_so_and_reads_nothing(devrf, tiny, run, monkeypatch):
    def unread(self):
        raise AssertionError("the scene was read")

    before = stamps(run)
    monkeypatch.setattr("devrf.data.rendered.ProceduralDataModule.load", unread)
    outcome = devrf(*tiny, "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    for stage in ("canonical", "deformation"):
        assert f"{stage}: learned already ({run}/checkpoints/{stage}.ckpt)" in outcome.out
    for step in ("evaluate", "render"):
        assert f"{step}: done already; stage={step} does it again" in outcome.out
    assert stamps(run) == before


def test_what_differs_or_is_missing_is_done(devrf, tiny, run):
    before = stamps(run)
    (run / "metrics.json").unlink()
    assert devrf(*tiny, "hydra.run.dir=run", "video.frames=3").status == 0
    scores = {"metrics.json", "frames.csv", "static.png", "dynamic.png"}
    redone = {name for name, stamp in stamps(run).items() if before.get(name) != stamp}
    assert redone == scores | {"held_out.mp4", "orbit.mp4"}


def test_a_film_by_path_leaves_the_others_alone(devrf, tiny, run, tmp_path):
    pose, keyframes = [1, 0, 0, 0, 0, 0, -1, -3, 0, 1, 0, 0, 0, 0, 0, 1], tmp_path / "walk.json"
    row = {"matrix": pose, "fov": 40, "aspect": 1.5, "render_time": 0, "seconds": 0}
    keyframes.write_text(json.dumps({"keyframes": [row, {**row, "seconds": 0.1}]}))
    by_path, before = (*tiny, "hydra.run.dir=run", f"video.path={keyframes}"), stamps(run)
    assert devrf(*by_path).status == 0
    assert {name: stamps(run)[name] for name in before} == before
    assert "render: done already" in devrf(*by_path).out
    # Other keyframes, another film.
    keyframes.write_text(keyframes.read_text().replace("40", "50"))
    assert "video written to" in devrf(*by_path).out


# The number that a run is judged by


def test_the_objective_is_looked_up():
    found = {"scene": "robot", "static": {"psnr": 30.0, "lpips": None}, "dynamic": {"psnr": 20.0}}
    for key, value in {
        **{"dynamic.psnr": 20.0, "static.psnr": 30.0, "static.lpips": None},
        # DeVRF's sections have the names of its stages, too.
        **{"deformation.psnr": 20.0, "canonical.psnr": 30.0},
        # Without a validation split the test views decide.
        "validation.psnr": 20.0,
    }.items():
        check_objective(key, ["lpips"])
        assert objective(key, found) == value
    # Where nothing moves the rest state is judged.
    assert objective("dynamic.psnr", {"static": {"psnr": 30.0}}) == 30.0
    assert objective("validation.psnr", {"static": {"psnr": 30.0}}) == 30.0
    assert objective("dynamic.rest_pose_psnr", {"static": {"psnr": 30.0}}) is None
    check_objective("dynamic.checkpoint_mb", [])
    assert objective("dynamic.checkpoint_mb", {"static": {"checkpoint_mb": 2.0}}) == 2.0
    assert objective("validation.psnr", {**found, "validation": {"psnr": 10.0}}) == 10.0


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (
            "run.seed",
            "objective: expected static.NAME, dynamic.NAME or validation.NAME, not 'run.seed'",
        ),
        ("validation.seconds", "objective: validation has no 'seconds'"),
        ("deformation.flow_error", "objective: deformation has no 'flow_error'"),
        ("static.rest_pose_psnr", "objective: static has no 'rest_pose_psnr'"),
        ("static.checkpoint_mb", "objective: static has no 'checkpoint_mb'"),
        ("static.lost_frames", "objective: static has no 'lost_frames'"),
    ],
)
def test_any_other_objective_is_an_error(key, said):
    with pytest.raises(DevrfError) as caught:
        check_objective(key, ["lpips"])
    assert str(caught.value).startswith(said)


@pytest.fixture(scope="module")
def with_validation(tmp_path_factory) -> Path:
    """A moving scene whose validation split is of other views than its test split."""
    root = tmp_path_factory.mktemp("judged") / "robot"
    sizes = {"width": 24, "height": 18, "static_views": 6, "static_test_views": 2}
    export(ProceduralScene(shape="robot", train_views=2, frames=3, supersample=1, **sizes)(), root)
    file = root / "dynamic_2views" / "transforms_val.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 0.5
    file.write_text(json.dumps(content))
    return root


def test_validation_views_are_scored_where_the_objective_is_theirs(
    devrf, tmp_path, short, with_validation
):
    where = ("data=inward", f"data.root={with_validation}", "hydra.run.dir=run")
    command = (*where, *short, NO_METRICS, "video.frames=1")
    by_test = devrf(*command)
    assert (by_test.status, by_test.err) == (0, "")
    before, run = metrics(tmp_path / "run"), tmp_path / "run"
    assert "validation" not in before
    # A run that was scored already is scored again, and no more than that is done again.
    asked = devrf(*command, "objective=validation.psnr")
    assert (asked.status, asked.err) == (0, "")
    assert "deformation: learned already" in asked.out and "render: done already" in asked.out
    found = metrics(run)
    assert set(found["validation"]) == {"psnr", "ssim", "flicker", "images"}
    assert found["validation"]["images"] == 3
    assert found["validation"]["psnr"] != found["dynamic"]["psnr"]
    # Neither the scene nor its test scores are others for it.
    assert found["run"]["fingerprint"] == before["run"]["fingerprint"]
    for section in ("static", "dynamic"):
        assert found[section] == before[section]
    assert "validation: psnr" in asked.out and "validation split" not in asked.out
    with (run / "frames.csv").open(newline="") as file:
        assert {row["capture"] for row in csv.DictReader(file)} == {"static", "dynamic"}
    again = devrf(*command, "objective=validation.ssim")
    assert "evaluate: done already" in again.out
    report = devrf("stage=report", "report.runs=run")
    assert report.status == 0 and f"{found['dynamic']['psnr']:.2f}" in report.out
    assert f"{found['validation']['psnr']:.2f}" not in report.out


def test_without_a_validation_split_one_line_says_so(devrf, tiny, run):
    (run / "metrics.json").unlink()  # what is left to do is to score
    done = devrf(*tiny, "hydra.run.dir=run", NO_METRICS, "objective=validation.psnr")
    assert (done.status, done.err) == (0, "")
    (said,) = [line for line in done.out.splitlines() if "no validation split" in line]
    assert said.endswith("robot: no validation split; the test views decide the objective")
    assert "validation" not in metrics(run)


# A scene at rest


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory) -> Path:
    """A scene whose static capture is all there is."""
    root = tmp_path_factory.mktemp("rest") / "statue"
    sizes = {"width": 24, "height": 18, "static_views": 6, "static_test_views": 3}
    export(ProceduralScene(shape="robot", train_views=2, frames=2, supersample=1, **sizes)(), root)
    (root / "dynamic_2views").rename(root.parent / "moving")
    return root


def test_the_pipeline_of_a_scene_at_rest_learns_no_motion(devrf, tmp_path, short, at_rest):
    where = ("data=inward", f"data.root={at_rest}", "hydra.run.dir=run")
    done = devrf(*where, *short, "objective=dynamic.psnr", "evaluation.metrics=[]")
    assert (done.status, done.err) == (0, "")
    assert "statue is at rest: canonical, evaluate, render, page; no motion is learned" in done.out
    run = tmp_path / "run"
    assert [path.name for path in (run / "checkpoints").glob("*.ckpt")] == ["canonical.ckpt"]
    found = metrics(run)
    assert found["at_rest"] is True and found["static"] == found["canonical"]
    assert "dynamic" not in found
    assert set(found["run"]["wall_seconds"]) == {"canonical", "evaluate"}
    assert len(iio.imread(run / "videos" / "held_out.mp4")) == 4
    report = devrf("stage=report", "report.runs=run")
    assert report.status == 0 and f"{found['static']['psnr']:.2f}" in report.out
    # Where nothing moves there are no times.
    assert "run stage=still still.height=400" in done.out and "still.time" not in done.out
    assert devrf(*where, *short, "stage=still", "still.height=20").status == 0
    assert (run / "images" / "still_held_out_h20.png").is_file()
    # Nothing is left to do: the scene, which may not be there any more, is not read again.
    at_rest.rename(at_rest.parent / "away")
    again = devrf(*where, *short, "objective=dynamic.psnr", "evaluation.metrics=[]")
    (at_rest.parent / "away").rename(at_rest)
    assert (again.status, again.err) == (0, "")
    assert "canonical: learned already" in again.out and "render: done already" in again.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["stage=deformation"], "stage=deformation: learns motion, but statue is at rest"),
        (
            ["method=dnerf", "protocol=joint"],
            "protocol=joint: learns from images in motion, but statue is at rest",
        ),
    ],
)
def test_what_needs_motion_is_refused(devrf, tmp_path, short, at_rest, arguments, said):
    small = () if "method=dnerf" in arguments else short
    done = devrf("data=inward", f"data.root={at_rest}", "trainer=cpu", *small, *arguments)
    assert done.status == 2 and done.err.startswith(f"devrf: {said}")
    assert len(done.err.splitlines()) == 1 and not (tmp_path / "outputs").exists()


# What comes before learning


def test_a_scene_is_described_and_drawn(devrf, tmp_path, tiny):
    outcome = devrf(*tiny, "stage=inspect", "data.static_views=16", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    for part in (
        *("robot, inward-facing", "static train", "24 x 20", "optical flow", "3 from 0 to 1"),
        *("GPU, deformation stage", "checkpoint", "no problems found", "inspect.png"),
    ):
        assert part in outcome.out
    assert iio.imread(tmp_path / "run" / "images" / "inspect.png").shape[1] == 1600
    assert "inward-facing" in (tmp_path / "run" / "run.log").read_text()


def test_a_mistake_in_footage_is_one_line_and_leaves_nothing(devrf, tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.apps.capture.pipeline.colmap", lambda: None)
    outcome = devrf("stage=capture", "capture.static=my walk (1).mp4", "capture.into=scene")
    expected = "devrf: my walk (1).mp4: no such video; correct capture.static or capture.views\n"
    assert (outcome.status, outcome.err) == (2, expected)
    assert not list(tmp_path.iterdir())


def test_every_check_of_the_machine_has_a_line_and_failures_end_with_status_2(
    devrf, tmp_path, monkeypatch
):
    def broken(scene):
        raise ValueError("two\nlines")

    checks = {"well": lambda scene: "1 ms", "wrong": broken, "memory": selfcheck.rendering}
    monkeypatch.setattr(selfcheck, "CHECKS", checks)
    outcome = devrf("stage=selfcheck", "trainer=cpu")
    assert outcome.status == 2
    assert outcome.err == "devrf: stage=selfcheck: 1 checks failed: wrong\n"
    lines = ["passed  well: 1 ms", "failed  wrong: ValueError: two lines"]
    lines.append("skipped  memory: needs a GPU: it is compared with a CPU")
    assert [line for line in outcome.out.splitlines() if line in lines] == lines
    record = json.loads((tmp_path / "outputs" / "selfcheck" / "selfcheck.json").read_text())
    assert [check["verdict"] for check in record["checks"]] == ["passed", "failed", "skipped"]


def test_one_device_alone_is_checked(devrf):
    two = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
    outcome = devrf("stage=selfcheck", *two)
    assert outcome.status == 2 and "leave out trainer=ddp" in outcome.err
