"""Pixels of images: their rays, colours and optical flow; a thread looks up one ray."""

import torch
import warp as wp
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.kernels.runtime import cached_kernel, launch, row_type

# A pixel's x and y.
Xy = row_type(2)
# A row of a camera's pose: right, up, backward, and its position.
Axis = row_type(4)


def look_up(
    pixels: Tensor,
    cameras: Cameras,
    of_images: tuple[Tensor, Tensor],
    flow: tuple[Tensor, Tensor] | None,
    image: Tensor,
    flat: Tensor,
    background: Tensor,
    per_pixel: int,
) -> tuple[Tensor, ...]:
    """Rays and the truth at their pixels, by a kernel; ``devrf.methods.batch`` has the definition.

    Args:
        pixels: (N, H, W, 3 or 4) uint8, of fewer than 2³¹ pixels.
        cameras: the images'.
        of_images: times (N,), and frames (N,) int64.
        flow: (N, H, W, 2) and where it is valid (N, H, W); None.
        image: (R,) int64, the image of each ray; the rays of a pixel follow one another.
        flat: (R,) int64, row-major pixel number within it.
        background: (3,) or (R, 3) that images with alpha are composited on.
        per_pixel: the rays of a pixel; :func:`~devrf.geometry.cameras.pixel_positions` says where
            they go through.

    Returns:
        Positions in the images (R, 2), origins and directions of rays, colours (R, 3), alphas,
        times, frames (R,); then flow (R, 2), 0 where it is not valid, and valid (R,). Empty: what
        images lack.
    """
    count, device, has_alpha = len(image), image.device, pixels.shape[3] == 4
    nowhere = torch.empty(0, dtype=torch.bool, device=device)
    vectors, valid = flow or (background.new_empty(0, 2), nowhere)
    alphas, flows = count * has_alpha, count * (flow is not None)
    results = [
        *(torch.empty(count, size, device=device) for size in (2, 3, 3, 3)),
        *(torch.empty(size, device=device) for size in (alphas, count)),
        torch.empty(count, dtype=torch.int64, device=device),
        torch.empty(flows, 2, device=device),
        torch.empty(flows, dtype=torch.bool, device=device),
    ]
    inputs = [per_pixel, pixels.shape[1], pixels.shape[2], pixels]
    inputs += [cameras.camera_to_world, cameras.focal, cameras.center, *of_images]
    inputs += [vectors, valid.flatten(), image, flat, background.contiguous().view(-1, 3)]
    inputs += results
    launch(look_up_kernel(has_alpha), count, inputs, device)
    return tuple(results)


@cached_kernel
def look_up_kernel(has_alpha: bool) -> wp.Kernel:
    """Pixels of 4 channels, or of 3."""
    bytes_of = row_type(3 + has_alpha, wp.uint8)

    @wp.kernel(module="unique", enable_backward=False)
    def look_up(
        first: int,
        per_pixel: int,
        height: int,
        width: int,
        pixels: wp.array(dtype=bytes_of),
        poses: wp.array(dtype=Axis),
        focals: wp.array(dtype=Xy),
        centers: wp.array(dtype=Xy),
        times: wp.array(dtype=float),
        frames: wp.array(dtype=wp.int64),
        vectors: wp.array(dtype=Xy),
        valid: wp.array(dtype=wp.bool),
        images: wp.array(dtype=wp.int64),
        flats: wp.array(dtype=wp.int64),
        background: wp.array(dtype=wp.vec3),
        result_pixel: wp.array(dtype=Xy),
        result_origin: wp.array(dtype=wp.vec3),
        result_direction: wp.array(dtype=wp.vec3),
        result_color: wp.array(dtype=wp.vec3),
        result_alpha: wp.array(dtype=float),
        result_time: wp.array(dtype=float),
        result_frame: wp.array(dtype=wp.int64),
        result_flow: wp.array(dtype=Xy),
        result_valid: wp.array(dtype=wp.bool),
    ):
        """As ``Cameras.rays`` and ``gather_batch``."""
        number = first + wp.tid()
        image = int(images[number])
        flat = int(flats[number])
        row = image * height * width + flat
        x = float(flat % width) + 0.5
        y = float(flat / width) + 0.5
        if per_pixel > 1:
            part = number % per_pixel
            right = part % 2
            down = part / 2
            if per_pixel == 2:
                right = (part + number / 2) % 2
                down = part
            x += 0.5 * float(right) - 0.25
            y += 0.5 * float(down) - 0.25
        result_pixel[number] = Xy(x, y)
        result_time[number] = times[image]
        result_frame[number] = frames[image]

        across = (x - centers[image][0]) / focals[image][0]
        up = (y - centers[image][1]) / focals[image][1]
        origin = wp.vec3()
        direction = wp.vec3()
        for axis in range(3):
            pose = poses[3 * image + axis]
            direction[axis] = pose[0] * across - pose[1] * up - pose[2]
            origin[axis] = pose[3]
        result_origin[number] = origin
        result_direction[number] = direction / wp.max(wp.length(direction), 1.0e-12)

        color = wp.vec3()
        for channel in range(3):
            color[channel] = float(pixels[row][channel]) / 255.0
        if wp.static(has_alpha):
            alpha = float(pixels[row][wp.static(2 + has_alpha)]) / 255.0
            behind = background[wp.min(number, background.shape[0] - 1)]
            color = behind + alpha * (color - behind)
            result_alpha[number] = alpha
        result_color[number] = color

        if valid.shape[0] > 0:
            result_valid[number] = valid[row]
            result_flow[number] = Xy(0.0, 0.0)
            if valid[row]:
                result_flow[number] = vectors[row]

    return look_up
