"""A process' own folder is nobody else's while it lives, and is removed after it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from devrf.system.folder_lock import private_folder

HOLDS = """
import sys
from pathlib import Path
from devrf.system.folder_lock import private_folder
with private_folder(Path(sys.argv[1]), ".own-") as folder:
    (folder / "part").write_text("half")
    print(folder.name, flush=True)
    sys.stdin.read()
"""


def test_what_killed_processes_left_is_removed_and_what_is_in_use_stays(tmp_path: Path) -> None:
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "mine").touch()
    (tmp_path / ".own-link").symlink_to(tmp_path / "else")
    (tmp_path / ".own-file").touch()
    (tmp_path / ".own-left" / "deep").mkdir(parents=True)
    command = [sys.executable, "-c", HOLDS, str(tmp_path)]
    with subprocess.Popen(command, text=True, stdin=-1, stdout=-1) as other:
        assert other.stdout is not None
        name = other.stdout.readline().strip()
        kept = {"else", ".own-link", ".own-file", name}
        for _ in range(2):
            with private_folder(tmp_path, ".own-") as folder:
                assert {*os.listdir(tmp_path)} == {*kept, folder.name}
                assert folder.stat().st_mode & 0o777 == 0o700
            assert {*os.listdir(tmp_path)} == kept
        assert (tmp_path / name / "part").read_text() == "half"
        other.send_signal(signal.SIGKILL)
    with private_folder(tmp_path, ".own-") as folder:
        assert not (tmp_path / name).exists()
    assert os.listdir(tmp_path / "else") == ["mine"]
