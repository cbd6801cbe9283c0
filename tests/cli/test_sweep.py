"""Sweeps: a failed job is recorded, the others go on, and the end says which failed."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.config_store import ConfigStore

from devrf.cli.context import RunContext
from devrf.scenes.export import export

LEARN = ("stage=canonical", "hydra.sweep.dir=sweep")
SEARCH = ("hparams_search=loss_weights", "hydra.sweeper.n_trials=2")


def installed(plugin: str) -> pytest.MarkDecorator:
    missing = importlib.util.find_spec(f"hydra_plugins.{plugin}") is None
    return pytest.mark.skipif(missing, reason=f"{plugin} is not installed")


def failure(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "failure.json").read_text())
    return found


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[RunContext], None]], None]:
    """Replaces what stage=canonical does."""

    def replace(step: Callable[[RunContext], None]) -> None:
        monkeypatch.setattr("devrf.cli.run.learn", lambda run, name: step(run))

    return replace


def test_a_mistake_in_one_job_is_recorded_and_the_others_go_on(devrf, tmp_path, tiny):
    outcome = devrf("-m", *tiny, *LEARN, "data.frames=1,3", "seed=7")
    assert outcome.status == 3
    mistake, summary = outcome.err.splitlines()
    assert mistake.startswith("devrf: job 0_robot_frames_1: data.frames: ")
    why = "failure.json in each folder below sweep says why"
    assert summary == f"devrf: jobs failed: 0_robot_frames_1; {why}"
    # What is the same in all jobs, such as the seed, is in no name.
    job, other = tmp_path / "sweep" / "0_robot_frames_1", tmp_path / "sweep" / "1_robot_frames_3"
    found = failure(job)
    assert found["scene"] == "robot" and found["seed"] == 7 and found["mistake"] is True
    assert found["error"].startswith("data.frames: ")
    assert found["choices"]["schedule"] == "quick_inward" and "data.frames=1" in found["overrides"]
    assert found["date"].endswith("+00:00")
    assert (job / ".hydra" / "config.yaml").is_file()
    assert (other / "checkpoints" / "canonical.ckpt").is_file()
    assert not (other / "failure.json").exists()


def test_a_fault_of_the_program_is_recorded_with_its_traceback_in_the_log(
    devrf, tmp_path, tiny, steps
):
    def boom(run: RunContext) -> None:
        (run.folder / "done").write_text(str(1 / (run.config.seed - 1)))

    steps(boom)
    outcome = devrf("-m", *tiny, *LEARN, "seed=0,1,2")
    assert outcome.status == 3
    said, summary = outcome.err.splitlines()
    assert said == "devrf: job 1_robot_seed_1: ZeroDivisionError: division by zero"
    assert "jobs failed: 1_robot_seed_1" in summary
    found = failure(tmp_path / "sweep" / "1_robot_seed_1")
    assert found["mistake"] is False and found["error"] == "ZeroDivisionError: division by zero"
    assert "Traceback" in (tmp_path / "sweep" / "1_robot_seed_1" / "run.log").read_text()
    done = sorted(path.parent.name for path in tmp_path.glob("sweep/*/done"))
    assert done == ["0_robot_seed_0", "2_robot_seed_2"]


def test_a_later_success_in_the_folder_removes_the_record(devrf, tmp_path, tiny, steps):
    jobs = [tmp_path / "sweep" / name for name in ("0_robot", "9_robot")]
    for job in jobs:
        job.mkdir(parents=True)
        (job / "failure.json").write_text("{}")
    steps(lambda run: None)
    # The failure of another job, of an earlier sweep in the same folder, is not this one's.
    assert devrf("-m", *tiny, *LEARN, "data.frames=3").status == 0
    assert list(tmp_path.glob("sweep/*/failure.json")) == [jobs[1] / "failure.json"]


def test_an_error_before_the_first_job_ends_the_sweep_at_once(devrf, tmp_path, tiny):
    outcome = devrf("-m", *tiny, "ablation=base,nonsense")
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_objective_that_no_job_has_ends_the_sweep_at_once(devrf, tmp_path, tiny):
    outcome = devrf("-m", *tiny, "objective=static.psnrr", "seed=0,1")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: objective: static has no 'psnrr'; choose from psnr, ")
    assert not list(tmp_path.iterdir())


def test_metrics_that_are_no_list_are_refused_by_each_job(devrf, tmp_path, tiny):
    outcome = devrf("-m", *tiny, *LEARN, "evaluation.metrics=null", "seed=0,1")
    assert outcome.status == 3
    assert outcome.err.count("evaluation.metrics: expected a valid array, not None\n") == 2
    assert (tmp_path / "sweep" / "multirun.yaml").is_file()


def test_a_plugin_that_is_missing_is_named_with_the_remedy(devrf, tmp_path, tiny, monkeypatch):
    devrf("--info", "searchpath")  # Hydra has looked for its plugins
    launchers = ConfigStore.instance().repo["hydra"]["launcher"]
    monkeypatch.delitem(launchers, "submitit_slurm.yaml", raising=False)
    outcome = devrf("-m", *tiny, "hydra/launcher=slurm", "seed=0,1")
    needed = '; others need pip install "devrf[sweeps]"'
    expected = f"devrf: hydra/launcher=submitit_slurm: no such option{needed}\n"
    assert (outcome.status, outcome.err) == (2, expected)
    assert not list(tmp_path.iterdir())


@installed("hydra_joblib_launcher")
def test_jobs_in_processes_of_their_own(warm, tmp_path, tiny):
    joblib = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "stage=inspect,report")
    done = warm(tmp_path, "-m", *tiny, *joblib, "report.runs=gone", "hydra.sweep.dir=sweep")
    assert done.status == 3
    assert "devrf: job 1_robot_stage_report: report.runs: no folder gone" in done.out
    assert "jobs failed: 1_robot_stage_report" in done.out and "Traceback" not in done.out
    assert (tmp_path / "sweep" / "0_robot_stage_inspect" / "images").is_dir()
    assert failure(tmp_path / "sweep" / "1_robot_stage_report")["mistake"] is True


@pytest.mark.parametrize("typed", ["data.shape=glob(*)", "seed=range(0,0)"])
def test_a_sweep_without_a_job_is_refused(devrf, tmp_path, tiny, typed):
    outcome = devrf("-m", *tiny, *LEARN, typed)
    said = "the sweep has no jobs: what is typed as glob(…) or range(…) is empty"
    assert (outcome.status, outcome.err) == (2, f"devrf: {said}\n")
    assert not list(tmp_path.iterdir())


def test_a_range_without_an_end_is_one_line(devrf, tmp_path, tiny):
    outcome = devrf("-m", *tiny, *LEARN, "seed=range(0,1,0)")
    assert (outcome.status, outcome.err) == (2, "devrf: range() arg 3 must not be zero\n")
    assert not list(tmp_path.iterdir())


@installed("hydra_optuna_sweeper")
def test_a_search_maximises_the_objective(devrf, tmp_path, tiny):
    folder = ("hydra.sweep.dir=sweep", "video.frames=1", "evaluation.metrics=[]")
    typed = "schedule.visit.learning_rate=interval(0.001, 0.002)"
    assert devrf("-m", *tiny, *SEARCH, *folder, typed).status == 0
    found = [json.loads(path.read_text()) for path in tmp_path.glob("sweep/*/metrics.json")]
    runs = sorted(tmp_path.glob("sweep/[01]_robot_cycle_*_learning_rate_0.001*"))
    assert len(runs) == len(found) == 2
    best = max(found, key=lambda metrics: metrics["deformation"]["psnr"])
    said = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
    assert said["best_value"] == best["deformation"]["psnr"]
    for name, value in said["best_params"].items():
        assert f"{name}={value}" in best["run"]["overrides"]
    # A search is a sweep: later commands do their stage in each of its runs.
    record = (tmp_path / "sweep" / "multirun.yaml").read_bytes()
    outcome = devrf("stage=still", "still.height=20", "hydra.sweep.dir=sweep")
    assert (outcome.status, outcome.err) == (0, "")
    assert all(list(run.glob("images/still*.png")) for run in runs)
    assert (tmp_path / "sweep" / "multirun.yaml").read_bytes() == record
    report = devrf("stage=report", "hydra.sweep.dir=sweep")
    assert (report.status, report.err) == (0, "") and "written to sweep/report" in report.out
    assert {path.name for path in tmp_path.iterdir()} == {"sweep"}


@installed("hydra_optuna_sweeper")
@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("hydra.sweeper.direction=up", "Please set either 'minimize' or 'maximize' to direction."),
        ("loss.fine.render=interval(2,1)", "The `low` value must be smaller than or equal to the"),
        (
            "hydra.sweeper.storage=sqlite:////nowhere/x.db",
            "hydra.sweeper.storage: expected a database that can be read and written, as "
            "sqlite:///study.db ((sqlite3.OperationalError) unable to open database file)",
        ),
        (
            "hydra.sweeper.storage=nowhere",
            "hydra.sweeper.storage: expected a database that can be read and written, as ",
        ),
        (
            "hydra.sweeper.storage=mysql://nowhere/x",
            "hydra.sweeper.storage: expected a database that can be read and written, as ",
        ),
    ],
)
def test_what_a_search_cannot_take_is_one_line(devrf, tmp_path, tiny, typed, said):
    outcome = devrf("-m", *tiny, *SEARCH, typed, "hydra.sweep.dir=sweep")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {said}")
    assert not list(tmp_path.iterdir())


@installed("hydra_optuna_sweeper")
def test_a_search_with_a_storage_goes_on_with_other_trials(devrf, tmp_path, tiny):
    import optuna

    kept = {"study_name": "kept", "storage": f"sqlite:///{tmp_path}/kept.db"}
    words = [f"hydra.sweeper.{key}={value}" for key, value in kept.items()]
    for _ in range(2):  # of jobs that fail at once: they are not scored
        assert devrf("-m", *tiny, *SEARCH, *words, "stage=canonical").status == 3
    drawn = [trial.params for trial in optuna.load_study(**kept).trials]
    assert len(drawn) == 4
    assert all(drawn.count(trial) == 1 for trial in drawn)


def test_a_folder_without_the_record_of_a_sweep_is_refused(devrf, tmp_path):
    outcome = devrf("stage=still", "hydra.sweep.dir=elsewhere")
    said = "no sweep is typed (-m); without one, and without experiment=, it names the folder of a"
    said = f"devrf: hydra.sweep.dir: {said} sweep, which has multirun.yaml\n"
    assert (outcome.status, outcome.err) == (2, said)
    assert not list(tmp_path.iterdir())


@installed("hydra_optuna_sweeper")
def test_a_search_maximises_the_validation_views(devrf, tmp_path, short, tiny_scene):
    root = tmp_path / "scene"
    export(tiny_scene, root)
    # The images of the held-out view at three times: two to choose by, one to test on.
    for split, places in (("val", [0, 1]), ("test", [2])):
        file = root / "dynamic_2views" / f"transforms_{split}.json"
        content = json.loads(file.read_text())
        content["frames"] = [content["frames"][place] for place in places]
        file.write_text(json.dumps(content))
    given = ("data=inward", f"data.root={root}", "video.frames=1", "evaluation.metrics=[]")
    one = (*SEARCH, "hydra.sweeper.n_trials=1", "hydra.sweep.dir=sweep")
    assert devrf("-m", *given, *short, *one).status == 0
    (found,) = (json.loads(path.read_text()) for path in tmp_path.glob("sweep/*/metrics.json"))
    assert found["validation"]["images"] == 2
    said = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
    assert said["best_value"] == found["validation"]["psnr"] != found["dynamic"]["psnr"]


@installed("hydra_optuna_sweeper")
def test_a_search_of_which_every_job_fails_says_so(devrf, tiny):
    outcome = devrf("-m", *tiny, *SEARCH, "stage=canonical")
    assert outcome.status == 3
    lines = [line for line in outcome.err.splitlines() if line.startswith("devrf: ")]
    why = "stage: a search needs the objective"
    assert [f"job {k}_robot_" in lines[k] and why in lines[k] for k in (0, 1)] == [True, True]
    assert "jobs failed: 0_robot_" in lines[2] and ", 1_robot_" in lines[2]
    assert "Traceback" not in outcome.err


@installed("hydra_optuna_sweeper")
def test_a_search_whose_objective_is_null_in_every_job_says_so(devrf, tiny):
    words = ("objective=static.ms_ssim", "hydra.sweeper.n_trials=1", "video.frames=1")
    outcome = devrf("-m", *tiny, *SEARCH, *words)  # of images of 176 pixels or more alone
    assert outcome.status == 2 and "Traceback" not in outcome.err
    said = "devrf: objective: null in every job of the search; choose another number\n"
    assert outcome.err.endswith(said)
