"""Pinhole cameras: pixels become rays, points become pixels; and the distortion of real lenses.

Rays are turned by products and sums of their own, not by batched matrix products, which may be
rounded to TF32 on a GPU: at 400 pixels that is a fifth of a pixel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from devrf.geometry.rays import Rays


@dataclass(frozen=True)
class Cameras:
    """N pinhole cameras whose images lie on one raster.

    The camera looks along its negative z axis (OpenGL axes: x right, y up, z backwards). Pixel
    coordinates are (x, y) with (0, 0) the outer corner of the top-left pixel, so the centre of
    the pixel in column i and row j is (i + 0.5, j + 0.5).

    Attributes:
        camera_to_world: (N, 3, 4) rigid transforms, world units.
        focal: (N, 2) focal lengths fx, fy in pixels.
        center: (N, 2) principal points cx, cy in pixels.
        width: the raster's width in pixels.
        height: the raster's height in pixels.
        sizes: (N, 2) int64, width and height of each image, which is the top left of the raster;
            None: all are as large as the raster.
    """

    camera_to_world: Tensor
    focal: Tensor
    center: Tensor
    width: int
    height: int
    sizes: Tensor | None = None

    def check(self) -> None:
        """Check cameras from a file.

        Raises:
            ValueError: shapes that do not agree, or numbers that no camera has.
        """
        count = len(self.camera_to_world)
        tensors = (self.camera_to_world, self.focal, self.center)
        shapes = [tuple(tensor.shape) for tensor in tensors]
        if shapes != [(count, 3, 4), (count, 2), (count, 2)]:
            raise ValueError(f"cameras of the shapes {shapes}")
        single = all(tensor.dtype == torch.float32 for tensor in tensors)
        finite = single and all(bool(tensor.isfinite().all()) for tensor in tensors)
        if not finite or not bool((self.focal > 1e-3).all()):
            raise ValueError("a camera that is not finite, or sees nothing")
        if self.sizes is not None:
            raster = torch.tensor([self.width, self.height])
            whole = self.sizes.dtype == torch.int64 and self.sizes.shape == (count, 2)
            if not whole or not bool(((self.sizes >= 1) & (self.sizes <= raster)).all()):
                raise ValueError("images that are not of the raster")

    def __len__(self) -> int:
        return self.camera_to_world.shape[0]

    def __getitem__(self, index: Tensor | slice | list[int]) -> Cameras:
        """The cameras at ``index``; always N of them, so an int is not an index."""
        return self._mapped(lambda of_cameras: of_cameras[index])

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        changed: dict[str, Any] = {n: change(v) for n, v in values if isinstance(v, Tensor)}
        return replace(self, **changed)

    @property
    def extents(self) -> Tensor:
        """(N, 2) width and height of each image in pixels, in floating point."""
        if self.sizes is None:
            return self.center.new_tensor([self.width, self.height]).expand(len(self), 2)
        return self.sizes.to(self.center)

    def size_of(self, index: int) -> tuple[int, int]:
        """Width and height of one image in pixels."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes[index].tolist()
        return width, height

    def single(self, index: int) -> Cameras:
        """One of the cameras alone, its raster that of its image."""
        width, height = self.size_of(index)
        return replace(self[index : index + 1], width=width, height=height, sizes=None)

    def of_commonest_size(self) -> Cameras:
        """The cameras with images of one size, the commonest.

        Those of another size have the lens of the first of that one.
        """
        if self.sizes is None:
            return self
        sizes = [tuple(size) for size in self.sizes.tolist()]
        commonest = Counter(sizes).most_common(1)[0][0]
        first = sizes.index(commonest)
        lens = [k if size == commonest else first for k, size in enumerate(sizes)]
        return replace(
            self.single(first),
            camera_to_world=self.camera_to_world,
            focal=self.focal[lens],
            center=self.center[lens],
        )

    def joined(self, *others: Cameras) -> Cameras:
        """These cameras and ``others``, on the same raster."""
        parts = (self, *others)
        several = any(cameras.sizes is not None for cameras in parts)
        return replace(
            self,
            camera_to_world=torch.cat([cameras.camera_to_world for cameras in parts]),
            focal=torch.cat([cameras.focal for cameras in parts]),
            center=torch.cat([cameras.center for cameras in parts]),
            sizes=torch.cat([c.extents.long() for c in parts]) if several else None,
        )

    @property
    def positions(self) -> Tensor:
        """(N, 3) camera centres in world units."""
        return self.camera_to_world[:, :, 3]

    @property
    def forwards(self) -> Tensor:
        """(N, 3) unit viewing directions of the optical axes, in world space."""
        return -self.camera_to_world[:, :, 2]

    def pixel_size(self, point: Tensor) -> float:
        """The edge of a pixel at a ``point`` (3,), in world units: the median over the cameras."""
        distance = (self.positions - point.to(self.positions)).norm(dim=1)
        return float((distance / self.focal.mean(dim=1)).median())

    def rays(self, camera: Tensor, pixels: Tensor) -> Rays:
        """World-space rays through pixels.

        Args:
            camera: (M,) the camera of each ray.
            pixels: (M, 2) x, y in pixels (a pixel's centre is at i + 0.5).

        Returns:
            M rays with unit directions that start at the camera centres.
        """
        center = self.center.index_select(0, camera)
        offsets = (pixels - center) / self.focal.index_select(0, camera)
        x, y = offsets[..., None].unbind(1)
        pose = self.camera_to_world.index_select(0, camera)
        right, up, backward, _ = pose.unbind(-1)
        directions = right * x - up * y - backward
        directions = torch.nn.functional.normalize(directions, dim=-1)
        return Rays(pose[:, :, 3], directions, directions)

    def project(self, camera: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels on which world points fall: the inverse of :meth:`rays`.

        Args:
            camera: (M,) the camera of each point.
            points: (M, 3) world units.

        Returns:
            pixels (M, 2) as x, y, and the depth (M,) along the optical axis in world units;
            a point with depth ≤ 0 is behind the camera and its pixel means nothing.
        """
        pose = self.camera_to_world.index_select(0, camera)
        x, y, z = (points - pose[:, :, 3])[..., None].unbind(1)
        # Not by bmm, whose sums depend on the number of threads.
        local = pose[:, 0, :3] * x + pose[:, 1, :3] * y + pose[:, 2, :3] * z
        focal = self.focal.index_select(0, camera)
        return _on_image(local, focal, self.center.index_select(0, camera))

    def project_into(self, camera: int, points: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`project`, for all ``points`` (M, 3) in one camera: a matrix product."""
        pose = self.camera_to_world[camera]
        local = (points - pose[:, 3]) @ pose[:, :3]
        return _on_image(local, self.focal[camera], self.center[camera])

    def pixel_grid(self) -> Tensor:
        """(H·W, 2) pixel centres x, y in row-major order."""
        device = self.focal.device
        dtype = self.focal.dtype
        y, x = torch.meshgrid(
            torch.arange(self.height, device=device, dtype=dtype),
            torch.arange(self.width, device=device, dtype=dtype),
            indexing="ij",
        )
        return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5

    def image_rays(self, camera: int) -> Rays:
        """All H·W rays of one camera, in row-major order.

        They are those of :meth:`rays`, computed from columns and rows: a GPU has half as many
        launches.
        """
        device = self.focal.device
        dtype = self.focal.dtype
        columns = torch.arange(0.5, self.width, device=device, dtype=dtype)
        rows = torch.arange(0.5, self.height, device=device, dtype=dtype)
        center = self.center[camera]
        focal = self.focal[camera]
        x = (columns - center[0]) / focal[0]
        y = (center[1] - rows) / focal[1]
        right, up, backward, position = self.camera_to_world[camera].unbind(-1)
        of_row = y[:, None] * up - backward
        directions = (x[:, None] * right + of_row[:, None]).view(-1, 3)
        directions = torch.nn.functional.normalize(directions, dim=-1)
        return Rays(position.expand(len(directions), 3).contiguous(), directions, directions)

    def resized(self, width: int, height: int) -> Cameras:
        """The same cameras on another raster (each axis scaled by its own factor)."""
        scale = self.focal.new_tensor([width / self.width, height / self.height])
        sizes = self.sizes
        if sizes is not None:
            old, new = (
                sizes.new_tensor(pair) for pair in ([self.width, self.height], [width, height])
            )
            sizes = (sizes * new // old).clamp(min=1)
        return replace(
            self,
            focal=self.focal * scale,
            center=self.center * scale,
            width=width,
            height=height,
            sizes=sizes,
        )

    def shifted(self, shift: Tensor) -> Cameras:
        """The same cameras whose rays go through ``shift`` (2,) beside the pixels' centres."""
        return replace(self, center=self.center - shift)

    def of_height(self, height: int) -> Cameras:
        """The same cameras with images ``height`` pixels high and as wide as they were for it."""
        return self.resized(max(1, round(self.width * height / self.height)), height)

    def rows(self, first: int, last: int) -> Cameras:
        """The same cameras with the rows ``first`` … ``last`` − 1 of the raster alone."""
        center = self.center - self.center.new_tensor([0.0, float(first)])
        return replace(self, center=center, height=last - first)

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on ``device``."""
        return self._mapped(lambda of_cameras: of_cameras.to(device))

    @staticmethod
    def looking_at(
        positions: Tensor,
        targets: Tensor,
        *,
        focal: float,
        width: int,
        height: int,
        up: Tensor | None = None,
    ) -> Cameras:
        """Cameras at ``positions`` (N, 3) that look at ``targets`` (N, 3).

        Args:
            positions: camera centres, world units.
            targets: the point that each looks at, world units.
            focal: focal length in pixels; the principal point is the image's centre.
            width: image width in pixels.
            height: image height in pixels.
            up: (3,) or (N, 3), the direction that is up in the images; None: world z.
        """
        backward = torch.nn.functional.normalize(positions - targets, dim=-1)
        up = positions.new_tensor([0.0, 0.0, 1.0]) if up is None else up
        up = up.expand_as(backward)
        # A camera that looks straight up or down has no horizon: any other direction serves.
        other = torch.eye(3).to(up)[up.abs().argmin(dim=-1)]
        vertical = (backward * up).sum(dim=-1, keepdim=True).abs() > 0.999
        up = torch.where(vertical, other, up)
        right = torch.nn.functional.normalize(torch.linalg.cross(up, backward), dim=-1)
        upward = torch.linalg.cross(backward, right)
        pose = torch.stack([right, upward, backward, positions], dim=-1)
        count = len(positions)
        return Cameras(
            pose,
            positions.new_full((count, 2), focal),
            positions.new_tensor([width / 2, height / 2]).repeat(count, 1),
            width,
            height,
        )


def pixel_positions(flat: Tensor, width: int, per_pixel: int = 1) -> Tensor:
    """Where the rays of pixels go through, (P · ``per_pixel``, 2), x then y, in pixels.

    One ray goes through the pixel's centre. Four go through the middles of its quarters, row by
    row; two through opposite quarters, on one diagonal and on the other in turn.

    Args:
        flat: (P,) row-major numbers of the pixels in their image.
        width: of the image, in pixels.
        per_pixel: 1, 2 or 4; the rays of a pixel follow one another.
    """
    corner = torch.stack([flat % width, flat // width], dim=-1)[:, None]
    if per_pixel == 1:
        return corner[:, 0] + 0.5
    part = torch.arange(per_pixel, device=flat.device).expand(len(flat), -1)
    right, down = part % 2, part // 2
    if per_pixel == 2:
        down = part
        right = (part + torch.arange(len(flat), device=flat.device)[:, None]) % 2
    middle = 0.5 * torch.stack([right, down], dim=-1) + 0.25
    return (corner + middle).flatten(0, 1)


def _on_image(local: Tensor, focal: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (M, 2) and depths (M,) of points (M, 3) in a camera's own axes."""
    x, y, z = local.unbind(-1)
    depth = -z
    safe = torch.where(depth.abs() < 1e-8, torch.full_like(depth, 1e-8), depth)
    return torch.stack([x / safe, -y / safe], dim=-1) * focal + center, depth


@dataclass(frozen=True)
class Distortion:
    """A real lens's displacement of a pinhole's points (Brown 1966, as in OpenCV).

    Points are (x/z, y/z) of a camera whose x points right and y down, before focal lengths and
    principal point. With r² = x² + y² and g = 1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸,

        x' = g·x + 2·p1·x·y + p2·(r² + 2x²),    y' = g·y + p1·(r² + 2y²) + 2·p2·x·y.

    Attributes:
        radial: k1, k2, k3, k4: OpenCV's first three, and a fourth term of the same series.
        tangential: p1, p2.
    """

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def none(self) -> bool:
        """Whether the lens is a pinhole."""
        return not any(self.radial) and not any(self.tangential)

    def distort(self, points: Tensor) -> Tensor:
        """The lens's images (..., 2) of the pinhole's ``points`` (..., 2)."""
        x, y = points.unbind(-1)
        square, gain, _ = self._radial(x, y)
        p1, p2 = self.tangential
        cross = 2 * x * y
        return torch.stack(
            [
                gain * x + p1 * cross + p2 * (square + 2 * x * x),
                gain * y + p1 * (square + 2 * y * y) + p2 * cross,
            ],
            dim=-1,
        )

    def upright(self, points: Tensor) -> Tensor:
        """Mask (...,) of the pinhole's ``points`` (..., 2) that lie before the fold."""
        xx, xy, yy = self._jacobian(points)
        return (xx + yy > 0) & (xx * yy - xy * xy > 0)

    def _radial(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """r², the gain g, and dg/d(r²)."""
        k1, k2, k3, k4 = self.radial
        s = x * x + y * y
        gain = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        return s, gain, k1 + s * (2 * k2 + s * (3 * k3 + s * 4 * k4))

    def _jacobian(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """dx'/dx, dx'/dy = dy'/dx, and dy'/dy."""
        x, y = points.unbind(-1)
        _, gain, slope = self._radial(x, y)
        p1, p2 = self.tangential
        return (
            gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
            gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )
