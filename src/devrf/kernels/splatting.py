"""3D Gaussians as pictures, and the adjoint (docs/methods/gaussians.md#splatting).

A picture is cut into tiles, and each Gaussian is listed in every tile that its ellipse touches, by
depth. A thread composites a part of a tile: on a GPU one pixel of 16 × 16; on a CPU the whole tile,
a band of rows, in whose rows a thread visits only the pixels that lie in the ellipse. So a CPU
reads each Gaussian once, and no two of its threads add to the same number.

The adjoint goes front to back, too. Of L's slope towards everything that a pixel composites, Σ_i
∂L/∂w_i w_i + ∂L/∂T_end T_end, which is known from the picture, what a Gaussian lets through is what
remains behind it. Sums over the pixels of each pair of Gaussian and tile have a row of their own; a
Gaussian's rows are added in their order.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import warp as wp
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.runtime import array, empty_structs, is_supported, launch, row_type
from devrf.ops import splatting as definition
from devrf.ops.splatting import FAINTEST, LOW_PASS, MARGIN, MOST, STOP, Gaussians, SplatImage
from devrf.system.memory import OutOfMemoryError

# Rows of a tile on a CPU, whose pixels stay in its cache; width and height of one on a GPU.
BAND = 32
TILE = 16
# Pixels of a row from one exponential to the next. Between them it is a recurrence: a picture of
# 400 × 400 and its adjoint take two thirds of the time, and it drifts by less than 1e-5.
EXACT = 16
# Pairs of a Gaussian and a tile that it touches, at most; each takes some 60 bytes.
MOST_PAIRS = 2**26
# RGB and depth; a quaternion.
Vec4 = row_type(4)
# A row of sums: of the slopes of RGB, depth, opacity, centre (2), and of the conic's entries (3).
Sums = row_type(10)


def splat(
    gaussians: Gaussians, camera: Cameras, near: float, shift: Tensor | None = None
) -> SplatImage:
    """As :func:`devrf.ops.splatting.splat`, differentiable once."""
    means = gaussians.means
    if not is_supported(means):
        return definition.splat(gaussians, camera, near, shift)
    raster = raster_of(camera.width, camera.height, near, means.is_cuda)
    right, up, backward, position = camera.camera_to_world[0].unbind(-1)
    parts = [right, -up, -backward, position, camera.focal[0], camera.center[0]]
    pinhole = array(torch.cat(parts).to(means)[None], Pinhole)
    shift = torch.zeros_like(means[:, :2]) if shift is None else shift
    opacity = gaussians.opacity[:, None]
    columns = [means, gaussians.scales, gaussians.quaternions, opacity, gaussians.color, shift]
    learned = torch.cat(columns, dim=1)
    table, device, count = learned.detach(), means.device, len(means)
    splats = empty_structs(Projected, count, device)
    tiles = torch.empty(count, dtype=torch.int32, device=device)
    scene = [raster, pinhole, array(table, Gaussian)]
    launch(project_kernel, count, [*scene, splats, tiles], device)

    starts = tiles.cumsum(0, dtype=torch.int32) - tiles
    pairs = int(tiles.sum())
    if pairs > MOST_PAIRS:
        raise OutOfMemoryError(
            f"{count} Gaussians lie in {pairs} tiles of a picture of {raster.width}x"
            f"{raster.height} px, {MOST_PAIRS} at most; take a smaller one"
        )
    keys = torch.empty(pairs, dtype=torch.int64, device=device)
    owner = torch.empty(pairs, dtype=torch.int32, device=device)
    launch(list_kernel, count, [raster, splats, tiles, starts, keys, owner], device)
    keys, order = keys.sort(stable=True)
    edges = torch.arange(raster.tiles + 1, device=device) << 32
    edges = torch.searchsorted(keys, edges, out_int32=True)

    color = torch.zeros(raster.width * raster.height, 4, device=device)
    transmittance = torch.ones(len(color), device=device)
    listed = [raster, edges, order.int(), owner, splats]
    threads = raster.tiles * raster.threads
    launch(composite_kernel, threads, [*listed, color, transmittance], device, grain=1)

    def adjoint(of_color: Tensor, of_transmittance: Tensor) -> tuple[Tensor]:
        behind = (of_color * color).sum(dim=1) + of_transmittance * transmittance
        sums = torch.zeros(pairs, 10, device=device)
        passed = torch.ones_like(transmittance)
        arguments = [*listed, of_color, passed, behind, sums]
        launch(composite_adjoint_kernel, threads, arguments, device, grain=1)
        slopes = torch.zeros_like(table)
        arguments = [*scene, splats, tiles, starts, sums, array(slopes, Gaussian)]
        launch(project_adjoint_kernel, count, arguments, device)
        return (slopes,)

    image, end = with_adjoint((color, transmittance), (learned,), adjoint)
    return SplatImage(image[:, :3], image[:, 3], end)


@wp.struct
class Raster:
    """A picture's pixels in tiles; each of a tile's ``threads`` has all of its pixels, or one."""

    width: int
    height: int
    tile_width: int
    tile_height: int
    tiles_across: int
    tiles: int
    threads: int
    near: float


@lru_cache(maxsize=256)
def raster_of(width: int, height: int, near: float, on_gpu: bool) -> Raster:
    """The tiles of a picture for a GPU or for a CPU; ``near`` is the least depth of a mean."""
    raster = Raster()
    raster.width, raster.height, raster.near = width, height, near
    raster.tile_width, raster.tile_height = (TILE, TILE) if on_gpu else (width, min(BAND, height))
    raster.threads = TILE * TILE if on_gpu else 1
    raster.tiles_across = -(-width // raster.tile_width)
    raster.tiles = raster.tiles_across * -(-height // raster.tile_height)
    return raster


@wp.struct
class Pinhole:
    """A camera: its axes and position in the world, focal lengths, principal point in pixels."""

    right: wp.vec3
    down: wp.vec3
    ahead: wp.vec3
    position: wp.vec3
    focal: wp.vec2
    middle: wp.vec2


@wp.struct
class Gaussian:
    """A Gaussian in the world, or the slopes of all that it has; the quaternion begins with w."""

    mean: wp.vec3
    scale: wp.vec3
    quaternion: Vec4
    opacity: float
    color: wp.vec3
    shift: wp.vec2


@wp.struct
class Projected:
    """A Gaussian in the picture.

    Attributes:
        x, y: its centre, in pixels.
        xx, xy, yy: its conic V⁻¹, 1/pixels².
        opacity: o.
        reach: dᵀ V⁻¹ d ≤ reach where it is visible.
        change: exp(−xx), for :func:`falloff`.
        color: RGB and depth.
        left, right, top, bottom: the first pixel that it may touch, and that after the last.
    """

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    opacity: float
    reach: float
    change: float
    color: Vec4
    left: int
    right: int
    top: int
    bottom: int


@wp.func
def perspective(raster: Raster, camera: Pinhole, point: wp.vec3):
    """The perspective at a point in front of the camera.

    Returns the tangents of its angles right and down; its depth; the rows of J W, which are the
    slopes of the pixel's x and y; and, for each, 1 where it follows the tangents, else 0.
    """
    offset = point - camera.position
    z = wp.dot(camera.ahead, offset)
    tangent = wp.vec2(wp.dot(camera.right, offset) / z, wp.dot(camera.down, offset) / z)
    size = wp.vec2(float(raster.width), float(raster.height))
    low = wp.cw_div(-wp.static(MARGIN) * size - camera.middle, camera.focal)
    high = wp.cw_div(wp.static(1.0 + MARGIN) * size - camera.middle, camera.focal)
    inner = wp.min(wp.max(tangent, low), high)
    slope_x = (camera.focal[0] / z) * (camera.right - inner[0] * camera.ahead)
    slope_y = (camera.focal[1] / z) * (camera.down - inner[1] * camera.ahead)
    free_x = wp.where(inner[0] == tangent[0], 1.0, 0.0)
    free_y = wp.where(inner[1] == tangent[1], 1.0, 0.0)
    return tangent, z, slope_x, slope_y, wp.vec2(free_x, free_y)


@wp.func
def rotation(quaternion: Vec4):
    """Warp's unit quaternion, w last."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return wp.normalize(wp.quat(x, y, z, w))


