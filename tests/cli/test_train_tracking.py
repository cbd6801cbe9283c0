"""A run is one tracked run with curves, pictures, videos and tables, all on this machine."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

BLOCK, HEADER = 32768, 7


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
        self.run: Any = None
        for record in records(path):
            if record.HasField("run"):
                self.run = record.run
            config = record.run.config if record.HasField("run") else record.config
            self.config |= {u.key: json.loads(u.value_json) for u in config.update if u.key}
            for item in record.history.item:
                self.history[_name(item)].append(json.loads(item.value_json))
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
    options = ("logger=wandb", "hydra.run.dir=run", "callbacks.previews.times=3")
    options += ("evaluation.metrics=[]",)
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
    assert (tracked.run.project, tracked.run.display_name) == ("devrf", "run")
    assert list(tracked.run.tags) == ["full"]


def test_wandb_holds_the_curves_of_both_stages(watched):
    history = watched.runs[0].history
    for stage, last, losses, groups in (
        ("static", 6, ("render", "entropy"), ("density", "color", "decoder")),
        ("dynamic", 12, ("render", "cycle", "flow"), ("motion",)),
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


def test_a_later_command_continues_the_run(watched):
    first, second = watched.runs
    assert first.run.run_id == second.run.run_id
    found = json.loads((watched.folder / "metrics.json").read_text())
    for section in ("static", "dynamic", "deformation"):
        assert second.summary[f"test/{section}/psnr"] == pytest.approx(found[section]["psnr"])
    assert "static/loss" in first.history and "static/loss" not in second.history


@pytest.mark.parametrize(
    ("mode", "asked", "recorded"),
    [("disabled", "true", 0), ("offline", "false", 1), ("dryrun", "false", 1)],
)
def test_the_environment_says_whether_wandb_records(
    devrf, tmp_path, tiny, monkeypatch, mode, asked, recorded
):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", mode)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # nobody answers there
    options = ("stage=canonical", "logger=wandb", f"logger.offline={asked}", "hydra.run.dir=run")
    done = devrf(*tiny, *options)
    assert (done.status, os.environ["WANDB_MODE"]) == (0, mode), done.err
    assert len(offline_runs(tmp_path / "run")) == recorded
    assert not list(tmp_path.glob("run/wandb/run-*"))


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

    def read() -> EventAccumulator:
        return EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()

    common = (*tiny, "logger=tensorboard", "hydra.run.dir=run", "callbacks.previews.times=2")
    common += ("evaluation.metrics=[]", "video.frames=1")
    assert devrf(*common).status == 0
    events = read()
    assert [event.step for event in events.Scalars("static/render")][-1] == 6
    assert [event.step for event in events.Scalars("dynamic/lr/motion")][-1] == 12
    assert [event.step for event in events.Images("static/view")][-1] == 6
    assert {"dynamic/depth", "held_out/static", "held_out/dynamic"} <= set(events.Tags()["images"])
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    scored = events.Scalars("test/dynamic/psnr")
    assert [event.value for event in scored] == pytest.approx([found["dynamic"]["psnr"]])
    # The curves under the name of the score are whole.
    assert [event.step for event in events.Scalars("dynamic/psnr")][-1] == 12
    (config,) = events.Tensors("config/text_summary")
    assert b'"seed"' in config.tensor_proto.string_val[0]
    # A run that begins anew in the folder has curves of its own.
    assert devrf(*common, "stage=canonical", "resume=false").status == 0
    events = read()
    assert [event.step for event in events.Scalars("static/render")][-1] == 6
    assert "dynamic/lr/motion" not in events.Tags()["scalars"]
