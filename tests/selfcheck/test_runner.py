"""Each check has a verdict, whatever becomes of it: an error, a crash, a hang."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
import torch

from devrf.errors import DevrfError
from devrf.selfcheck import isolation
from devrf.selfcheck.checks import CHECKS
from devrf.selfcheck.finding import Finding
from devrf.selfcheck.isolation import NoFindingError, isolated
from devrf.selfcheck.runner import SelfcheckSettings, Verdict, run_checks

CPU = torch.device("cpu")


def well(number: int) -> Finding:
    print("said by the check")
    return Finding(True, "well", {"number": number})


def raising() -> Finding:
    raise ValueError("two\nlines")


def killed() -> Finding:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def hanging() -> Finding:
    time.sleep(60)
    raise AssertionError


@pytest.fixture
def fork():
    """Starts processes in which this file can be imported."""
    import multiprocessing

    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs fork")
    return multiprocessing.get_context("fork")


def test_a_finding_comes_back_and_what_was_said_is_in_the_log(fork, tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert isolated(fork, well, (3,), log, 60) == Finding(True, "well", {"number": 3})
    assert log.read_text() == "said by the check\n"


def test_warm_processes_reach_the_device_and_the_environment_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isolation, "PRELOADED", "json")
    before = dict(os.environ)
    with isolation.warm_processes({"DEVRF_TEST": "1", "PATH": "not taken"}) as context:
        assert dict(os.environ) == {**before, "DEVRF_TEST": "1"}
        assert isolation.can_use(context, CPU, tmp_path / "log")
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("work", "seconds", "expected"),
    [
        (raising, 60, "ValueError: two lines"),
        (killed, 60, "its process was ended by signal 9"),
        (hanging, 0.3, "still at work after 0 s"),
    ],
)
def test_no_finding_is_told_in_a_line(fork, tmp_path: Path, work, seconds, expected) -> None:
    began = time.monotonic()
    with pytest.raises(NoFindingError) as said:
        isolated(fork, work, (), tmp_path / "log", seconds)
    assert str(said.value) == expected
    assert time.monotonic() - began < 30
    if work is raising:
        assert "Traceback" in (tmp_path / "log").read_text()


def test_a_device_that_forked_processes_do_not_reach_is_noticed(
    fork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert isolation.can_use(fork, CPU, tmp_path / "log")
    assert not isolation.can_use(fork, torch.device("cuda", 7), tmp_path / "log")


def settings(**given) -> SelfcheckSettings:
    return SelfcheckSettings(iterations=20, **given)


def test_a_failure_stops_nothing_and_what_is_left_out_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    answers = iter([NoFindingError("its process was ended by signal 11"), well(1)])

    def answer(*_: object) -> Finding:
        given = next(answers)
        if isinstance(given, Exception):
            raise given
        return given

    monkeypatch.setattr("devrf.selfcheck.runner.isolated", answer)
    only = ["ceilings", "capture canonical", "frames"]
    found = list(run_checks(settings(only=only), CPU, 0, tmp_path))
    assert [(v.name, v.verdict) for v in found] == [
        ("ceilings", "failed"),
        ("capture canonical", "left out"),
        ("frames", "held"),
    ]
    assert found[0].said == "its process was ended by signal 11; see selfcheck.log"
    assert found[1].said == "needs a GPU: a CPU has no CUDA graphs"
    assert found[2].figures == {"number": 1}
    assert (tmp_path / "selfcheck.log").read_text() == "== ceilings\n== frames\n"


def test_checks_for_which_no_time_is_left_have_failed(tmp_path: Path) -> None:
    (found,) = run_checks(settings(only=["ceilings"], max_seconds=1e-6), CPU, 0, tmp_path)
    assert found.verdict == "failed" and found.said.startswith("not begun")


def test_a_verdict_is_one_line() -> None:
    assert Verdict("a b", "held", "x 1").line == "held      a b: x 1"


def test_names_are_unique_and_a_cpu_can_do_some_of_each_kind_but_those_of_graphs() -> None:
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    done = {check.name.split()[0] for check in CHECKS if check.left_out(CPU) is None}
    left = {check.name.split()[0] for check in CHECKS} - done
    assert left == {"capture", "waits", "memory"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"only": ["kernl"]}, "selfcheck.only: expected the first words of a check"),
        ({"max_seconds": 0.0}, "selfcheck: expected max_seconds and most_seconds above 0"),
        ({"iterations": 3}, "selfcheck.iterations: expected 20 or more, not 3"),
    ],
)
def test_wrong_settings_are_refused(given, expected: str) -> None:
    with pytest.raises(DevrfError, match=expected):
        SelfcheckSettings(**given)
