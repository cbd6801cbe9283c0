"""Points that are followed through time by a learned scene's field."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from devrf.ops.splatting import rotations
from devrf.rendering.renderable import Renderable

# Steps by which a map back to the canonical state is inverted.
STEPS = 30
# Points whose nearest Gaussians are found at once.
CHUNK = 1024


@torch.no_grad()
def track(model: Renderable, points: Tensor, time: float, times: Sequence[float]) -> Tensor | None:
    """Where ``points`` (M, 3) at ``time`` are at T ``times``: (T, M, 3), all in world units.

    They go to the canonical state and from there by the method's maps (``canonical_map``,
    ``forward_map``). A method that only knows the way back is asked which point comes from there:
    by a fixed point, from the place at the time before. In a scene of Gaussians a point goes with
    the nearest one. None: the method has none of these.
    """
    nearest = _with_gaussians(model, points, time, times)
    to_canonical = model.canonical_map(time)
    if nearest is not None or to_canonical is None:
        return nearest
    start = model.space.from_world(points)
    canonical = to_canonical(start)
    places: dict[float, Tensor] = {}
    ordered = sorted({*times})
    for way in ([t for t in ordered if t >= time], [t for t in ordered[::-1] if t < time]):
        place = start
        for moment in way:
            forward = model.forward_map(moment)
            if forward is not None:
                place = forward(canonical)
            else:
                back = model.canonical_map(moment)
                assert back is not None
                place = _inverse(back, canonical, place)
            places[moment] = place
    return torch.stack([model.space.to_world(places[moment]) for moment in times])


def _inverse(back: Callable[[Tensor], Tensor], canonical: Tensor, start: Tensor) -> Tensor:
    """Points (M, 3) near ``start`` (M, 3) that ``back`` leads nearest to ``canonical`` (M, 3)."""
    best = place = start
    least = torch.full_like(start[:, 0], torch.inf)
    for _ in range(STEPS):
        miss = canonical - back(place)
        error = miss.norm(dim=1)
        best = torch.where((error < least)[:, None], place, best)
        least = torch.minimum(least, error)
        place = place + miss
    return best


def _with_gaussians(
    model: Renderable, points: Tensor, time: float, times: Sequence[float]
) -> Tensor | None:
    """As :func:`track`, each point at its place in the axes of the Gaussian nearest to it."""
    now = model.gaussians_at(time)
    if now is None:
        return None
    parts = torch.split(points, CHUNK)
    nearest = torch.cat([torch.cdist(part, now.means).argmin(dim=1) for part in parts])
    axes = rotations(now.quaternions[nearest])
    local = ((points - now.means[nearest])[:, None] @ axes)[:, 0]
    places = []
    for moment in times:
        then = model.gaussians_at(moment)
        assert then is not None
        turned = (rotations(then.quaternions[nearest]) @ local[..., None])[..., 0]
        places.append(then.means[nearest] + turned)
    return torch.stack(places)