@wp.kernel(module="unique", enable_backward=False)
def project_kernel(
    first: int,
    raster: Raster,
    cameras: wp.array(dtype=Pinhole),
    gaussians: wp.array(dtype=Gaussian),
    result: wp.array(dtype=Projected),
    result_tiles: wp.array(dtype=int),
):
    """Each Gaussian in the picture, and the number of tiles that it touches: 0 if it is unseen."""
    number = first + wp.tid()
    result_tiles[number] = 0
    gaussian = gaussians[number]
    camera = cameras[0]
    splat = Projected()
    splat.opacity = gaussian.opacity
    splat.reach = 2.0 * wp.log(gaussian.opacity / wp.static(FAINTEST))
    depth = wp.dot(camera.ahead, gaussian.mean - camera.position)
    if depth < raster.near or not splat.reach >= 0.0:
        return
    tangent, z, slope_x, slope_y, _ = perspective(raster, camera, gaussian.mean)
    center = wp.cw_mul(camera.focal, tangent) + camera.middle + gaussian.shift
    splat.x = center[0]
    splat.y = center[1]
    turn = rotation(gaussian.quaternion)
    axis_x = wp.cw_mul(gaussian.scale, wp.quat_rotate_inv(turn, slope_x))
    axis_y = wp.cw_mul(gaussian.scale, wp.quat_rotate_inv(turn, slope_y))
    xx = wp.dot(axis_x, axis_x) + wp.static(LOW_PASS)
    xy = wp.dot(axis_x, axis_y)
    yy = wp.dot(axis_y, axis_y) + wp.static(LOW_PASS)
    # xx yy − xy², without the difference of two large numbers that a needle has.
    determinant = wp.length_sq(wp.cross(axis_x, axis_y))
    determinant += wp.static(LOW_PASS) * (xx + yy - wp.static(LOW_PASS))
    splat.xx = yy / determinant
    splat.xy = -xy / determinant
    splat.yy = xx / determinant
    splat.change = wp.exp(-splat.xx)
    half_x = wp.sqrt(splat.reach * xx)
    half_y = wp.sqrt(splat.reach * yy)
    splat.left = pixel_from(splat.x - half_x, raster.width)
    splat.right = pixel_from(splat.x + half_x, raster.width)
    splat.top = pixel_from(splat.y - half_y, raster.height)
    splat.bottom = pixel_from(splat.y + half_y, raster.height)
    if splat.left >= splat.right or splat.top >= splat.bottom:
        return
    color = gaussian.color
    splat.color = Vec4(color[0], color[1], color[2], z)
    result[number] = splat
    across = (splat.right - 1) / raster.tile_width - splat.left / raster.tile_width + 1
    down = (splat.bottom - 1) / raster.tile_height - splat.top / raster.tile_height + 1
    result_tiles[number] = across * down


