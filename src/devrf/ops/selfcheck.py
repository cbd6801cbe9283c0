"""Compares the Triton kernels with PyTorch on a device, on small random inputs.

The tests compare the same pairs in Triton's interpreter; this check covers the device, the driver
and the compiler of the machine that runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.ops.adam_step import AdamRule, adam_step, adam_steps, smooth_adam_step
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.compositing import composite_colors, composite_segments, sum_segments
from devrf.ops.corners import Triple
from devrf.ops.dispatch import Kind, using
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import photometric_sum
from devrf.ops.pixel_rays import gather_pixels, steps_in_box
from devrf.ops.search import Thresholds, find_samples
from devrf.ops.selection import select_listed
from devrf.ops.total_variation import add_total_variation_gradient
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

Results = tuple[Tensor, ...]
# Covers another order of summation, and the hardware's exponential.
TOLERANCE = 1e-4


class Draw:
    """Random numbers on a device, from a separate generator: the run's is not advanced."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._generator = torch.Generator().manual_seed(0)

    def __call__(self, *shape: int) -> Tensor:
        """Uniform in [−1, 1]."""
        return (2 * torch.rand(shape, generator=self._generator) - 1).to(self.device)

    def leaf(self, *shape: int) -> Tensor:
        """The same, requiring gradients."""
        return self(*shape).requires_grad_()


Case = Callable[[Draw], Results]


@dataclass(frozen=True)
class _Box:
    low: Triple = (-1.0, -0.9, -0.8)
    high: Triple = (0.9, 1.0, 0.7)


def check_kernels(device: torch.device) -> None:
    """Compare both implementations of every function, gradients included.

    Raises:
        DevrfError: they differ; the message names the function.
        Exception: whatever Triton raises where it cannot work.
    """
    for case in CASES:
        compared = compare(case, device)
        if not compared.agrees:
            raise DevrfError(f"{compared.name}: off by {compared.max_error:.2g}")


@dataclass(frozen=True)
class Comparison:
    """How far both implementations of a function are apart.

    Attributes:
        name: of the function, in words.
        agrees: whether every result is within ``TOLERANCE``, relative or absolute.
        max_error: the largest absolute difference; of the first result that does not agree, if
            there is one.
    """

    name: str
    agrees: bool
    max_error: float


def compare(case: Case, device: torch.device) -> Comparison:
    """Run one of ``CASES`` in both implementations.

    Raises:
        Exception: whatever Triton raises where it cannot work.
    """
    name, largest = case.__name__.replace("_", " "), 0.0
    pairs = zip(_run(case, "torch", device), _run(case, "triton", device), strict=True)
    for expected, found in pairs:
        error = (found - expected).abs().max().item()
        if not torch.allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE):
            return Comparison(name, False, error)
        largest = max(largest, error)
    return Comparison(name, True, largest)


def _run(case: Case, kind: Kind, device: torch.device) -> list[Tensor]:
    with using(kind), torch.inference_mode(False), torch.enable_grad():
        return [result.detach().float() for result in case(Draw(device))]


def interpolation(draw: Draw, channels: Sequence[int] = (3, 12)) -> Results:
    """Values and both gradients, for rows with and without vector loads."""
    results: list[Tensor] = []
    for width in channels:
        grid, coords = draw.leaf(4, 3, 5, width), (2 + 3 * draw(50, 3)).requires_grad_()
        values = interpolate(grid, coords)
        upstream = draw(50, width)
        results += [values, *torch.autograd.grad(values, (grid, coords), upstream)]
    return tuple(results)


def warped_depths(draw: Draw, frames: Sequence[int] = (1, 2)) -> Results:
    """At a frame, and between two."""
    results: list[Tensor] = []
    for count in frames:
        density, points = draw.leaf(4, 3, 5, 1), draw(50, 3)
        slices = [draw.leaf(3, 4, 3, 3) for _ in range(count)]
        q, tau = warped_depth(points, density, slices, 0.3, box=_Box(), shift=-1.0, delta=0.5)
        results += [q, tau]
        leaves = [density, *slices]
        up_q, up_tau = draw(50, 3), draw(50)
        loss = (q * up_q).sum() + (tau * up_tau).sum()
        results += torch.autograd.grad(loss, leaves)
    return tuple(results)


def pixel_rays(draw: Draw, channels: Sequence[int] = (3, 4)) -> Results:
    """Pixels of two images, with and without alpha and flow, and their rays through a box."""
    results: list[Tensor] = []
    for count in channels:
        image, flat = (draw(40) > 0).long(), (9.99 + 9.99 * draw(40)).long()
        shown = (127.5 + 127 * draw(2, 4, 5, count)).to(torch.uint8)
        flow = (draw(2, 4, 5, 2), draw(2, 4, 5) > 0) if count == 4 else None
        found = gather_pixels(
            image,
            flat,
            shown,
            draw(2, 3, 4),
            2 + draw(2, 2),
            draw(2, 2),
            draw(40, 3) if count == 4 else draw(3),
            draw(2),
            (draw(2) > 0).long(),
            flow,
        )
        results += [tensor for tensor in found if tensor is not None]
        rays = 2 * draw(40, 3), draw(40, 3)
        results += steps_in_box(*rays, box=_Box(), step=0.07, near=0.1, far=2.0)
    return tuple(results)


