"""3D Gaussians seen by a pinhole camera: all Gaussians × all pixels.

See docs/methods/gaussians.md#splatting (Zwicker et al. 2001; Kerbl et al. 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from devrf.geometry.cameras import Cameras

# Pixels², added to a Gaussian's covariance in the picture: none is smaller than a pixel.
LOW_PASS = 0.3
# An opacity below FAINTEST counts as none; none is more than MOST.
FAINTEST = 1 / 255
MOST = 0.99
# What lies behind a lower transmittance is invisible.
STOP = 1e-4
# The perspective is linearised inside the picture and in a margin of so much of its size.
MARGIN = 0.15


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians.

    Attributes:
        means: (N, 3) μ, world units.
        scales: (N, 3) standard deviations along the axes of each, world units.
        quaternions: (N, 4) the rotations of the axes, w first, of any length but 0.
        opacity: (N,) o in [0, 1], in the middle of each.
        color: (N, 3) RGB.
    """

    means: Tensor
    scales: Tensor
    quaternions: Tensor
    opacity: Tensor
    color: Tensor


@dataclass(frozen=True)
class SplatImage:
    """An image of Gaussians, its pixels in row-major order.

    Attributes:
        color: (H·W, 3) Σ w_i c_i, without a background.
        depth: (H·W,) Σ w_i z_i with depths z_i of the means along the optical axis.
        transmittance: (H·W,) T_end, behind the last Gaussian.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor


def splat(
    gaussians: Gaussians, camera: Cameras, near: float, shift: Tensor | None = None
) -> SplatImage:
    """Project Gaussians and composite them by the depths of their means.

    In a picture a Gaussian has the covariance V = J W Σ Wᵀ Jᵀ + 0.3 pixels², J being the slope of
    the perspective at its mean and W the camera's axes, and at a pixel d away from its centre the
    opacity α = o · exp(−½ dᵀ V⁻¹ d). As along a ray, w_i = T_i α_i.

    Args:
        gaussians: N Gaussians.
        camera: one camera.
        near: Gaussians whose means are less deep are left out; above 0, world units.
        shift: (N, 2) pixels, added to the centres in the picture: zeros, whose gradient is that of
            the centres.

    Returns:
        The image, differentiable in the Gaussians and the shift.
    """
    pose = camera.camera_to_world[0].to(gaussians.means)
    right, up, backward, position = pose.unbind(-1)
    world = torch.stack([right, -up, -backward])
    local = (gaussians.means - position) @ world.T
    # Of equal depths the first in memory is in front.
    order = local[:, 2].argsort(stable=True)
    order = order[local[order, 2] >= near]
    depth = local[order, 2]
    tangent = local[order, :2] / depth[:, None]

    focal, middle = camera.focal[0].to(pose), camera.center[0].to(pose)
    center = focal * tangent + middle
    if shift is not None:
        center = center + shift[order]
    size = pose.new_tensor([camera.width, camera.height])
    low, high = (-MARGIN * size - middle) / focal, ((1 + MARGIN) * size - middle) / focal
    bounded = tangent.clamp(low, high)
    identity = torch.eye(2).to(pose)
    jacobian = torch.cat([identity.expand(len(order), 2, 2), -bounded[:, :, None]], dim=2)
    jacobian = jacobian * (focal / depth[:, None])[:, :, None]
    axes = jacobian @ world @ rotations(gaussians.quaternions[order])
    axes = axes * gaussians.scales[order, None]
    conic = torch.linalg.inv(axes @ axes.mT + LOW_PASS * identity)

    offset = camera.pixel_grid().to(pose)[:, None] - center
    power = -0.5 * torch.einsum("pni,nij,pnj->pn", offset, conic, offset)
    alpha = gaussians.opacity[order] * power.exp()
    alpha = torch.where(alpha >= FAINTEST, alpha.clamp(max=MOST), 0.0)
    alpha = torch.where(_transmittances(alpha)[:, :-1] >= STOP, alpha, 0.0)
    transmittance = _transmittances(alpha)
    weight = alpha * transmittance[:, :-1]
    return SplatImage(weight @ gaussians.color[order], weight @ depth, transmittance[:, -1])


def rotations(quaternions: Tensor, least: float = 1e-12) -> Tensor:
    """The rotations (..., 3, 3) of quaternions (..., 4), w first, of any length.

    They are divided by their length or by ``least``, whichever is more: 0 is no rotation.
    """
    w, x, y, z = normalize(quaternions, dim=-1, eps=least).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=-1).view(*quaternions.shape[:-1], 3, 3)


def _transmittances(alpha: Tensor) -> Tensor:
    """T_i (P, N + 1) before each of opacities (P, N), and behind the last."""
    before: Tensor = pad(1 - alpha, (1, 0), value=1.0)
    return before.cumprod(dim=1)
