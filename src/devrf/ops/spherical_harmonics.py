"""Real spherical harmonics."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import constant

# Of degrees 0 to 3: √(1/4π), √(3/4π), √(15/4π), √(5/16π) and so on.
FACTORS = (
    0.2820948, -0.4886025, 0.4886025, -0.4886025, 1.0925484, -1.0925484, 0.3153916, -1.0925484,
    0.5462742, -0.5900436, 2.8906114, -0.4570458, 0.3731763, -0.4570458, 1.4453057, -0.5900436,
)  # fmt: skip


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The real spherical harmonics of degrees 0 to 3, (R, 16), of unit vectors (R, 3)."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = directions.square().unbind(1)
    values = [
        torch.ones_like(x), y, z, x, x * y, y * z, 3 * zz - 1, x * z, xx - yy,
        y * (3 * xx - yy), x * y * z, y * (5 * zz - 1), z * (5 * zz - 3), x * (5 * zz - 1),
        z * (xx - yy), x * (xx - 3 * yy),
    ]  # fmt: skip
    return torch.stack(values, dim=1) * constant(FACTORS, x.dtype, x.device)
