"""Masks as bits, for files."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def pack_bits(mask: Tensor) -> Tensor:
    """A mask of any shape as bits on the host: (⌈N/8⌉,) uint8."""
    return torch.from_numpy(np.packbits(mask.cpu().numpy().reshape(-1), bitorder="little"))


def unpack_bits(bits: Tensor, shape: Sequence[int], device: torch.device | str = "cpu") -> Tensor:
    """The mask of ``shape`` that :func:`pack_bits` packed, on ``device``.

    Raises:
        ValueError: there are too few bits.
    """
    cells = math.prod(shape)
    if 8 * len(bits) < cells:
        raise ValueError("the stored mask is not as long as it should be")
    flat = np.unpackbits(bits.cpu().numpy(), count=cells, bitorder="little").astype(bool)
    return torch.from_numpy(flat).view(*shape).to(device)
