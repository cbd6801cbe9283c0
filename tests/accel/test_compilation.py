"""The kernels compile for GPUs that are not there, down to the GPU's own code.

Two kernels for one GPU; with DEVRF_ALL_LAUNCHES=1 all, with all sets of constants, for four GPUs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ALL = os.environ.get("DEVRF_ALL_LAUNCHES", "0") == "1"
CAPABILITIES = (80, 86, 89, 90) if ALL else (90,)


@pytest.mark.skipif(sys.platform != "linux", reason="Triton compiles on Linux")
def test_kernels_compile_without_a_gpu(tmp_path: Path) -> None:
    pytest.importorskip("triton", reason="Triton is not installed")
    environment = {
        **os.environ,
        "PYTHONPATH": str(HERE.parents[1] / "src"),
        # Nothing from an earlier run, and nothing left behind.
        "TRITON_CACHE_DIR": str(tmp_path),
        "TRITON_INTERPRET": "0",
    }
    asked = ["all" if ALL else "two", *map(str, CAPABILITIES)]
    done = subprocess.run(
        [sys.executable, str(HERE / "compile_launches.py"), *asked],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
