"""Grids as checkpoints hold them: packed, as bits, and of the shape they were stored with.

Most of a field's voxels lie in empty space. Their values are not seen, but a deformation field has
to map empty space to empty space, also between frames. So a smooth grid is kept twice, in half
precision: thinned out everywhere, and in detail near occupied space.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from devrf.ops.trilinear import resample
from devrf.system.memory import need_memory

# Grid points of the detailed grid for each one of the thinned-out grid, along an axis.
THINNING = 4

Packed = dict[str, Any]


def pack(grids: Tensor, keep: Tensor, *, smooth: bool) -> Packed | Tensor:
    """Store grids in about 2·C bytes a kept voxel, one after another, on the device of ``keep``.

    Args:
        grids: one grid (X, Y, Z, C), or N of them (N, X, Y, Z, C).
        keep: (N, X, Y, Z) bool, where detail is kept; (1, X, Y, Z) serves all N.
        smooth: the replacement of values elsewhere: True, the trilinear interpolation of every
            fourth grid point; False, each channel's mean over the voxels that are left out.

    Returns:
        Tensors on the host and numbers, by name, for :func:`unpack`; the grids themselves where
        half precision cannot hold a value.
    """
    many = grids.ndim == 5
    *_, x, y, z, channels = grids.shape
    thin = _thinned((x, y, z))
    details = []
    elsewhere = []
    for n, stored in enumerate(grids.reshape(-1, x, y, z, channels)):
        grid = stored.to(keep.device, torch.float32)
        if float(grid.abs().amax()) > torch.finfo(torch.float16).max:
            return grids
        kept_voxels = keep[min(n, len(keep) - 1)]
        details.append(grid[kept_voxels].half().cpu())
        if smooth:
            elsewhere.append(resample(grid, thin).half().cpu())
        else:
            left_out = grid[~kept_voxels]
            mean = left_out.mean(dim=0) if len(left_out) else grid.new_zeros(channels)
            elsewhere.append(mean.half().cpu())
    return {
        "shape": [x, y, z],
        "keep": torch.stack([pack_bits(mask) for mask in keep]),
        "kept": torch.cat(details),
        "elsewhere": torch.stack(elsewhere),
        "many": many,
    }


def unpack(
    stored: Any, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Any:
    """The grids that :func:`pack` stored, on ``device``; other values as they are.

    Raises:
        RuntimeError | KeyError | ValueError: the parts do not fit together.
        OutOfMemoryError: the grids take more than is free.
    """
    if not isinstance(stored, dict) or "kept" not in stored:
        return stored
    x, y, z = (int(points) for points in stored["shape"])
    shape = (x, y, z)
    voxels = x * y * z
    elsewhere = stored["elsewhere"].to(device, torch.float32)
    masks, bits = stored["keep"].shape
    if min(shape) < 1 or bits != math.ceil(voxels / 8) or masks not in (1, len(elsewhere)):
        raise ValueError("masks of other voxels than the grids have")
    if not elsewhere.numel() or elsewhere.ndim not in (2, 5):
        raise ValueError("grids without values")
    values = len(elsewhere) * voxels * elsewhere.shape[-1]
    # A module copies them.
    need_memory(2 * values * dtype.itemsize + masks * voxels, "its fields", device)
    keep = [unpack_bits(mask, shape, device) for mask in stored["keep"]]
    keep = keep * len(elsewhere) if masks == 1 else keep
    details = stored["kept"].to(device, dtype).split([int(mask.sum()) for mask in keep])
    grids: Tensor = elsewhere.new_empty(len(elsewhere), *shape, elsewhere.shape[-1], dtype=dtype)
    for grid, rest, mask, detail in zip(grids, elsewhere, keep, details, strict=True):
        grid.copy_(rest if rest.ndim == 1 else resample(rest, shape))
        grid[mask] = detail
    return grids if stored["many"] else grids[0]


def _thinned(shape: Sequence[int]) -> tuple[int, int, int]:
    x, y, z = (max(2, math.ceil((points - 1) / THINNING) + 1) for points in shape)
    return x, y, z


def pack_bits(mask: Tensor) -> Tensor:
    """A mask of any shape as bits on the host: (⌈N/8⌉,) uint8."""
    return torch.from_numpy(np.packbits(mask.cpu().numpy().reshape(-1), bitorder="little"))


def unpack_bits(bits: Tensor, shape: Sequence[int], device: torch.device | str = "cpu") -> Tensor:
    """The mask of ``shape`` that :func:`pack_bits` packed, on ``device``."""
    flat = np.unpackbits(bits.cpu().numpy(), count=math.prod(shape), bitorder="little")
    return torch.from_numpy(flat.astype(bool)).view(*shape).to(device)


class StoredShape(nn.Module):
    """A module that may be loaded from a state of another resolution.

    Attributes:
        resizable: number of first axes that may be longer or shorter, for parameters and buffers
            that take the stored shape, by name.
    """

    resizable: ClassVar[Mapping[str, int]]

    def takes(self, name: str, shape: Sequence[int]) -> bool:
        """Whether a tensor may have a stored ``shape``; kernels look up two points of an axis."""
        present = getattr(self, name).shape
        fixed = self.resizable[name]
        if len(shape) != len(present) or shape[fixed:] != present[fixed:]:
            return False
        return all(points >= min(2, now) for points, now in zip(shape, present, strict=True))

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for name in self.resizable:
            stored = state_dict.get(prefix + name)
            current = getattr(self, name)
            if stored is None or stored.shape == current.shape:
                continue
            if self.takes(name, stored.shape):
                empty = current.new_empty(stored.shape)
                setattr(self, name, nn.Parameter(empty) if name in self._parameters else empty)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
