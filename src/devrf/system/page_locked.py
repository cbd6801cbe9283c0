"""Page-locked memory of exactly the size that is asked for."""

from __future__ import annotations

import mmap
from contextlib import suppress
from math import prod

import torch
from torch import Tensor


def page_locked(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """A tensor of zeros on the host that a GPU copies without the processor's help.

    torch's own page-locked memory is rounded up to a power of two and kept when its tensor goes:
    2.5 GB take 4. This memory is locked where it is, and unlocked with its tensor.

    Raises:
        RuntimeError: the system does not allow to lock as much.
    """
    size = prod(shape) * dtype.itemsize
    if not size:
        return torch.empty(shape, dtype=dtype)
    return torch.frombuffer(_locked(size), dtype=dtype, count=prod(shape)).view(shape)


class _LockedMemory(mmap.mmap):
    """Memory that is unlocked before it is given back to the system."""

    place = 0

    def __del__(self) -> None:
        if self.place:
            torch.cuda.synchronize()  # copies from or to it may be under way
            torch.cuda.cudart().cudaHostUnregister(self.place)  # type: ignore[no-untyped-call]


def _locked(size: int) -> _LockedMemory:
    memory = _LockedMemory(-1, size)
    place = torch.frombuffer(memory, dtype=torch.uint8).data_ptr()
    runtime = torch.cuda.cudart()  # type: ignore[no-untyped-call]
    status = int(runtime.cudaHostRegister(place, size, 0))
    if status:
        # The error stays pending, and the next kernel that is launched would raise it.
        with suppress(Exception):
            torch.zeros(1, device="cuda")
        raise RuntimeError(f"CUDA does not lock {size} bytes (error {status})")
    memory.place = place
    return memory