@wp.func
def pixel_from(edge: float, size: int):
    """The first pixel whose centre lies beyond an ``edge``, 0 … size: 0 of what is no number."""
    if not edge > 0.5:
        return 0
    return wp.min(int(wp.min(edge - 0.5, 1.0e6)) + 1, size)


@wp.kernel(module="unique", enable_backward=False)
def list_kernel(
    first: int,
    raster: Raster,
    splats: wp.array(dtype=Projected),
    tiles: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    result_key: wp.array(dtype=wp.int64),
    result_owner: wp.array(dtype=int),
):
    """The pairs of Gaussian and tile: keys that ascend by tile, then by depth; the Gaussian."""
    number = first + wp.tid()
    if tiles[number] == 0:
        return
    splat = splats[number]
    # The bits of positive numbers ascend with them.
    depth = wp.int64(wp.cast(splat.color[3], wp.int32))
    pair = starts[number]
    for down in range(splat.top / raster.tile_height, (splat.bottom - 1) / raster.tile_height + 1):
        across = splat.left / raster.tile_width
        while across * raster.tile_width < splat.right:
            tile = wp.int64(down * raster.tiles_across + across)
            result_key[pair] = wp.lshift(tile, wp.int64(32)) + depth
            result_owner[pair] = number
            pair += 1
            across += 1


@wp.func
def pixels_of(raster: Raster, thread: int):
    """A thread's tile, and its pixels: left, top, right, bottom."""
    tile = thread / raster.threads
    left = (tile % raster.tiles_across) * raster.tile_width
    top = (tile / raster.tiles_across) * raster.tile_height
    right, bottom = left + raster.tile_width, top + raster.tile_height
    if raster.threads > 1:
        left += thread % raster.tile_width
        top += (thread % raster.threads) / raster.tile_width
        right, bottom = left + 1, top + 1
    return tile, left, top, wp.min(right, raster.width), wp.min(bottom, raster.height)


@wp.func
def row_of_ellipse(splat: Projected, dy: float, left: int, right: int):
    """The pixels of left … right, of a row ``dy`` below its centre, that lie in the ellipse."""
    # xx dx² + 2 xy dx dy + yy dy² ≤ reach
    square = (splat.xy * splat.xy - splat.xx * splat.yy) * dy * dy + splat.xx * splat.reach
    if square < 0.0:
        return left, left
    middle = splat.x - splat.xy * dy / splat.xx
    half = wp.sqrt(square) / splat.xx
    first = pixel_from(middle - half, right)
    return wp.max(first, left), pixel_from(middle + half, right)


