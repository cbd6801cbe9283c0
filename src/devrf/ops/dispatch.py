"""The choice of an operation's implementation: plain PyTorch, or Triton on a CUDA device.

A function of this package calls :func:`triton_runs` once; its backward pass, which autograd may run
in another thread, belongs to the same implementation.

This module imports none of the operations. The check that a device must pass before Triton runs on
it compares all of them, so ``devrf.ops.__init__`` registers it here.
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
    """Choose the implementation of all operations inside the context.

    Args:
        kind: ``torch``, ``triton`` or ``auto``: Triton for float32 tensors on a CUDA device where
            its kernels pass their check, unless torch is to be deterministic (the kernels add in
            no fixed order); else PyTorch. A thread started inside the context has ``auto``.

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
    """Whether to use Triton for an operation on these tensors.

    Raises:
        DevrfError: ``triton`` was chosen and cannot run.
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
    """Whether Triton can run there; on a CPU only its interpreter can, for tests."""
    return device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"


def register_check(check: Check) -> None:
    """Add a check that a device must pass before ``auto`` runs Triton there; it raises if not."""
    _checks.append(check)


@cache
def passes_check(device: torch.device) -> bool:
    """Whether the Triton kernels agree with PyTorch on this device; if not, a warning says why.

    The check runs once in a process and takes milliseconds after compilation. It waits for the
    device, so it must precede the capture of a CUDA graph.
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
