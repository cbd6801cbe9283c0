"""Grids as a finished checkpoint holds them, and masks as bits.

Most of a field's voxels lie in empty space. Their values are not seen, but a deformation field has
to map empty space to empty space, also between frames. So a smooth grid is kept twice, in half
precision: thinned out everywhere, and in detail near what is occupied.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from devrf.ops.resampling import resample

# Grid points of the detailed grid to one of the thinned-out grid.
THINNING = 4

# Packing makes grids smaller by this factor at most: a file that claims more is hostile.
MAX_RATIO = 1000

Packed = dict[str, Any]


def pack(grids: Tensor, keep: Tensor, *, smooth: bool) -> Packed:
    """Store grids in about 2·C bytes a kept voxel.

    Args:
        grids: (N, X, Y, Z, C) of finite values.
        keep: (N, X, Y, Z) bool, where detail is kept; (1, X, Y, Z) serves all N.
        smooth: which values elsewhere get: True, the trilinear interpolation of every fourth
            grid point; False, each channel's mean over the voxels that are left out.

    Returns:
        Tensors and numbers by name, for :func:`unpack`.

    Raises:
        ValueError: a value that half precision cannot hold.
    """
    if float(grids.abs().amax()) > torch.finfo(torch.float16).max:
        raise ValueError("a value of the grids is too large for half precision")
    thin = _thinned(grids.shape[1:4])
    kept, elsewhere = [], []
    for n, grid in enumerate(grids):
        here = keep[min(n, len(keep) - 1)]
        kept.append(grid[here].half())
        if smooth:
            elsewhere.append(resample(grid, thin).half())
        else:
            left_out = grid[~here]
            mean = left_out.mean(dim=0) if len(left_out) else grid.new_zeros(grid.shape[-1])
            elsewhere.append(mean.half())
    return {
        "shape": list(grids.shape[1:4]),
        "keep": torch.stack([pack_bits(one) for one in keep]),
        "kept": torch.cat(kept),
        "elsewhere": torch.stack(elsewhere),
    }


def unpack(packed: Packed) -> Tensor:
    """The grids (N, X, Y, Z, C) in single precision that :func:`pack` stored.

    Raises:
        ValueError: the parts do not fit together.
    """
    x, y, z = (int(points) for points in packed["shape"])
    shape = (x, y, z)
    elsewhere, kept = packed["elsewhere"].float(), packed["kept"]
    stored = sum(packed[name].nbytes for name in ("keep", "kept", "elsewhere"))
    if 4 * len(elsewhere) * elsewhere.shape[-1] * x * y * z > MAX_RATIO * stored:
        raise ValueError("the stored grids claim to be larger than they can be")
    keep = [unpack_bits(bits, shape) for bits in packed["keep"]]
    counts = [int(one.sum()) for one in keep]
    if len(keep) == 1:
        keep, counts = keep * len(elsewhere), counts * len(elsewhere)
    if len(keep) != len(elsewhere) or sum(counts) != len(kept):
        raise ValueError("the stored grids are not as long as they should be")
    grids: Tensor = elsewhere.new_empty(len(elsewhere), *shape, elsewhere.shape[-1])
    values = kept.split(counts)
    for grid, rest, here, detail in zip(grids, elsewhere, keep, values, strict=True):
        grid.copy_(rest if rest.ndim == 1 else resample(rest, shape))
        grid[here] = detail.float()
    return grids


def _thinned(shape: Sequence[int]) -> tuple[int, int, int]:
    x, y, z = (max(2, math.ceil((points - 1) / THINNING) + 1) for points in shape)
    return x, y, z


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
