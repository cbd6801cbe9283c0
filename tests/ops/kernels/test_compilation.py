"""The kernels compile for GPUs that are not there, down to the GPU's own code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.skipif(sys.platform != "linux", reason="Triton compiles on Linux")
def test_every_launch_compiles_without_a_gpu(tmp_path: Path) -> None:
    pytest.importorskip("triton", reason="Triton is not installed")
    environment = {
        **os.environ,
        "PYTHONPATH": str(HERE.parents[2] / "src"),
        # Nothing from an earlier run, and nothing left behind.
        "TRITON_CACHE_DIR": str(tmp_path),
        "TRITON_INTERPRET": "0",
    }
    done = subprocess.run(
        [sys.executable, str(HERE / "compile_launches.py"), "80", "90"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads(done.stdout.splitlines()[-1])
    for capability in (80, 90):
        compiled = [c for c in report["compiled"] if c["capability"] == capability]
        assert {c["kernel"] for c in compiled} == set(report["kernels"])
        assert all(c["ptx"] and c["cubin"] for c in compiled)
