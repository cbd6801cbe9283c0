"""Which implementation of an operation runs: its plain PyTorch twin, or Triton on a CUDA device.

A function of this package asks :func:`triton_runs` once, when it is called. Its backward pass,
which autograd may run in a thread of its own, belongs to the implementation that was chosen then.

This module knows none of the operations. The check that a device must pass before Triton runs on
it compares all of them, so it is registered from above (``devrf.ops.__init__``).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib.util import find_spec
from typing import Literal, get_args

import torch
from torch import Tensor

from devrf.errors import DevrfError

log = logging.getLogger(__name__)

Kind = Literal["auto", "torch", "triton"]
Check = Callable[[torch.device], None]

_chosen: ContextVar[Kind] = ContextVar("kernels", default="auto")
_checks: list[Check] = []


@contextmanager
def using(kind: Kind) -> Iterator[None]:
    """Run everything inside with one implementation.

    Args:
        kind: ``auto`` takes Triton for float32 tensors on a CUDA device where Triton is installed
            and has passed a check on that device, plain PyTorch for all others and where torch
            is told to be deterministic (Triton's kernels add in no fixed order); ``torch`` and
            ``triton`` insist. A thread that is started inside begins with ``auto``.

    Raises:
        DevrfError: ``kind`` is none of the three.
    """
    if kind not in get_args(Kind):
        raise DevrfError(f"kernels: expected auto, torch or triton, not {kind!r}")
    token = _chosen.set(kind)
    try:
        yield
    finally:
        _chosen.reset(token)


def triton_runs(*tensors: Tensor) -> bool:
    """Whether Triton works on these tensors.

    Raises:
        DevrfError: Triton was asked for and cannot do it.
    """
    kind = _chosen.get()
    if kind == "torch":
        return False
    first = tensors[0]
    single = all(tensor.dtype == torch.float32 for tensor in tensors)
    ordered = torch.are_deterministic_algorithms_enabled()
    if kind == "auto":
        return first.is_cuda and single and not ordered and passes_check(first.device)
    if ordered:
        raise DevrfError(
            "kernels: triton adds in no fixed order: choose kernels=auto, or deterministic=false"
        )
    if not find_spec("triton"):
        raise DevrfError(
            "kernels: triton is not installed: pip install triton, or choose kernels=auto"
        )
    if not reaches(first.device):
        raise DevrfError(
            f"kernels: triton needs a CUDA device, and these tensors are on the {first.device}: "
            "choose kernels=auto"
        )
    if not single:
        raise DevrfError(
            f"kernels: triton works on float32, not on {first.dtype}: choose kernels=auto"
        )
    return True


def reaches(device: torch.device) -> bool:
    """Whether Triton can work there; on a CPU only its interpreter can, which is for tests."""
    return device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"


def register_check(check: Check) -> None:
    """Make ``check`` one that a device must pass before ``auto`` runs Triton there.

    Args:
        check: raises where Triton's results on the device differ from the twins'.
    """
    _checks.append(check)


@cache
def passes_check(device: torch.device) -> bool:
    """Whether the Triton kernels give what PyTorch gives on this device.

    Run once in a process, in milliseconds once the kernels are compiled. It waits for the
    device, so it must have happened before a CUDA graph is captured. Where a check fails, one
    warning says why.
    """
    try:
        for check in _checks:
            check(device)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        log.warning(
            "kernels: plain PyTorch runs on %s, since the Triton kernels failed their check "
            "there (%s)",
            device,
            reason,
        )
        return False
    return True
