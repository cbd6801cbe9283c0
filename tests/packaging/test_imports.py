"""What the command line loads before it knows that it is needed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import devrf

HEAVY = {"torch", "lightning", "cv2", "matplotlib", "pandas", "scipy", "skimage", "trimesh", "pxr"}


@pytest.mark.parametrize("words", ["import devrf", "import devrf.__main__"])
def test_nothing_heavy_is_imported(words: str) -> None:
    script = f"import sys\n{words}\nprint(*sorted({HEAVY!r} & set(sys.modules)))"
    path = os.pathsep.join([str(Path(devrf.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    loaded = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert loaded.stdout.split() == []