def sample_search(draw: Draw, frames: Sequence[int] = (1, 2)) -> Results:
    """Rays through a box that is partly occupied, at a frame, and between two."""
    results: list[Tensor] = []
    for moments in frames:
        origins, directions = 0.5 * draw(9, 3), torch.nn.functional.normalize(draw(9, 3), dim=1)
        count = (20 * draw(9)).clamp(min=0).long() * 2
        slices = [0.2 * draw(3, 4, 3, 3) for _ in range(moments)]
        found = find_samples(
            origins,
            directions,
            -1 + 0.1 * draw(9),
            count,
            draw(5, 4, 6) > -0.3,
            3 * draw(4, 3, 5, 1),
            slices,
            0.3,
            step=0.05,
            longest=40,
            capacity=40,
            mask_box=_Box(),
            box=_Box(),
            shift=-1.0,
            delta=0.5,
            thresholds=Thresholds(alpha=0.05, stop=0.05, weight=0.1),
        )
        results += [
            found.ray,
            found.distance,
            found.points,
            found.significant,
            found.first,
            found.total,
            found.overflow,
        ]
        leaves = draw.leaf(40, 3), draw.leaf(40)
        chosen = select_listed(found, *leaves, 12)
        loss = (chosen.canonical * draw(12, 3)).sum() + (chosen.weight * draw(12)).sum()
        results += [*chosen, *torch.autograd.grad(loss, leaves)]
    return tuple(results)


def compositing(draw: Draw) -> Results:
    """Rays of several lengths, one without samples, padding behind the last."""
    lengths = torch.tensor([0, 3, 0, 40, 1, 33]).to(draw.device)
    first = lengths.cumsum(0)
    depth, values = draw.leaf(85), draw.leaf(85, 3)
    weights, end = composite_segments(depth.abs(), first)
    sums = sum_segments(weights, values, first)
    loss = (weights * draw(85)).sum() + (end * draw(5)).sum() + (sums * draw(5, 3)).sum()
    return weights, end, sums, *torch.autograd.grad(loss, (depth, values))


def compositing_colors(draw: Draw) -> Results:
    """The same rays: their colours, depths, and photometric terms with and without alpha."""
    first = torch.tensor([0, 0, 3, 3, 43, 44, 77]).to(draw.device)
    results: list[Tensor] = []
    for alpha, background in ((None, draw(3)), (draw(6).abs(), draw(6, 3))):
        weights, colors, left = draw.leaf(85), draw.leaf(85, 3), draw.leaf(6)
        listed = weights.abs(), colors, draw(85)
        image, depth = composite_colors(*listed, first, left, background)
        found = photometric_sum(
            image, left, weights, colors, first, draw(6, 3), alpha, (1.0, 0.1, 0.01, 0.2)
        )
        results += [image, depth, *(tensor for tensor in found if tensor is not None)]
        results += torch.autograd.grad(3 * found.total, (weights, colors, left))
    return tuple(results)


def color_network(draw: Draw) -> Results:
    """Colours of listed samples; gradients of points, grid and network, or of points alone."""
    results: list[Tensor] = []
    for learned in (True, False):
        shapes = (24, 5), (24,), (24, 15), (24, 24), (24,), (3, 24), (3,)
        weights = [draw(*shape).requires_grad_(learned) for shape in shapes]
        network = ColorNetwork(*[*weights, torch.tensor([1.0, 2.0]).to(draw.device)])
        grid, points = draw(4, 3, 5, 5).requires_grad_(learned), draw.leaf(150, 3)
        results += _colors(draw, grid, points, draw(6, 3), network, draw(150, 3), torch.float32)
    return tuple(results)


def reduced_color_network(draw: Draw) -> Results:
    """The same at the paper's width in half precision, on numbers that it does not round.

    Features and weights are small integers and quarters, the second layer is sparse. Gradients are
    rounded, to three digits: they are small, so that the tolerance is a hundredth of them.
    """
    units, cells = 128, torch.tensor([3, 2, 4])
    low, high = torch.tensor(_Box.low), torch.tensor(_Box.high)
    middle = ((0.5 + 0.5 * draw(70, 3).cpu()) * (cells - 1e-3)).floor() + 0.5
    shapes = (units, 5), (units,), (units, 3), (units, units), (units,), (3, units), (3,)
    weights = [draw(*shape).sign() for shape in shapes]
    diagonal = torch.eye(units, device=draw.device)
    weights[3] *= diagonal + diagonal.roll(1, 0)
    weights[5] /= units
    network = ColorNetwork(*[*(weight.requires_grad_() for weight in weights), draw(0)])
    points = (low + middle / cells * (high - low)).to(draw.device).requires_grad_()
    bfloat16 = draw.device.type == "cuda" and torch.cuda.is_bf16_supported()
    return _colors(
        draw,
        draw(4, 3, 5, 5).sign().requires_grad_(),
        points,
        draw(6, 3).sign(),
        network,
        0.2 * draw(70, 3),
        torch.bfloat16 if bfloat16 else torch.float16,
    )


