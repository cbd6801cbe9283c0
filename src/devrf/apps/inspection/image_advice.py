"""Problems with images, their masks, their times and their optical flow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from devrf.apps.inspection.advice import Advice, image_sets, images_where, listed
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views

# An image whose values all lie within this of one another, of 255, shows nothing.
FLAT = 2
# A pixel is in the alpha mask above this, of 255.
OPAQUE = 127
# Share of the pixels (in the alpha mask, where there is one) that the flow should cover at least.
LEAST_FLOW = 0.02
# Masks of passers-by rarely leave out more than this share of the pixels.
MUCH_MASKED = 0.5


def image_advice(scene: Scene) -> list[Advice]:
    """Problems that images, masks, times and flow show."""
    return [
        *_blank(scene),
        *_turned(scene),
        *_alpha(scene),
        *_masks(scene),
        *_times(scene),
        *_flow(scene.dynamic.train),
    ]


def mean_share(masks: Iterable[Tensor]) -> float:
    """Mean of masks (H, W), one by one: a large scene's at once would be copied."""
    shares = [float(mask.float().mean()) for mask in masks]
    return sum(shares) / len(shares)


def _blank(scene: Scene) -> Iterator[Advice]:
    if flat := images_where(scene, _is_flat):
        remedy = "look at the file, and leave it out if it is lost"
        yield Advice(listed(flat), "one colour all over", remedy)
    if empty := images_where(scene, _is_empty):
        what = "its alpha mask is empty: it shows background only"
        yield Advice(listed(empty), what, "look at the alpha channel, or leave the image out")


def _valid_pixels(views: Views, k: int) -> Tensor:
    """(M, 3 or 4) uint8."""
    pixels = views.pixels[k]
    return pixels.flatten(0, 1) if views.valid_mask is None else pixels[views.valid_mask[k]]


def _is_flat(views: Views, k: int) -> bool:
    # With alpha a subject of one colour still has an outline.
    if views.has_alpha:
        return False
    low, high = _valid_pixels(views, k).int().aminmax(dim=0)
    return int((high - low).max()) <= FLAT


def _is_empty(views: Views, k: int) -> bool:
    return views.has_alpha and int(_valid_pixels(views, k)[:, 3].max()) <= OPAQUE


def _is_ambiguous(views: Views, k: int) -> bool:
    return views.ambiguous_orientation is not None and bool(views.ambiguous_orientation[k])


def _turned(scene: Scene) -> Iterator[Advice]:
    if names := images_where(scene, _is_ambiguous):
        yield Advice(
            listed(names),
            "its EXIF orientation says that it is to be seen turned; it is read as it is stored, "
            "since its camera does not tell",
            "if the cameras were found on turned images, turn the files too "
            "(mogrify -auto-orient); else take the orientation out (exiftool -Orientation=)",
        )


def _alpha(scene: Scene) -> Iterator[Advice]:
    sets = image_sets(scene)
    without = [name for name, views in sets.items() if not views.has_alpha]
    if 0 < len(without) < len(sets):
        yield Advice(
            listed(without, 4),
            "without alpha masks, while the other images have them",
            "give alpha to all images or to none: else the background is learned from some only",
        )
    for name, views in sets.items():
        if views.has_alpha and int(views.pixels[..., 3].amin()) > OPAQUE:
            yield Advice(
                name,
                "has an alpha channel that is opaque everywhere, which tells nothing",
                "give real alpha masks, or write the images without alpha",
            )


def _masks(scene: Scene) -> Iterator[Advice]:
    masked = {
        name: mean_share(~mask for mask in views.valid_mask)
        for name, views in image_sets(scene).items()
        if views.valid_mask is not None
    }
    much = {name: share for name, share in masked.items() if share > MUCH_MASKED}
    if much:
        yield Advice(
            listed(list(much), 4),
            f"masks leave out up to {100 * max(much.values()):.0f} % of the pixels, of which "
            "nothing is learned",
            "if they cut out the subject, set data.masks=matte: "
            "what they leave out is background then",
        )


def _times(scene: Scene) -> Iterator[Advice]:
    if not scene.moves:
        return
    views, clock = scene.dynamic.train, scene.clock
    first = float(views.times.min())
    if first > FrameClock.TOLERANCE:
        yield Advice(
            "dynamic training set",
            f"begins at time {first:g}; the rest state at time 0 is taken from the static set "
            "alone",
            "let the first frame show the rest state, at time 0",
        )
    numbers = set(views.view.tolist())
    if len(numbers) == len(views):
        return  # a moving camera: each image is a view of its own
    frames = clock.frames_of(views.times)
    fewer = []
    for frame in sorted(set(frames.tolist())):
        missing = sorted(numbers - set(views.view[frames == frame].tolist()))
        if missing:
            without = ", ".join(map(str, missing))
            fewer.append(f"time {clock.times[frame]:.3g} without view {without}")
    if fewer:
        yield Advice(
            "dynamic training set",
            f"not all views at every time: {listed(fewer)}",
            "add the images, or leave these times or views out: motion is less certain there",
        )


def _flow(views: Views) -> Iterator[Advice]:
    flow = views.flow
    if flow is None:
        return
    longest = max(views.width, views.height)
    long, broken, covered = [], [], []
    for k, _ in frame_pairs(views):
        vectors, valid = flow.vectors[k], flow.valid[k]
        inside = views.pixels[k, ..., 3] > OPAQUE if views.has_alpha else torch.ones_like(valid)
        covered.append(float((valid & inside).sum()) / max(int(inside.sum()), 1))
        length = vectors[valid].norm(dim=-1)
        if not bool(torch.isfinite(length).all()):
            broken.append(views.names[k])
        elif len(length) and float(length.max()) > longest:
            long.append(views.names[k])
    if long:
        yield Advice(
            f"flow of {listed(long)}",
            f"longer than the image ({longest} px)",
            "flow is in pixels, x then y, from the frame to the one before it; check its unit, "
            "or set data.flow=dis or data.flow=none",
        )
    if broken:
        what, remedy = "valid where it is not a number", "mask these pixels, or set data.flow=none"
        yield Advice(f"flow of {listed(broken)}", what, remedy)
    share = sum(covered) / max(len(covered), 1)
    if covered and share < LEAST_FLOW:
        where = "the alpha masks" if views.has_alpha else "the pixels"
        yield Advice(
            "optical flow",
            f"valid on {100 * share:.1f} % of {where}",
            "check its masks, or set data.flow=dis to estimate it",
        )