@wp.func
def falloff(splat: Projected, dx: float, dy: float, step: int, last: wp.vec2):
    """exp(−½ dᵀ V⁻¹ d), and its ratio to the next pixel's; ``last`` are those ``step`` before.

    From pixel to pixel the ratio itself changes by the factor exp(−K_xx).
    """
    if step % wp.static(EXACT) != 0:
        return wp.vec2(last[0] * last[1], last[1] * splat.change)
    power = -0.5 * (splat.xx * dx * dx + splat.yy * dy * dy) - splat.xy * dx * dy
    return wp.vec2(wp.exp(power), wp.exp(-splat.xx * (dx + 0.5) - splat.xy * dy))


@wp.kernel(module="unique", enable_backward=False)
def composite_kernel(
    first: int,
    raster: Raster,
    edges: wp.array(dtype=int),
    order: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    splats: wp.array(dtype=Projected),
    result_color: wp.array(dtype=Vec4),
    result_transmittance: wp.array(dtype=float),
):
    """Σ w_i (c_i, z_i), 0 before, and T_end, 1 before, of the pixels of parts of tiles."""
    tile, left, top, right, bottom = pixels_of(raster, first + wp.tid())
    visible = (right - left) * (bottom - top)  # pixels
    k = edges[tile]
    while k < edges[tile + 1] and visible > 0:
        splat = splats[owner[order[k]]]
        k += 1
        for row in range(wp.max(top, splat.top), wp.min(bottom, splat.bottom)):
            dy = float(row) + 0.5 - splat.y
            begin, end = row_of_ellipse(splat, dy, left, right)
            fall = wp.vec2()
            for column in range(begin, end):
                fall = falloff(splat, float(column) + 0.5 - splat.x, dy, column - begin, fall)
                pixel = row * raster.width + column
                before = result_transmittance[pixel]
                if before >= wp.static(STOP):
                    alpha = wp.min(splat.opacity * fall[0], wp.static(MOST))
                    result_color[pixel] = result_color[pixel] + (alpha * before) * splat.color
                    after = before * (1.0 - alpha)
                    result_transmittance[pixel] = after
                    if after < wp.static(STOP):
                        visible -= 1


@wp.kernel(module="unique", enable_backward=False)
def composite_adjoint_kernel(
    first: int,
    raster: Raster,
    edges: wp.array(dtype=int),
    order: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    splats: wp.array(dtype=Projected),
    given_color: wp.array(dtype=Vec4),
    transmittance: wp.array(dtype=float),
    behind: wp.array(dtype=float),
    result: wp.array(dtype=Sums),
):
    """The sums over pixels of each pair of Gaussian and tile.

    ``transmittance`` is 1 before, ``behind`` the slope towards everything; as Gaussians are passed,
    both become those of what remains.

    ∂L/∂α_i = T_i ∂L/∂w_i − (Σ_{j>i} ∂L/∂w_j w_j + ∂L/∂T_end T_end) / (1 − α_i).
    """
    tile, left, top, right, bottom = pixels_of(raster, first + wp.tid())
    visible = (right - left) * (bottom - top)
    k = edges[tile]
    while k < edges[tile + 1] and visible > 0:
        pair = order[k]
        splat = splats[owner[pair]]
        k += 1
        of_color = Vec4()
        of_opacity = float(0.0)
        x, y = float(0.0), float(0.0)
        xx, xy, yy = float(0.0), float(0.0), float(0.0)
        touched = bool(False)
        for row in range(wp.max(top, splat.top), wp.min(bottom, splat.bottom)):
            dy = float(row) + 0.5 - splat.y
            begin, end = row_of_ellipse(splat, dy, left, right)
            row_sum, row_x = float(0.0), float(0.0)
            fall = wp.vec2()
            for column in range(begin, end):
                dx = float(column) + 0.5 - splat.x
                fall = falloff(splat, dx, dy, column - begin, fall)
                pixel = row * raster.width + column
                before = transmittance[pixel]
                if before >= wp.static(STOP):
                    touched = True
                    alpha = wp.min(splat.opacity * fall[0], wp.static(MOST))
                    weight = alpha * before
                    given = given_color[pixel]
                    of_color += weight * given
                    of_weight = wp.dot(given, splat.color)
                    remains = behind[pixel] - weight * of_weight
                    behind[pixel] = remains
                    after = before * (1.0 - alpha)
                    transmittance[pixel] = after
                    if after < wp.static(STOP):
                        visible -= 1
                    if alpha < wp.static(MOST):
                        of_alpha = before * of_weight - remains / (1.0 - alpha)
                        of_opacity += of_alpha * fall[0]
                        of_power = of_alpha * alpha
                        row_sum += of_power
                        row_x += of_power * dx
                        xx += of_power * dx * dx
            x += row_x
            y += row_sum * dy
            xy += row_x * dy
            yy += row_sum * dy * dy
        if touched:
            c = of_color
            sums = Sums(c[0], c[1], c[2], c[3], of_opacity, x, y, xx, xy, yy)
            # A GPU's threads share a tile.
            wp.atomic_add(result, pair, sums)


