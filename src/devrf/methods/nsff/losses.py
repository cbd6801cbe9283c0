"""NSFF's loss terms, unweighted (docs/methods/nsff.md#losses)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import torch
from torch import Tensor

from devrf.methods.nsff.fields import BACKWARD, FORWARD
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.renders import Renders
from devrf.ops.compositing import sum_by_ray

# Shares of the nearest depths whose flow is held smooth in space, and in time.
SPACE_SHARE = 0.95
TIME_SHARE = 0.9
EPS = 1e-6


def photometric(color: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Mean squared error () over rays and channels, rays weighted by ``weight`` (R,)."""
    error = (color - truth).square().mean(dim=1)
    return (weight * error).sum() / weight.sum().clamp(min=EPS)


def render(r: Renders) -> Tensor:
    """‖C − C_gt‖² of the blended render."""
    return photometric(r.output.color, r.batch.color, torch.ones_like(r.batch.time))


def dynamic(r: Renders) -> Tensor:
    """‖C_d − C_gt‖²; rays weighted by sg(Σ w_d) after N₀."""
    return photometric(r.alone[0], r.batch.color, r.dynamic_share)


def neighbours(r: Renders) -> Tensor:
    """Σ_j ‖C_{j→i} − C_gt‖², rays weighted by Ŵ_{j→i}, and by sg(Σ w_d) after N₀."""
    terms = [photometric(w.color, r.batch.color, r.trust(w) * r.dynamic_share) for w in r.warps]
    return torch.stack(terms).sum()


def chained(r: Renders) -> Tensor:
    """‖C_{k→i} − C_gt‖² of the frame k two steps away, rays weighted by sg(Σ w_d)."""
    if not r.chains:
        return r.output.color.new_zeros(())
    warp = r.chained()
    return photometric(warp.color, r.batch.color, warp.exists * r.dynamic_share)


def cycle(r: Renders) -> Tensor:
    """‖f_{i→j}(x) + f_{j→i}(x + f_{i→j})‖₁, samples weighted by W = 1 − o_{i→j}."""
    terms = []
    for warp in r.warps:
        sample = torch.arange(len(warp.sample), device=warp.sample.device)
        back = warp.dynamic.flow[sample, 1 - warp.side[warp.ray]]
        trust = torch.ones_like(warp.occlusion) if r.fields.additive else 1 - warp.occlusion
        miss = (warp.moved + back).abs().mean(dim=1)
        terms.append((trust * miss).sum() / trust.sum().clamp(min=EPS))
    return torch.stack(terms).sum()


def small_flow(r: Renders) -> Tensor:
    """‖Σ w f‖₁ of the rendered flow, there and back: the mean over rays, the sum over x, y, z."""
    weight = r.seen[1][:, None, None]
    ray = r.output.samples.ray
    rendered = sum_by_ray(weight * r.output.dynamic.flow, ray, r.rays)
    return rendered.abs().mean(dim=0).sum()


def smooth_space(r: Renders) -> Tensor:
    """‖Δ_k (X' − X)‖₁ between neighbours on a ray, X' = X + flow in Euclidean space."""
    out = r.output
    start = r.placement.euclidean(out.samples.points)
    near = r.placement.within(out.samples.points, SPACE_SHARE)
    ray = out.samples.ray
    pair = ((ray[1:] == ray[:-1]) & near[1:] & near[:-1])[:, None]
    terms = []
    for side in (FORWARD, BACKWARD):
        moved = r.placement.euclidean(out.samples.points + out.dynamic.flow[:, side]) - start
        terms.append(_mean((moved[1:] - moved[:-1]).abs(), pair))
    return torch.stack(terms).sum()


def smooth_time(r: Renders) -> Tensor:
    """½‖X⁺ + X⁻ − 2X‖², twice around a ray's own points, once around those of a neighbouring frame.

    The flow that led to the neighbour is chained there with the one that leads on from it.
    """
    own = r.output.samples.points
    near = r.near
    after = own + r.output.dynamic.flow[:, FORWARD]
    before = own + r.output.dynamic.flow[:, BACKWARD]
    moved = torch.arange(len(near.sample), device=own.device)
    onward = near.points + near.dynamic.flow[moved, near.side[near.ray]]
    start = own[near.sample]
    bending = _bending(r, own, after=after, middle=own, before=before)
    chained_bending = _bending(r, start, after=onward, middle=near.points, before=start)
    return 2 * bending + chained_bending


def _bending(r: Renders, start: Tensor, *, after: Tensor, middle: Tensor, before: Tensor) -> Tensor:
    """½‖X⁺ + X⁻ − 2X‖² () of paths (S, 3) ``after``, ``middle``, ``before``.

    Only samples whose ``start`` (S, 3) is near count.
    """
    euclidean = r.placement.euclidean
    bend = 0.5 * (euclidean(after) + euclidean(before) - 2 * euclidean(middle)).square()
    return _mean(bend, r.placement.within(start, TIME_SHARE)[:, None])


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean () of values (S, 3) where ``mask`` (S, 1) holds; 0 where it holds nowhere."""
    total = torch.where(mask, values, torch.zeros_like(values)).sum()
    return total / (values.shape[1] * mask.sum()).clamp(min=1)


def depth(r: Renders) -> Tensor:
    """Mean squared difference of rendered and known depth, each normalised over the batch."""
    assert r.priors is not None
    truth = r.priors.distance(r.batch)
    finite = truth.isfinite().nonzero()[:, 0]
    if len(finite) < 2:
        return r.output.color.new_zeros(())
    samples = r.output.samples
    weight = r.seen[0]
    mass = sum_by_ray(weight, samples.ray, r.rays).clamp(min=1e-3)
    rendered = sum_by_ray(weight * samples.distance, samples.ray, r.rays) / mass
    difference = normalised(rendered[finite]) - normalised(truth[finite])
    return r.prior_factor * difference.square().mean()


def normalised(depth: Tensor) -> Tensor:
    """Depths (R,) minus their median, over their mean absolute deviation from it."""
    away = depth - depth.median()
    return away / away.abs().mean().clamp(min=1e-3)


def flow(r: Renders) -> Tensor:
    """‖proj_j(Σ w (x + f_{i→j})) − (p + flow)‖₁ in pixels, where flow is known."""
    assert r.priors is not None
    out = r.output
    ray = r.output.samples.ray
    weight, moving = r.seen
    terms = []
    for side in (FORWARD, BACKWARD):
        observed, valid = r.priors.flow(r.batch, side)
        moved = weight[:, None] * out.samples.points + moving[:, None] * out.dynamic.flow[:, side]
        mass = sum_by_ray(weight, ray, r.rays)
        mean = sum_by_ray(moved, ray, r.rays) / mass.clamp(min=1e-3)[:, None]
        camera = r.priors.neighbour[r.batch.image, side]
        pixel, ahead = r.priors.cameras.project(camera, r.placement.world(mean))
        counts = (valid & (ahead > 0) & (mass > 1e-3))[:, None]
        miss = torch.where(counts, pixel - (r.batch.pixel + observed), 0.0)
        terms.append(miss.abs().sum() / (2 * counts.sum()).clamp(min=1))
    return r.prior_factor * torch.stack(terms).sum()


def disocclusion(r: Renders) -> Tensor:
    """Mean o⁺ + mean o⁻."""
    return r.output.dynamic.occlusion.mean(dim=0).sum()


def blend_entropy(r: Renders) -> Tensor:
    """−v log v; where densities add, of the share w_d / (w_d + w_s)."""
    out = r.output
    share = out.static.blend
    if r.fields.additive:
        share = out.blend.dynamic / (out.blend.dynamic + out.blend.static).clamp(min=1e-10)
    return -(share * share.clamp(min=1e-10).log()).mean()


TERMS: Mapping[str, Callable[[Renders], Tensor]] = {
    "render": render,
    "dynamic": dynamic,
    "neighbours": neighbours,
    "chained": chained,
    "cycle": cycle,
    "small_flow": small_flow,
    "smooth_space": smooth_space,
    "smooth_time": smooth_time,
    "depth": depth,
    "flow": flow,
    "disocclusion": disocclusion,
    "blend_entropy": blend_entropy,
}
# Terms that do not exist if densities add.
OF_A_SHARE = ("dynamic", "disocclusion")


def missing_terms(priors: ImagePriors, terms: Collection[str], *, additive: bool) -> dict[str, str]:
    """Those of the ``terms`` whose data are missing, and why.

    Args:
        priors: of the images that are learned from.
        terms: names of the terms that count.
        additive: whether densities add.
    """
    reasons = {}
    if not any(priors.has_flow):
        reasons["flow"] = "no optical flow"
    if not priors.has_depth:
        reasons["depth"] = "no depth"
    if additive:
        reasons |= dict.fromkeys(OF_A_SHARE, "no blend v")
    return {name: why for name, why in reasons.items() if name in terms}