def _colors(
    draw: Draw,
    grid: Tensor,
    points: Tensor,
    directions: Tensor,
    network: ColorNetwork,
    upstream: Tensor,
    precision: torch.dtype,
) -> Results:
    """Colours of samples with padding behind them, and the gradients of what requires one."""
    places, used = len(points), int(0.9 * len(points))
    ray, first = (2.99 + 2.99 * draw(places)).long(), torch.linspace(0, used, 7).long()
    listed = grid, points, _Box(), directions, ray, first.to(draw.device), network, precision
    colors = listed_colors(*listed)[:used]
    leaves = [tensor for tensor in (grid, points, *network) if tensor.requires_grad]
    return colors, *torch.autograd.grad((colors * upstream[:used]).sum(), leaves)


def motion_terms(draw: Draw) -> Results:
    """Samples of six rays: with and without flow, in world units and in NDC, and padding."""
    results: list[Tensor] = []
    for over_samples, ndc in ((None, None), (False, None), (True, (1.1, 1.3, 1.0))):
        forward, before, seen = draw.leaf(4, 3, 5, 3), draw(4, 3, 5, 3), None
        if over_samples is not None:
            # Cameras that look at the box from 4 units away, turned a little.
            poses = 0.1 * draw(2, 3, 4) + torch.eye(3, 4).to(draw.device)
            poses[:, 2, 3] += 4
            image = torch.tensor([0, 1, 1, 0, 1, 1]).to(draw.device)
            seen = SeenEarlier(
                3 * draw(6, 2),
                draw(6) > -0.5,
                8 + 8 * draw(6, 2),
                image,
                1 - image[:2],
                poses,
                20 + draw(2, 2),
                8 + draw(2, 2),
            )
        samples = ListedSamples(
            draw(150, 3),
            draw.leaf(150, 3),
            draw.leaf(150),
            (2.99 + 2.99 * draw(150)).long(),
            torch.arange(150, device=draw.device) < 140,
        )
        found = motion_sum(
            samples,
            forward,
            before,
            seen,
            (10.0, 0.5),
            box=_Box(),
            over_samples=bool(over_samples),
            ndc=ndc,
        )
        leaves = samples.canonical, samples.weight, forward
        gradients = torch.autograd.grad(
            3 * found.total, leaves, allow_unused=True, materialize_grads=True
        )
        results += [*found, *gradients]
    return tuple(results)


def total_variation(draw: Draw) -> Results:
    """The gradient added to entries that have one, and to all."""
    grid, gradient = 2 * draw(4, 3, 5, 3), draw(4, 3, 5, 3).clamp(min=0)
    add_total_variation_gradient(grid, gradient, 0.3, touched_only=True)
    before = gradient.clone()
    add_total_variation_gradient(grid, gradient, 0.3)
    return before, gradient


def adam(draw: Draw) -> Results:
    """Steps with and without the optional settings."""
    results: list[Tensor] = []
    for skip_zero in (False, True):
        factors = draw(4, 3, 5, 1).abs()
        rule = AdamRule(
            draw(1)[0].abs(),
            torch.full_like(factors[0, 0, 0, 0], 3.0),
            skip_zero=skip_zero,
            per_voxel_lr=factors if skip_zero else None,
        )
        values, gradient, mean = draw(4, 3, 5, 3), draw(4, 3, 5, 3).clamp(min=0), draw(4, 3, 5, 3)
        square, smooth = draw(4, 3, 5, 3).square() + 0.1, torch.zeros_like(values)
        again = gradient.clone()
        adam_step(values, gradient, mean, square, rule)
        smooth_adam_step(values, smooth, again, mean, square, rule, smoothing=0.3)
        results += [values, smooth, gradient, again, mean, square]
    several = [[*(draw(size) for _ in range(3)), draw(size).square()] for size in (7, 1500)]
    rate, steps = draw(1)[0].abs(), [torch.full_like(draw(1)[0], k).double() for k in (1, 3)]
    adam_steps(several, [AdamRule(rate, step) for step in steps])
    return (*results, *(tensor for four in several for tensor in four))


CASES: tuple[Case, ...] = (
    interpolation,
    warped_depths,
    pixel_rays,
    sample_search,
    compositing,
    compositing_colors,
    color_network,
    reduced_color_network,
    motion_terms,
    total_variation,
    adam,
)
