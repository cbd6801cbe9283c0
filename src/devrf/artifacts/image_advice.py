"""What is wrong with images, their times and their optical flow."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from devrf.artifacts.advice import Advice, listed
from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Scene, Views

# An image whose values all lie within this of one another, of 255, shows nothing.
FLAT = 2
# A pixel is matte from here on, of 255.
MATTE = 127
# Share of the pixels (on the matte, where there is one) that the flow should cover at least.
LEAST_FLOW = 0.02
# Share of the pixels that masks rarely leave out if they are of passers-by.
MUCH_LEFT_OUT = 0.5


def image_advice(scene: Scene) -> list[Advice]:
    """Everything that images, mattes, times and flow tell."""
    return [
        *_blank(scene),
        *_turned(scene),
        *_mattes(scene),
        *_masks(scene),
        *_times(scene),
        *_flow(scene.dynamic.train),
    ]


def mean_share(masks: Iterable[Tensor]) -> float:
    """Mean of masks (H, W), one by one: a large scene's at once would be copied."""
    shares = [float(mask.float().mean()) for mask in masks]
    return sum(shares) / len(shares)


def _everyone(scene: Scene) -> list[tuple[str, Views]]:
    return [
        ("static training set", scene.static.train),
        ("static test set", scene.static.test),
        ("dynamic training set", scene.dynamic.train),
        ("dynamic test set", scene.dynamic.test),
    ]


def _blank(scene: Scene) -> list[Advice]:
    flat, empty = [], []
    for _, views in _everyone(scene):
        for k, (image, name) in enumerate(zip(views.pixels, views.names, strict=True)):
            if views.valid_mask is not None:
                image = image[views.valid_mask[k]]
            shown = image[..., :3].reshape(-1, 3)
            if views.has_alpha:
                shown = shown[image[..., 3].reshape(-1) > MATTE]
                if len(shown) == 0:
                    empty.append(name)
                    continue
            low, high = shown.amin(dim=0).int(), shown.amax(dim=0).int()
            # A matte may well cut out something of one colour; its outline still tells.
            if not views.has_alpha and int((high - low).max()) <= FLAT:
                flat.append(name)
    found = []
    if flat:
        found.append(
            Advice(
                listed(flat),
                "one colour all over",
                "look at the file, and leave it out if it is lost",
            )
        )
    if empty:
        found.append(
            Advice(
                listed(empty),
                "its matte is empty: it shows background only",
                "look at the alpha channel, or leave the image out",
            )
        )
    return found


def _turned(scene: Scene) -> list[Advice]:
    names = [
        views.names[k]
        for _, views in _everyone(scene)
        if views.ambiguous_orientation is not None
        for k in views.ambiguous_orientation.nonzero()[:, 0].tolist()
    ]
    if not names:
        return []
    return [
        Advice(
            # Without a static set the captures share files.
            listed(list(dict.fromkeys(names))),
            "its EXIF orientation says that it is to be seen turned; it is read as it is stored, "
            "since "
            "its camera does not tell",
            "if the cameras were found on turned images, turn the files too "
            "(mogrify -auto-orient); "
            "else take the orientation out (exiftool -Orientation=)",
        )
    ]


def _mattes(scene: Scene) -> list[Advice]:
    found = []
    with_alpha = {name: views.has_alpha for name, views in _everyone(scene) if len(views)}
    if len(set(with_alpha.values())) == 2:
        without = [name for name, alpha in with_alpha.items() if not alpha]
        found.append(
            Advice(
                listed(without, 4),
                "without mattes, while the other images have them",
                "give mattes to all images or to none: "
                "else the background is learned from some only",
            )
        )
    for name, views in _everyone(scene):
        if len(views) and views.has_alpha and int(views.pixels[..., 3].amin()) > MATTE:
            found.append(
                Advice(
                    name,
                    "has an alpha channel that is opaque everywhere, which tells nothing",
                    "give real mattes, or write the images without alpha",
                )
            )
    return found


def _masks(scene: Scene) -> list[Advice]:
    much = {}
    for name, views in _everyone(scene):
        if views.valid_mask is not None:
            left_out = mean_share(~one for one in views.valid_mask)
            if left_out > MUCH_LEFT_OUT:
                much[name] = left_out
    if not much:
        return []
    return [
        Advice(
            listed(list(much), 4),
            f"masks leave out up to {100 * max(much.values()):.0f} % of the "
            "pixels, of which nothing is learned",
            "if they cut out the subject, set data.masks=matte: "
            "what they leave out is background then",
        )
    ]


def _times(scene: Scene) -> list[Advice]:
    views, found = scene.dynamic.train, []
    first = float(views.times.min())
    if first > FrameClock.TOLERANCE:
        found.append(
            Advice(
                "dynamic training set",
                f"begins at time {first:g}; the rest state at time 0 is taken "
                "from the static set alone",
                "let the first frame show the rest state, at time 0",
            )
        )
    clock = scene.clock
    frames = clock.frames_of(views.times)
    numbers = set(views.view.tolist())
    if len(numbers) == len(views):
        return found  # a moving camera: each image is a view of its own
    fewer = []
    for frame in sorted(set(frames.tolist())):
        missing = numbers - set(views.view[frames == frame].tolist())
        if missing:
            words = ", ".join(str(k) for k in sorted(missing))
            fewer.append(f"time {clock.times[frame]:.3g} without view {words}")
    if fewer:
        found.append(
            Advice(
                "dynamic training set",
                f"not all views at every time: {listed(fewer)}",
                "add the images, or leave these times or views out: motion is less certain there",
            )
        )
    return found


def _flow(views: Views) -> list[Advice]:
    flow = views.flow
    if flow is None:
        return []
    later = [image for image, _ in frame_pairs(views)]
    longest = max(views.width, views.height)
    long, broken, covered = [], [], []
    for k in later:
        vectors, valid = flow.vectors[k], flow.valid[k]
        on = views.pixels[k, ..., 3] > MATTE if views.has_alpha else torch.ones_like(valid)
        covered.append(float((valid & on).sum()) / max(int(on.sum()), 1))
        length = vectors[valid].norm(dim=-1)
        if not bool(torch.isfinite(length).all()):
            broken.append(views.names[k])
        elif len(length) and float(length.max()) > longest:
            long.append(views.names[k])
    found = []
    if long:
        found.append(
            Advice(
                f"flow of {listed(long)}",
                f"longer than the image ({longest} px)",
                "flow is in pixels, x then y, from the frame to the one before it; check its unit, "
                "or set data.flow=dis or data.flow=none",
            )
        )
    if broken:
        found.append(
            Advice(
                f"flow of {listed(broken)}",
                "valid where it is not a number",
                "mask these pixels, or set data.flow=none",
            )
        )
    if covered and sum(covered) / len(covered) < LEAST_FLOW:
        where = "the mattes" if views.has_alpha else "the pixels"
        share = 100 * sum(covered) / len(covered)
        found.append(
            Advice(
                "optical flow",
                f"valid on {share:.1f} % of {where}",
                "check its masks, or set data.flow=dis to estimate it",
            )
        )
    return found
