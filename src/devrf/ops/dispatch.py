"""The choice of an operation's implementation: plain PyTorch, or Triton on a CUDA device.

An operation asks :func:`accelerated` once; its backward pass, which autograd may run in another
thread, belongs to the same implementation.

This module imports none of the operations. The check that a device must pass before Triton runs on
it compares all of them, so ``devrf.ops.__init__`` registers it here.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from devrf.errors import DevrfError

log = logging.getLogger(__name__)

Kind = Literal["auto", "torch", "triton"]
# Why kernels cannot be used on a device, by operation.
Check = Callable[[torch.device], Mapping[str, str]]
# Without Triton the shapes of these depend on data: they find samples, and touched rows of grids.
NEEDED_FOR_FIXED_LISTS = ("search", "adam")

_chosen: ContextVar[Kind] = ContextVar("kernels", default="auto")
_checks: list[Check] = []


@contextmanager
def using(kind: Kind) -> Iterator[None]:
    """Choose the implementation of all operations inside the context.

    Args:
        kind: ``torch``, ``triton`` or ``auto``: Triton for float32 tensors on a CUDA device for
            each operation whose kernels pass their check there, unless torch is to be
            deterministic (the kernels add in no fixed order); else PyTorch. A thread started
            inside the context has ``auto``.

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


def accelerated(operation: str, *tensors: Tensor) -> Any:
    """The module of :mod:`devrf.accel` that runs an operation on these tensors; None: PyTorch does.

    Raises:
        DevrfError: ``triton`` was chosen and cannot run.
    """
    if not _triton_suits(*tensors):
        return None
    if _chosen.get() == "auto" and operation in rejected(tensors[0].device):
        return None
    return import_module(f"devrf.accel.{operation}")


def triton_runs(*tensors: Tensor) -> bool:
    """Whether Triton runs on these tensors, so that lists have a fixed length.

    Raises:
        DevrfError: ``triton`` was chosen and cannot run.
    """
    if not _triton_suits(*tensors):
        return False
    return _chosen.get() == "triton" or rejected(tensors[0].device).isdisjoint(
        NEEDED_FOR_FIXED_LISTS
    )


def _triton_suits(*tensors: Tensor) -> bool:
    """Whether Triton is chosen and can run on these tensors."""
    kind = _chosen.get()
    if kind == "torch":
        return False
    first = tensors[0]
    single = all(tensor.dtype == torch.float32 for tensor in tensors)
    ordered = torch.are_deterministic_algorithms_enabled()
    if kind == "auto":
        return first.is_cuda and single and not ordered
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
    """Whether Triton can run there; on a CPU only its interpreter can, for tests."""
    return device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"


def register_check(check: Check) -> None:
    """Set the check that ``auto`` makes before Triton runs on a device."""
    _checks[:] = [check]


@cache
def rejected(device: torch.device) -> frozenset[str]:
    """The operations whose Triton kernels differ from PyTorch on a device; warnings name them.

    The check runs once in a process and takes milliseconds after compilation. It waits for the
    device, so it must precede the capture of a CUDA graph.
    """
    reasons = {operation: why for check in _checks for operation, why in check(device).items()}
    for why in dict.fromkeys(reasons.values()):
        operations = ", ".join(name for name in reasons if reasons[name] == why)
        log.warning(
            "kernels: plain PyTorch runs on %s for %s: Triton failed its check (%s)",
            *(device, operations, why),
        )
    return frozenset(reasons)
