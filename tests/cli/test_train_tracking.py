"""A run is one tracked run with curves, pictures, videos and tables, all on this machine."""

from __future__ import annotations

import csv
import json
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from devrf.errors import DevrfError
from devrf.loggers.trackers import WandbTracker

BLOCK, HEADER = 32768, 7
SWEEP = Path(__file__).parents[2] / "docs" / "wandb_sweep.yaml"


def records(path: Path) -> Iterator[Any]:
    """The records of a ``.wandb`` file: after seven bytes of its own, LevelDB's log format."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, parts = path.read_bytes(), HEADER, b""
    assert data.startswith(b":W&B")
    while at + HEADER <= len(data):
        if BLOCK - at % BLOCK < HEADER:  # too little left of the block for a record
            at += BLOCK - at % BLOCK
            continue
        length, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        parts += data[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if kind in (1, 4):  # whole, or the last part
            yield Record.FromString(parts)
            parts = b""


class Tracked:
    """What an offline run of wandb has written."""

    def __init__(self, path: Path) -> None:
        self.files = path.parent / "files"
        self.config: dict[str, Any] = {}
        self.history: dict[str, list[Any]] = defaultdict(list)
        self.summary: dict[str, Any] = {}
        self.artifacts: dict[str, list[str]] = {}
        self.run: Any = None
        for record in records(path):
            if record.HasField("run"):
                self.run = record.run
            config = record.run.config if record.HasField("run") else record.config
            self.config |= {u.key: json.loads(u.value_json) for u in config.update if u.key}
            for item in record.history.item:
                self.history[_name(item)].append(json.loads(item.value_json))
            if record.HasField("artifact"):
                names = [entry.path for entry in record.artifact.manifest.contents]
                self.artifacts[record.artifact.name] = names
            for item in record.summary.update:
                self.summary[_name(item)] = json.loads(item.value_json)


def _name(item: Any) -> str:
    return item.key or "/".join(item.nested_key)


def offline_runs(folder: Path) -> list[Tracked]:
    import wandb

    wandb.teardown()  # its process has written everything when it has ended
    return [Tracked(path) for path in sorted(folder.glob("wandb/offline-run-*/run-*.wandb"))]


class Watched(NamedTuple):
    """A run with logger=wandb, scored again by a later command."""

    folder: Path
    runs: list[Tracked]


@pytest.fixture(scope="module")
def watched(
    devrf_in: Any, tmp_path_factory: pytest.TempPathFactory, tiny: tuple[str, ...]
) -> Watched:
    pytest.importorskip("wandb")
    folder = tmp_path_factory.mktemp("watched")
    options = ("logger=[csv,wandb]", "hydra.run.dir=run", "callbacks.previews.times=3")
    options += ("evaluation.metrics=[]",)
    lightnings = "lightning.pytorch.loggers.CSVLogger"
    options += (f"+logger.mine._target_={lightnings}", "+logger.mine.save_dir=mine")
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("WANDB_")]:
            patch.delenv(name)
        for stage in ("pipeline", "evaluate"):
            done = devrf_in(folder, *tiny, *options, f"stage={stage}")
            assert done.status == 0, done.err
    return Watched(folder / "run", offline_runs(folder / "run"))


def test_wandb_holds_config_and_name(watched):
    tracked = watched.runs[0]
    assert tracked.config["data"]["shape"] == "robot"
    assert tracked.config["schedule"]["deformation"]["levels"]["2"]["side"] == 8
    assert tracked.config["choices"]["data"] == "procedural"
    assert "data.frames=3" in tracked.config["overrides"]
    assert {"devrf", "git"} <= {*tracked.config}
    assert (tracked.run.project, tracked.run.display_name) == ("devrf", "run")
    assert list(tracked.run.tags) == ["procedural"]


def test_several_loggers_have_the_same_rows(watched):
    with (watched.folder / "logs" / "pipeline" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name in ("static/parameters", "dynamic/parameters", "dynamic/render"):
        column = [float(row[name]) for row in rows if row[name]]
        assert column == pytest.approx(watched.runs[0].history[name]) and column[-1] > 0
    mine = watched.folder.parent / "mine" / "lightning_logs" / "version_0"
    assert "frames: 3" in (mine / "hparams.yaml").read_text()


def test_wandb_holds_the_curves_of_both_stages(watched):
    history = watched.runs[0].history
    for stage, last, losses, groups in (
        ("static", 6, ("render", "entropy"), ("density", "color", "decoder")),
        ("dynamic", 12, ("render", "cycle", "flow"), ("displacements",)),
    ):
        for name in ("loss", "iterations_per_second", "voxels", "peak_host_gb", *losses):
            assert history[f"{stage}/{name}"][-1] > 0
        assert all(history[f"{stage}/lr/{group}"][-1] > 0 for group in groups)
        assert last in history["trainer/global_step"]
    assert history["dynamic/frame"][-1] == 2


def test_wandb_holds_pictures_videos_and_tables(watched):
    history, files = watched.runs[0].history, watched.runs[0].files
    # Lightning steps end after 2 and 6 iterations, and after 4, 6, 10 and 12.
    for stage, times in (("static", 2), ("dynamic", 3)):
        for name in ("view", "depth"):
            shown = history[f"{stage}/{name}/filenames"]
            assert len(shown) == times
            assert all((files / image).is_file() for (image,) in shown)
        ((image,),) = history[f"held_out/{stage}/filenames"]
        assert (files / image).is_file()
    for name in ("held_out", "orbit"):
        ((video,),) = history[f"videos/{name}/videos"]
        assert (files / video["path"]).is_file()
    frames, metrics = (
        json.loads((files / history[f"{k}/path"][0]).read_text()) for k in ("frames", "metrics")
    )
    assert frames["columns"][:4] == ["capture", "name", "time", "psnr"]
    assert [row[0] for row in frames["data"]] == ["static"] * 2 + ["dynamic"] * 3
    assert [row[0] for row in metrics["data"]][:2] == ["static", "dynamic"]


@pytest.mark.parametrize("content", [b"\xff", bytes(1000)])
def test_what_is_no_runs_id_is_one_line(tmp_path, content):
    (tmp_path / "wandb").mkdir()
    (tmp_path / "wandb" / "run_id").write_bytes(content)
    with pytest.raises(DevrfError, match="wandb/run_id: no run's id"):
        WandbTracker(tmp_path)


def test_a_later_command_continues_the_run(watched):
    first, second = watched.runs
    assert first.run.run_id == second.run.run_id
    found = json.loads((watched.folder / "metrics.json").read_text())
    for section in ("static", "dynamic", "deformation"):
        assert second.summary[f"test/{section}/psnr"] == pytest.approx(found[section]["psnr"])
    assert second.summary["objective"] == second.summary["test/dynamic/psnr"]
    assert "static/loss" in first.history and "static/loss" not in second.history


@pytest.mark.parametrize(
    ("mode", "asked", "recorded"), [("disabled", "true", 0), ("offline", "false", 1)]
)
def test_wandbs_variables_are_obeyed_and_what_is_typed_goes_before_them(
    devrf, tmp_path, tiny, monkeypatch, mode, asked, recorded
):
    pytest.importorskip("wandb").teardown()  # which has read the variables
    there = tmp_path / "there"
    there.mkdir()
    for name, value in {
        "MODE": mode,
        "API_KEY": "0" * 40,
        "BASE_URL": "http://127.0.0.1:9",  # nobody answers there
        "PROJECT": "theirs",
        "NAME": "named",
        "RUN_GROUP": "grouped",
        "TAGS": "one,two",
        "NOTES": "of the environment",
        "DIR": str(there),
    }.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    options = ("stage=canonical", "logger=wandb", "hydra.run.dir=run", "logger.wandb.tags=[mine]")
    typed = (f"offline={asked}", "notes=typed", "job_type=trial", "id=abc", "log_model=true")
    done = devrf(*tiny, *options, *(f"logger.wandb.{word}" for word in typed))
    assert (done.status, os.environ["WANDB_MODE"]) == (0, mode), done.err
    tracked = offline_runs(there)
    assert len(tracked) == recorded
    assert not list(tmp_path.glob("*/wandb/run-*"))
    for run in (of.run for of in tracked):
        assert (run.project, run.display_name, run.run_group) == ("theirs", "named", "grouped")
        assert list(run.tags) == ["mine", "one", "two"]
        assert (run.notes, run.job_type, run.run_id) == ("typed", "trial", "abc")
        assert tracked[0].artifacts == {"model-abc": ["canonical.ckpt"]}


def test_equal_trials_of_wandbs_agent_are_runs_of_their_own(devrf, tmp_path, tiny, monkeypatch):
    wandb = pytest.importorskip("wandb")
    from wandb.sdk.launch.sweeps import utils

    sweep = utils.load_sweep_config(str(SWEEP))
    told = {"args": {name: {"value": row["min"]} for name, row in sweep["parameters"].items()}}
    words = utils.create_sweep_command_args(told)
    words["program"] = [sweep["program"]]
    command = [word for part in sweep["command"] for word in words.get(part[2:-1], [part])]
    assert command.pop(0) == "devrf" and sweep["metric"]["name"] == "objective"
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))  # as the agent does
    monkeypatch.setenv("WANDB_SWEEP_ID", "search")
    for trial in ("first", "second"):
        monkeypatch.setenv("WANDB_RUN_ID", trial)
        wandb.teardown()  # each has a process of its own
        done = devrf(*command, *tiny, "stage=canonical")
        assert done.status == 0, done.err
        assert (tmp_path / f"outputs/sweeps/search/{trial}/checkpoints/canonical.ckpt").is_file()
    tracked = offline_runs(tmp_path)
    assert {(of.run.run_id, of.run.sweep_id) for of in tracked} == {
        ("first", "search"),
        ("second", "search"),
    }
    assert tracked[0].config["loss"]["deformation"]["tv"] == 0.01


def test_a_run_without_loggers_and_callbacks_learns(devrf, tmp_path, tiny):
    plain = [word for word in tiny if "callbacks" not in word]
    done = devrf(*plain, "stage=canonical", "logger=null", "~callbacks", "hydra.run.dir=run")
    assert (done.status, done.err) == (0, "")
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert not (tmp_path / "run" / "logs").exists()


def test_a_callback_of_the_user_that_fails_is_named(devrf, tmp_path, tiny, monkeypatch):
    lines = (
        "from lightning import Callback",
        "class Sampler(Callback):",
        "    def on_train_start(self, trainer, stage):",
        "        raise ValueError('no such layer')",
    )
    (tmp_path / "watchers.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    done = devrf(*tiny, "stage=canonical", "+callbacks.mine._target_=watchers.Sampler")
    said = "callbacks.mine: Sampler.on_train_start failed (ValueError: no such layer)"
    assert (done.status, done.err) == (2, f"devrf: {said}\n")
    assert "Traceback" not in done.out and "a callback failed" in done.out
    (log,) = tmp_path.glob("outputs/robot/*/run.log")
    assert "Traceback" in log.read_text() and "watchers.py" in log.read_text()


@pytest.mark.parametrize(
    ("group", "expected"),
    [("callbacks", "one of Lightning's callbacks"), ("logger", "one of Lightning's loggers")],
)
def test_what_is_no_callback_and_no_logger_is_named(devrf, tmp_path, tiny, group, expected):
    done = devrf(*tiny, "stage=canonical", f"+{group}.mine._target_=fractions.Fraction")
    line = f"devrf: {group}.mine: expected {expected}, not Fraction(0, 1)\n"
    assert (done.status, done.err) == (2, line)


def test_jobs_of_a_sweep_are_grouped_and_named(devrf, tmp_path, tiny, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    sweep = ("stage=canonical", "logger=wandb", "hydra.sweep.dir=mine", "seed=1")
    assert devrf("-m", *tiny, *sweep).status == 0
    run = offline_runs(tmp_path / "mine" / "0_robot")[0].run
    assert run.run_group == "mine"
    assert run.display_name == "0_robot"


def test_tensorboard_holds_both_stages_and_the_scores(devrf, tmp_path, tiny):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    def read() -> EventAccumulator:
        return EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()

    common = (*tiny, "logger=tensorboard", "hydra.run.dir=run", "callbacks.previews.times=2")
    common += ("evaluation.metrics=[]", "video.frames=1")
    assert devrf(*common).status == 0
    events = read()
    assert [event.step for event in events.Scalars("static/render")][-1] == 6
    assert [event.step for event in events.Scalars("dynamic/lr/displacements")][-1] == 12
    assert [event.step for event in events.Images("static/view")][-1] == 6
    assert {"dynamic/depth", "held_out/static", "held_out/dynamic"} <= set(events.Tags()["images"])
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    scored = events.Scalars("test/dynamic/psnr")
    assert [event.value for event in scored] == pytest.approx([found["dynamic"]["psnr"]])
    # The curves under the name of the score are whole.
    assert [event.step for event in events.Scalars("dynamic/psnr")][-1] == 12
    (config,) = events.Tensors("config/text_summary")
    assert b'"seed"' in config.tensor_proto.string_val[0]
    # The table HPARAMS.
    table = {
        name: HParamsPluginData.FromString(
            events.SummaryMetadata(f"_hparams_/{name}").plugin_data.content
        )
        for name in ("experiment", "session_start_info")
    }
    metrics = {metric.name.tag for metric in table["experiment"].experiment.metric_infos}
    assert {"test/dynamic/psnr", "objective"} <= metrics
    assert table["session_start_info"].session_start_info.hparams["data/frames"].number_value == 3
    # A run that begins anew in the folder has curves of its own.
    assert devrf(*common, "stage=canonical", "resume=false").status == 0
    events = read()
    assert [event.step for event in events.Scalars("static/render")][-1] == 6
    assert "dynamic/lr/displacements" not in events.Tags()["scalars"]
