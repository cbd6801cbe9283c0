"""Free memory by the system and its control groups, and free disk space."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch

from devrf.system.machine import (
    free_disk,
    free_host_memory,
    free_memory,
    multiplies_bfloat16,
    own_memory,
)

MIB = 2**20


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 900 MiB available, in no control group."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=900 * MIB))
    return tmp_path


def group(folder: Path, limit: str, used: int, cached: int, version: int = 2) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    names = {
        2: ("memory.max", "memory.current", "inactive_file"),
        1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    }[version]
    (folder / names[0]).write_text(f"{limit}\n")
    (folder / names[1]).write_text(f"{used * MIB}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {cached * MIB}\n")


def test_what_the_system_calls_available(root: Path) -> None:
    assert free_host_memory(root) == 900 * MIB


def test_a_control_group_leaves_less(root: Path) -> None:
    (root / "proc" / "self" / "cgroup").write_text("0::/jobs/mine\n")
    mount = root / "sys" / "fs" / "cgroup"
    group(mount / "jobs" / "mine", "max", 100, 0)
    assert free_host_memory(root) == 900 * MIB
    # The limit of the group around it: 500 used, 200 of that only cached.
    group(mount / "jobs", str(800 * MIB), 500, 200)
    assert free_host_memory(root) == 500 * MIB
    group(mount / "jobs" / "mine", str(300 * MIB), 290, 0)
    assert free_host_memory(root) == 10 * MIB
    group(mount / "jobs" / "mine", str(300 * MIB), 310, 0)
    assert free_host_memory(root) == 0


def test_a_container_sees_its_own_group_as_the_root(root: Path) -> None:
    (root / "proc" / "self" / "cgroup").write_text("0::/\n")
    group(root / "sys" / "fs" / "cgroup", str(400 * MIB), 100, 0)
    assert free_host_memory(root) == 300 * MIB


def test_control_groups_of_version_1(root: Path) -> None:
    (root / "proc" / "self" / "cgroup").write_text("5:cpu,cpuacct:/a\n4:memory:/slurm/job\n")
    folder = root / "sys" / "fs" / "cgroup" / "memory"
    group(folder / "slurm" / "job", str(700 * MIB), 400, 100, version=1)
    group(folder, str(2**63 - 4096), 400, 100, version=1)  # unlimited
    assert free_host_memory(root) == 400 * MIB


def test_this_machine() -> None:
    assert free_memory(torch.device("cpu")) > 0
    assert 50 * MIB < own_memory() < 2**40


def test_a_disk_is_that_of_the_first_folder_that_exists(tmp_path: Path) -> None:
    assert free_disk(tmp_path) == pytest.approx(free_disk(tmp_path / "not" / "yet"), rel=0.05)


@pytest.mark.parametrize(("capability", "expected"), [((7, 5), False), ((8, 0), True)])
def test_what_a_gpu_multiplies(
    capability: tuple[int, int], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    assert multiplies_bfloat16(torch.device("cuda", 0)) is expected
    assert not multiplies_bfloat16(torch.device("cpu"))
