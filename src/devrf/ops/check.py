"""Compares the Triton kernels with PyTorch on a device, on small random inputs.

``kernels=auto`` runs an operation in Triton only where its cases agree; tests compare the same
cases in Triton's interpreter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.ops.adam_step import AdamRule, adam_step, adam_steps, add_total_variation_gradient
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.corners import Triple
from devrf.ops.dispatch import using
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import photometric_sum
from devrf.ops.pixel_rays import gather_pixels, steps_in_box
from devrf.ops.search import PackedSamples, Thresholds, find_samples, select_listed
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

Results = tuple[Tensor, ...]


class Draw:
    """Random numbers on a device, from a separate generator: the run's is not advanced."""

    def __init__(self, device: torch.device, seed: int = 0) -> None:
        self.device = device
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, *shape: int) -> Tensor:
        """Uniform in [−1, 1]."""
        return (2 * torch.rand(shape, generator=self._generator) - 1).to(self.device)

    def leaf(self, *shape: int) -> Tensor:
        """The same, requiring gradients."""
        return self(*shape).requires_grad_()

    def gradients(self, results: Results, *leaves: Tensor) -> Results:
        """The results, and the gradients of the leaves where random gradients reach them."""
        differentiable = [result for result in results if result.requires_grad]
        upstream = [self(*result.shape) for result in differentiable]
        return *results, *torch.autograd.grad(differentiable, leaves, upstream)


class _Box(NamedTuple):
    low: Triple = (-1.0, -0.9, -0.8)
    high: Triple = (0.9, 1.0, 0.7)


BOX = _Box()
Case = Callable[[Draw], Results]


def check_kernels(device: torch.device) -> dict[str, str]:
    """Why Triton cannot be used on a device, by operation: its error, or how far it is off."""
    reasons = {}
    for operation, cases in CASES.items():
        try:
            errors = [error for case in cases if (error := compare(case, device))[1] > 1]
        except Exception as error:
            reasons[operation] = f"{type(error).__name__}: {error}".splitlines()[0]
        else:
            if errors:
                reasons[operation] = f"off by {errors[0][0]:.2g}"
    return reasons


def compare(case: Case, device: torch.device) -> tuple[float, float]:
    """The largest absolute error of a case in Triton; the largest, as a share of what is allowed.

    Allowed is 1e-4, absolute plus relative, for another order of summation and the hardware's
    exponential; 5e-4 where the case computes in half precision.

    Raises:
        Exception: whatever Triton raises where it cannot work.
    """
    results = []
    for kind in ("torch", "triton"):
        with using(kind), torch.inference_mode(False), torch.enable_grad():
            results.append([result.detach().double() for result in case(Draw(device))])
    tolerance = 5e-4 if case is half_color_network else 1e-4
    pairs = [(abs(computed - true), true.abs()) for true, computed in zip(*results, strict=True)]
    largest = max(error.max().item() for error, _ in pairs)
    shares = [(error / (tolerance * (1 + true))).max().item() for error, true in pairs]
    # Not a number is too far off.
    return largest, max(share if share == share else float("inf") for share in shares)


def interpolation(draw: Draw) -> Results:
    """Rows with and without vector loads; half of the points outside, in several blocks."""
    results: Results = ()
    for channels in (3, 12):
        grid, coords = draw.leaf(4, 3, 5, channels), (2 + 3 * draw(150, 3)).requires_grad_()
        results += draw.gradients((interpolate(grid, coords),), grid, coords)
    return results


def warped_depths(draw: Draw) -> Results:
    """At rest, at a frame, and between two."""
    results: Results = ()
    for frames in (0, 1, 2):
        density, slices = draw.leaf(4, 3, 5, 1), [draw.leaf(3, 4, 3, 3) for _ in range(frames)]
        moved = warped_depth(draw(150, 3), density, slices, 0.3, box=BOX, shift=-1.0, delta=0.5)
        results += draw.gradients(moved, density, *slices)
    return results


def pixels_and_steps(draw: Draw) -> Results:
    """Pixels of two images, with and without alpha and flow, and their rays through a box."""
    results: list[Tensor | None] = []
    for channels in (3, 4):
        drawn = (draw(40) > 0).long(), (9.99 + 9.99 * draw(40)).long()
        images = (127.5 + 127 * draw(2, 4, 5, channels)).to(torch.uint8)
        cameras = draw(2, 3, 4), 2 + draw(2, 2), draw(2, 2)
        behind = draw(40, 3) if channels == 4 else draw(3)
        flow = (draw(2, 4, 5, 2), draw(2, 4, 5) > 0) if channels == 4 else None
        frames = (draw(2) > 0).long()
        results += gather_pixels(*drawn, images, *cameras, behind, draw(2), frames, flow)
        results += steps_in_box(2 * draw(40, 3), draw(40, 3), box=BOX, step=0.07, near=0.1, far=2)
    return tuple(tensor for tensor in results if tensor is not None)


def visible_samples(draw: Draw) -> Results:
    """Rays through a box that is partly occupied, at rest, at a frame, and between two."""
    results: Results = ()
    for frames in (0, 1, 2):
        slices = [0.2 * draw(3, 4, 3, 3) for _ in range(frames)]
        directions = torch.nn.functional.normalize(draw(9, 3), dim=1)
        count = (20 * draw(9)).clamp(min=0).long() * 2
        along = 0.5 * draw(9, 3), directions, -1 + 0.1 * draw(9), count
        samples = find_samples(
            *(*along, draw(5, 4, 6) > -0.3, 3 * draw(4, 3, 5, 1)),
            slices,
            0.3,
            step=0.05,
            longest=40,
            capacity=40,
            mask_box=BOX,
            box=BOX,
            shift=-1.0,
            delta=0.5,
            thresholds=Thresholds(alpha=0.05, stop=0.05, weight=0.1),
        )
        listed = samples.ray, samples.distance, samples.points, samples.significant, samples.first
        results += *listed, samples.total
    return results


def selection(draw: Draw) -> Results:
    """Half of a list, with padding behind them."""
    first = torch.tensor([0, 0, 9, 9, 30]).to(draw.device)
    flags = (draw(40) > 0) & (torch.arange(40, device=draw.device) < 30)
    listed = (4 * draw(40).abs()).long(), draw(40), draw(40, 3), flags, first
    packed = PackedSamples(*listed, total=first[-1], steps=first.diff(), longest=40)
    canonical, weight = draw.leaf(40, 3), draw.leaf(40)
    return draw.gradients(select_listed(packed, canonical, weight, 30), canonical, weight)


def segments(draw: Draw) -> Results:
    """Weights and colours of rays of several lengths, one without samples, and of padding."""
    first = torch.tensor([0, 0, 3, 3, 43, 44, 77]).to(draw.device)
    depth, weights, colors, left = draw.leaf(85), draw.leaf(85), draw.leaf(85, 3), draw.leaf(6)
    results = draw.gradients(composite_segments(depth.abs(), first), depth)
    for background in (draw(3), draw(6, 3)):
        image = composite_colors(weights.abs(), colors, draw(85), first, left, background)
        results += draw.gradients(image, weights, colors, left)
    return results


def photometric_terms(draw: Draw) -> Results:
    """With and without an alpha mask."""
    results: Results = ()
    first = torch.tensor([0, 0, 3, 3, 43, 44, 77]).to(draw.device)
    for alpha in (None, draw(6).abs()):
        image, left, colors = draw.leaf(6, 3), draw.leaf(6), draw.leaf(85, 3)
        known = draw(85), colors, first, draw(6, 3), alpha, (1.0, 0.1, 0.01, 0.2)
        terms = photometric_sum(image, left, *known)
        sums = tuple(tensor for tensor in terms if tensor is not None)
        results += draw.gradients(sums, image, left, colors)
    return results


def color_network(draw: Draw) -> Results:
    """Colours of listed samples, in single precision."""
    return _colors(draw, 24, torch.tensor([1.0, 2.0]), torch.float32)


def half_color_network(draw: Draw) -> Results:
    """The same at the paper's width and octaves, in half precision.

    Of directions along the axes, scaled so that sines and cosines are −1, 0 and 1.
    """
    reduced = draw.device.type == "cuda" and torch.cuda.is_bf16_supported()
    octaves = torch.pi / 2 * 2 ** torch.arange(4)
    return _colors(draw, 128, octaves, torch.bfloat16 if reduced else torch.float16)


def _colors(draw: Draw, units: int, octaves: Tensor, precision: torch.dtype) -> Results:
    """Colours of samples with padding behind them, and all gradients.

    Features and weights are small integers and quarters, the second layer is sparse, so that half
    precision rounds none; gradients it rounds to three digits.
    """
    cells, low, high = torch.tensor([3, 2, 4]), torch.tensor(BOX.low), torch.tensor(BOX.high)
    middle = ((0.5 + 0.5 * draw(70, 3).cpu()) * (cells - 1e-3)).floor() + 0.5
    points = (low + middle / cells * (high - low)).to(draw.device).requires_grad_()
    directions = 3 + 6 * len(octaves)
    shapes = (units, 12), (units,), (units, directions), (units, units), (units,), (3, units), (3,)
    grid, *weights = (draw(*shape).sign() for shape in ((4, 3, 5, 12), *shapes))
    diagonal = torch.eye(units, device=draw.device)
    weights[3] *= diagonal + diagonal.roll(1, 0)
    weights[5] /= units
    learned = [tensor.requires_grad_() for tensor in (grid, *weights)]
    network = ColorNetwork(*[*weights, octaves.to(draw.device)])
    ray, first = (2.99 + 2.99 * draw(70)).long(), torch.linspace(0, 63, 7).long()
    listed = draw(6, 3).sign(), ray, first.to(draw.device), network, precision
    colors = listed_colors(grid, points, BOX, *listed)[:63]
    return draw.gradients((0.2 * colors,), points, *learned)


def motion_terms(draw: Draw) -> Results:
    """Samples of six rays, with padding: with and without flow, in world units and in NDC."""
    results: Results = ()
    for over_samples, ndc in ((None, None), (False, None), (True, (1.1, 1.3, 1.0))):
        # Cameras that look at the box from 4 units away, turned a little.
        poses = 0.1 * draw(2, 3, 4) + torch.eye(3, 4).to(draw.device)
        poses[:, 2, 3] += 4
        image = torch.tensor([0, 1, 1, 0, 1, 1]).to(draw.device)
        flow = 3 * draw(6, 2), draw(6) > -0.5, 8 + 8 * draw(6, 2), image, 1 - image[:2]
        earlier = SeenEarlier(*flow, poses, 20 + draw(2, 2), 8 + draw(2, 2))
        canonical, weight, forward = draw.leaf(90, 3), draw.leaf(90), draw.leaf(4, 3, 5, 3)
        ray, present = (2.99 + 2.99 * draw(90)).long(), torch.arange(90, device=draw.device) < 80
        samples = ListedSamples(draw(90, 3), canonical, weight, ray, present)
        known = samples, forward, draw(4, 3, 5, 3), None if over_samples is None else earlier
        sums = motion_sum(*known, (10.0, 0.5), box=BOX, over_samples=bool(over_samples), ndc=ndc)
        leaves = (canonical, forward) if over_samples is None else (canonical, forward, weight)
        results += draw.gradients(sums, *leaves)
    return results


def adam_and_variation(draw: Draw) -> Results:
    """Steps with and without the options; total variation everywhere and where touched."""
    results: list[Tensor] = []
    some = torch.tensor([0, 7, 8, 31, 59], dtype=torch.int32, device=draw.device)
    for skip_zero, rows in ((False, None), (True, None), (True, some)):
        grid, gradient = 2 * draw(4, 3, 5, 3), draw(4, 3, 5, 3).clamp(min=0)
        add_total_variation_gradient(grid, gradient, 0.3, along_z=0.5, touched_only=skip_zero)
        factors = draw(4, 3, 5, 1).abs() if skip_zero else None
        rate, step = draw(1)[0].abs(), 2 + draw(1)[0].abs()
        rule = AdamRule(rate, step, (0.9, 0.99), 1e-8, skip_zero, factors, rows)
        moments = draw(4, 3, 5, 3), draw(4, 3, 5, 3).square() + 0.1
        results.append(gradient.clone())
        adam_step(grid, gradient, *moments, rule)
        results += [grid, gradient, *moments]
    several = [[*(draw(size) for _ in range(3)), draw(size).square()] for size in (7, 1500)]
    rate, steps = draw(1)[0].abs(), [torch.full_like(draw(1)[0], k).double() for k in (1, 3)]
    adam_steps(several, [AdamRule(rate, step) for step in steps])
    return (*results, *(tensor for tensors in several for tensor in tensors))


CASES: dict[str, tuple[Case, ...]] = {
    "trilinear": (interpolation,),
    "warped_depth": (warped_depths,),
    "pixel_rays": (pixels_and_steps,),
    "search": (visible_samples,),
    "selection": (selection,),
    "compositing": (segments,),
    "photometric": (photometric_terms,),
    "color_network": (color_network, half_color_network),
    "motion": (motion_terms,),
    "adam": (adam_and_variation,),
}
