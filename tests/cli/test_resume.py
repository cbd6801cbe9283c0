"""The same command again goes on; another config is refused; ``resume=false`` begins afresh."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the folder of a whole tiny run."""
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    return folder


@pytest.fixture
def again(devrf, tiny, run):
    """``again(*arguments)``: the command of that run, with more arguments."""
    return lambda *arguments: devrf(*tiny, f"hydra.run.dir={run}", *arguments)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_what_decides_nothing_may_change(again):
    outcome = again(
        "stage=canonical",
        "video.frames=9",
        "evaluation.metrics=[]",
        "callbacks.checkpoint.share=0.5",
        "trainer.log_every_n_steps=2",
        "logger.csv.name=curves",
        "prepare.into=elsewhere",
    )
    assert outcome.status == 0
    assert "canonical: learned already" in outcome.out


@pytest.mark.parametrize(
    ("arguments", "key", "before", "now"),
    [
        (["schedule.canonical.upsample_at=[3]"], "schedule.canonical.upsample_at", "[2]", "[3]"),
        (
            ["schedule.extensions.tracks.init_from=previous"],
            "schedule.extensions.tracks.init_from",
            '"flow"',
            '"previous"',
        ),
    ],
)
def test_another_config_is_refused_by_the_name_of_the_key(again, run, arguments, key, before, now):
    kept = contents(run / "checkpoints")
    outcome = again(*arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and outcome.err.startswith(f"devrf: {key}: ")
    assert f"was made with {before}, now it is {now}; give resume=false" in outcome.err
    assert "hydra.run.dir=FOLDER" in outcome.err
    assert contents(run / "checkpoints") == kept


def test_what_the_canonical_field_would_have_to_be_learned_with_is_refused_on_top_of_it(again, run):
    outcome = again("stage=deformation", "schedule.canonical.iterations=7")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    was = f"{run}/checkpoints/canonical.ckpt was made with 6, now it is 7"
    said = f"devrf: schedule.canonical.iterations: {was}; stage=deformation builds on that file: "
    assert outcome.err.startswith(said)


def test_a_deformation_has_a_seed_of_its_own(again):
    outcome = again("stage=deformation", "seed=1", "resume=false")
    assert (outcome.status, outcome.err) == (0, "")


def test_beginning_afresh_keeps_the_old_run_whole(again, run):
    before = contents(run)
    outcome = again("resume=false", "seed=1", "stage=canonical")
    assert (outcome.status, outcome.err) == (0, "")
    assert f"what was in {run} is kept in {run}/previous-1" in outcome.out
    kept = contents(run / "previous-1")
    assert kept == {k: v for k, v in before.items() if not k.startswith((".hydra", ".devrf"))}
    # The config stands beside what was learned with it.
    assert OmegaConf.load(run / "previous-1" / "checkpoints" / "config.yaml").seed == 0
    assert OmegaConf.load(run / "checkpoints" / "config.yaml").seed == 1
    assert "previous" not in (run / "run.log").read_text().replace(str(run / "previous-1"), "")
    # Another seed, another field. What a stage builds on is needed and stays.
    assert contents(run / "checkpoints")["canonical.ckpt"] != kept["checkpoints/canonical.ckpt"]
    assert again("resume=false", "seed=1", "stage=deformation").status == 0
    assert contents(run / "previous-1") == kept
    assert (run / "checkpoints" / "canonical.ckpt").is_file()


def learned_another_day(path: Path, to: Path) -> None:
    """Write the same fields with another digest."""
    content = read_checkpoint_file(path)
    content["devrf"]["records"] = {}
    write_checkpoint_file(to, content)


def test_a_deformation_is_learned_anew_on_another_canonical_field(again, run):
    path = run / "checkpoints" / "canonical.ckpt"
    learned_another_day(path, path)
    outcome = again("stage=deformation")
    assert outcome.status == 0
    assert "deformation.ckpt: belongs to another canonical field; learned anew" in outcome.out
    assert "deformation: seconds" in outcome.out


def test_a_canonical_field_that_is_given_belongs_to_the_deformation(devrf, tiny, trained, tmp_path):
    given = trained[0] / "checkpoints" / "canonical.ckpt"
    command = (*tiny, "stage=deformation", "hydra.run.dir=moved")
    assert devrf(*command, f"ckpt={given}").status == 0
    copied = shutil.copy(given, tmp_path / "same.ckpt")
    assert "learned already" in devrf(*command, f"ckpt={copied}").out
    learned_another_day(given, tmp_path / "other.ckpt")
    outcome = devrf(*command, "ckpt=other.ckpt")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: ckpt: ")


@pytest.fixture(scope="module")
def left(devrf_in, tiny, often, tmp_path_factory):
    """A command, and the folder in which it was left after iteration 4 of the canonical stage."""
    command = (*tiny, *often, "hydra.run.dir=run", "stage=canonical")
    folder = tmp_path_factory.mktemp("left")
    assert devrf_in(folder, *command, "trainer.max_steps=4").status == 2
    return command, folder


@pytest.fixture
def cut_short(left, tmp_path):
    """A command, and the checkpoints of a copy of what it has left."""
    command, folder = left
    checkpoints = tmp_path / "run" / "checkpoints"
    shutil.copytree(folder / "run", tmp_path / "run")
    names = {path.name for path in checkpoints.glob("*.ckpt")}
    assert names == {"canonical-progress-3.ckpt", "canonical-progress-4.ckpt"}
    return command, checkpoints


def test_a_run_that_was_cut_short_says_where_it_stands(devrf, cut_short, tmp_path):
    _, checkpoints = cut_short
    stands = "canonical-progress-4.ckpt: iteration 4 of 6 of the canonical stage"
    go_on = "python -m devrf hydra.run.dir=run goes on"
    outcome = devrf("stage=evaluate", "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert f"{stands}; {go_on}" in outcome.err and not (tmp_path / "run/metrics.json").exists()
    outcome = devrf("stage=still", "hydra.run.dir=run", "still.height=20")
    assert outcome.status == 0 and f"{stands}; {go_on}" in outcome.out
    assert len([*tmp_path.glob("run/images/still*")]) == 2
    progress = f"ckpt={checkpoints / 'canonical-progress-4.ckpt'}"
    assert devrf("stage=evaluate", progress, "evaluation.metrics=[]").status == 0
    assert [path.name for path in tmp_path.rglob("metrics*.json")] == ["metrics-unfinished.json"]


def test_a_damaged_progress_file_gives_way_to_the_one_before(devrf, cut_short):
    command, checkpoints = cut_short
    newest = checkpoints / "canonical-progress-4.ckpt"
    newest.write_bytes(newest.read_bytes()[:-100])
    outcome = devrf(*command)
    assert (outcome.status, outcome.err) == (0, "")
    assert f"{newest}: not a devrf checkpoint, or a damaged one" in outcome.out
    assert "the file before it is taken" in outcome.out
    assert "canonical: goes on at iteration 3" in outcome.out


def test_a_run_left_with_another_config_is_refused(devrf, cut_short):
    command, checkpoints = cut_short
    outcome = devrf(*command, "sampling.step=0.4")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: sampling.step: ")
    assert "canonical-progress-4.ckpt was made with 0.5, now it is 0.4" in outcome.err


def test_a_run_left_with_another_decay_is_refused(devrf, cut_short):
    command, _ = cut_short
    decay = "devrf.callbacks.schedule.LearningRateDecay"
    outcome = devrf(*command, f"callbacks.learning_rate_decay._target_={decay}")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: callbacks.learning_rate_decay._target_: ")
    assert "canonical-progress-4.ckpt was made with nothing, now it is" in outcome.err
