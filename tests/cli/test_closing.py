"""A pipeline ends with where its results are, and with commands that work."""

from __future__ import annotations

import shlex
import shutil


def test_the_last_lines_are_commands_that_work(devrf, tmp_path, trained):
    folder, outcome = trained
    lines = outcome.out.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("results:"))
    found = "(metrics.json, images, videos/orbit.mp4, checkpoints)"
    assert lines[at] == f"results: outputs/{folder.parent.name}/{folder.name} {found}"
    commands = [shlex.split(line) for line in lines[at + 2 :]]
    assert [words[:3] for words in commands] == [["python", "-m", "devrf"]] * 3
    copy = tmp_path / "outputs" / folder.parent.name / folder.name
    shutil.copytree(folder, copy)
    done = devrf(*commands[0][3:])
    assert (done.status, done.err) == (0, "")
    assert list(copy.glob("images/still*.png"))
