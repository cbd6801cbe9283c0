"""What docs/configuration.md shows of the terminal is what the commands say."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"
SHOWN = re.findall(r"```console\n\$ python -m devrf (.*)\n([^`]*)```", PAGE.read_text())


@pytest.mark.parametrize(("command", "shown"), SHOWN, ids=[command for command, _ in SHOWN])
def test_the_shown_lines_are_said_in_this_order(devrf, tiny_data, command, shown):
    if "data.root=scene" in command:
        assert devrf(*tiny_data, "stage=prepare", "prepare.into=scene").status == 0
    outcome = devrf(*shlex.split(command))
    said = iter(line.rstrip() for line in f"{outcome.out}\n{outcome.err}".splitlines())
    expected = [line for line in shown.splitlines() if line != "…"]
    assert expected and all(line in said for line in expected)
    assert (outcome.status == 0) is not outcome.err.startswith("devrf: ")


def test_an_experiment_of_ones_own_is_composed_as_it_is_printed(devrf, tmp_path):
    own = re.search(r"{ #own }.*?```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "folder" / "experiment").mkdir(parents=True)
    (tmp_path / "folder" / "experiment" / "mine.yaml").write_text(own[1])
    typed = ("--config-dir", "folder", "experiment=mine", "--cfg", "job", "--package")
    assert "tv: 0.5" in devrf(*typed, "loss.deformation").out
    assert "iterations: 1000\nside: 80" in devrf(*typed, "schedule.canonical").out
