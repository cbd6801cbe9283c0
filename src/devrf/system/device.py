"""What a device does: waiting for its queue, and the arithmetic that it is quick at."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor


def wait(device: torch.device) -> None:
    """Return when the device has done all that is queued."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def arriving(values: Mapping[str, Tensor]) -> Callable[[], dict[str, float]]:
    """Begin to copy numbers () of one device to the host; call the result where they are needed.

    Only that waits, and only for the copy: for nothing that the device was given later.
    """
    if not values:
        return dict
    sent = torch.stack([value.detach() for value in values.values()])
    if sent.device.type != "cuda":
        return lambda: dict(zip(values, sent.tolist(), strict=True))
    host = torch.empty(sent.shape, dtype=sent.dtype, pin_memory=True)
    host.copy_(sent, non_blocking=True)
    copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
    copied.record()

    def read() -> dict[str, float]:
        copied.synchronize()
        return dict(zip(values, host.tolist(), strict=True))

    return read


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether ``device`` multiplies bfloat16 faster: NVIDIA's GPUs from Ampere on.

    A CPU does not: oneDNN compiles its products anew for each number of samples.
    """
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)