@wp.kernel(module="unique", enable_backward=False)
def project_adjoint_kernel(
    first: int,
    raster: Raster,
    cameras: wp.array(dtype=Pinhole),
    gaussians: wp.array(dtype=Gaussian),
    splats: wp.array(dtype=Projected),
    tiles: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    sums: wp.array(dtype=Sums),
    result: wp.array(dtype=Gaussian),
):
    """Each Gaussian's slopes, 0 before, from the sums of its pairs.

    With A = J W R S and K = V⁻¹ of V = A Aᵀ + 0.3, sums Σ p d and Q = Σ p d dᵀ over the pixels d
    away, p the slope of −½ dᵀ K d: the centre has the slope K Σ p d, A has K Q K A.
    """
    number = first + wp.tid()
    if tiles[number] == 0:
        return
    total = Sums()
    for pair in range(starts[number], starts[number] + tiles[number]):
        total += sums[pair]
    gaussian = gaussians[number]
    camera = cameras[0]
    splat = splats[number]
    tangent, z, slope_x, slope_y, free = perspective(raster, camera, gaussian.mean)
    turn = rotation(gaussian.quaternion)
    local_x = wp.quat_rotate_inv(turn, slope_x)
    local_y = wp.quat_rotate_inv(turn, slope_y)
    axis_x = wp.cw_mul(gaussian.scale, local_x)
    axis_y = wp.cw_mul(gaussian.scale, local_y)

    slope = Gaussian()
    slope.color = wp.vec3(total[0], total[1], total[2])
    slope.opacity = total[4]
    conic = wp.mat22(splat.xx, splat.xy, splat.xy, splat.yy)
    slope.shift = conic * wp.vec2(total[5], total[6])
    of_v = conic * wp.mat22(total[7], total[8], total[8], total[9]) * conic
    of_axis_x = of_v[0, 0] * axis_x + of_v[0, 1] * axis_y
    of_axis_y = of_v[1, 0] * axis_x + of_v[1, 1] * axis_y
    slope.scale = wp.cw_mul(of_axis_x, local_x) + wp.cw_mul(of_axis_y, local_y)
    of_local_x = wp.cw_mul(gaussian.scale, of_axis_x)
    of_local_y = wp.cw_mul(gaussian.scale, of_axis_y)
    of_turn = turned_back_slope(turn, slope_x, of_local_x)
    of_turn += turned_back_slope(turn, slope_y, of_local_y)
    # Of a unit quaternion: only across it, and less the longer the one that was given.
    unit = Vec4(turn[3], turn[0], turn[1], turn[2])
    across = of_turn - wp.dot(of_turn, unit) * unit
    slope.quaternion = across / wp.length(gaussian.quaternion)

    of_slope_x = wp.quat_rotate(turn, of_local_x)
    of_slope_y = wp.quat_rotate(turn, of_local_y)
    of_tangent = wp.vec2(wp.dot(of_slope_x, camera.ahead), wp.dot(of_slope_y, camera.ahead))
    of_tangent = wp.cw_mul(camera.focal, slope.shift - wp.cw_mul(free, of_tangent) / z)
    of_z = total[3] - wp.dot(of_tangent, tangent) / z
    of_z -= (wp.dot(of_slope_x, slope_x) + wp.dot(of_slope_y, slope_y)) / z
    of_place = (of_tangent[0] / z) * camera.right + (of_tangent[1] / z) * camera.down
    slope.mean = of_place + of_z * camera.ahead
    result[number] = slope


@wp.func
def turned_back_slope(turn: wp.quat, vector: wp.vec3, factor: wp.vec3):
    """The slope of ``factor`` · (R⁻¹ ``vector``) in the unit quaternion of R, w first.

    R⁻¹ v = v − 2 w q × v + 2 q × (q × v), with the quaternion (w, q).
    """
    w = turn[3]
    q = wp.vec3(turn[0], turn[1], turn[2])
    turned = wp.cross(vector, factor)
    of_w = -2.0 * wp.dot(q, turned)
    of_q = -2.0 * w * turned
    of_q += 2.0 * (wp.dot(q, vector) * factor + wp.dot(q, factor) * vector)
    of_q -= 4.0 * wp.dot(factor, vector) * q
    return Vec4(of_w, of_q[0], of_q[1], of_q[2])
