"""Problems that lower quality, found in cameras, images, masks, times and optical flow."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.apps.inspection.layout import box_points, widest_gap
from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.pictures.images import evenly
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.optical_flow import estimator, flow_between, frame_pairs
from devrf.scenes.scene import Scene, Views
from devrf.scenes.space import earliest
from devrf.scenes.splits import distinct_poses, standing

# Largest gap between neighbouring static views, as seen from the box's middle, in degrees.
WIDEST_GAP = 120.0
# An image whose values all lie within this of one another, of 255, shows nothing.
FLAT = 2
# A pixel is in the alpha mask above this, of 255.
OPAQUE = 127
# Share of the pixels (in the alpha mask, where there is one) that the flow should cover at least.
MIN_FLOW = 0.02
# Motion from a frame to the next, as a share of the image's longer side, that a frame's learning
# may not follow without optical flow.
FAR = 0.05
# Of a forward-facing scene, a fixed camera looks at what is so many near planes before it.
AHEAD = 2.0
# Pairs of frames in which motion is looked for.
SAMPLED_PAIRS = 6
# Masks of passers-by rarely leave out more than this share of the pixels.
MUCH_MASKED = 0.5


class Advice(NamedTuple):
    """A problem that lowers quality: a file, view or part of the scene, and a remedy."""

    where: str
    problem: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}; {self.remedy}"


def advice_on(scene: Scene) -> list[Advice]:
    """Problems that cameras, images, masks, times and flow show."""
    checks = (
        _held_out,
        _box_unknown,
        _one_side,
        _elsewhere,
        _images,
        _alpha,
        _masks,
        _times,
        _flow,
    )
    return [advice for check in checks for advice in check(scene)]


def image_sets(scene: Scene) -> dict[str, Views]:
    """The sets of images by the names that a report gives them; empty ones are left out."""
    return {
        f"{name} {kind} set": views
        for name, capture in scene.captures.items()
        for kind, views in (("training", capture.train), ("test", capture.test))
        if len(views)
    }


def listed(names: Sequence[str], max_names: int = 3) -> str:
    """The first ``max_names`` names, and the number of the others."""
    more = len(names) - max_names
    return ", ".join(names[:max_names]) + (f" and {more} more" if more > 0 else "")


def _held_out(scene: Scene) -> Iterator[Advice]:
    for name, capture in scene.captures.items():
        if len(capture.test) == 0:
            yield Advice(
                f"{name} test set",
                "holds no view, so nothing can be scored",
                "hold out some images of the capture",
            )
        elif twins := _twins(capture.test, capture.train):
            yield Advice(
                f"{name} test set",
                f"{listed(twins)}: the same camera and time as a training view, so the score "
                "measures memory of that view",
                "hold out other views",
            )


def _twins(test: Views, train: Views) -> list[str]:
    """Names of the test views that have the camera and the time of a training view."""
    poses = [views.cameras.camera_to_world for views in (train, test)]
    times = torch.cat([train.times, test.times])
    frames = FrameClock.from_times(times).frames_of(times)
    shots = [*zip(distinct_poses(torch.cat(poses)).tolist(), frames.tolist(), strict=True)]
    learned = {*shots[: len(train)]}
    of_test = zip(test.names, shots[len(train) :], strict=True)
    return [name for name, shot in of_test if shot in learned]


def _box_unknown(scene: Scene) -> Iterator[Advice]:
    views = scene.static.train
    box = scene.bounds.box
    if scene.kind != "inward" or not scene.space.is_linear or views.has_alpha:
        return
    try:
        guessed = box_from_cameras(views.cameras)
    except DevrfError:
        return  # the cameras tell no box: it was given
    corners = torch.tensor([*box.low, *box.high])
    guessed_corners = torch.tensor([*guessed.low, *guessed.high])
    if float((corners - guessed_corners).abs().max()) <= 1e-4 * guessed.longest:
        yield Advice(
            "static training set",
            "has no alpha masks, and the box is only what the cameras all see",
            "set data.box=[[x,y,z],[x,y,z]] around the object, or give the images alpha (RGBA)",
        )


def _one_side(scene: Scene) -> Iterator[Advice]:
    gap = widest_gap(scene)
    if gap is not None and gap > WIDEST_GAP:
        yield Advice(
            "static training set",
            f"no view from a sector of {gap:.0f} degrees, seen from above",
            "expect fog on that side, or add views there "
            "(data=forward is for scenes from one side)",
        )


def _elsewhere(scene: Scene) -> Iterator[Advice]:
    """Fixed cameras that face another place than the static ones: their files' worlds differ."""
    if not isinstance(scene.space, NormalizedDevice) or not scene.moves or scene.is_monocular:
        return
    static = scene.static.train.cameras
    images = torch.arange(len(static))
    names = []
    for views in map(earliest, (scene.dynamic.train, scene.dynamic.test)):
        poses = views.cameras.camera_to_world
        ahead = poses[:, :, 3] - AHEAD * scene.space.near * poses[:, :, 2]
        for name, point in zip(views.names, ahead, strict=True):
            pixels, depth = static.project(images, point.expand(len(static), 3))
            if not bool(_shown(pixels, depth, static.extents).any()):
                names.append(name)
    if names:
        yield Advice(
            listed(names),
            "looks at a place that is in no static image, as if its camera were of another world",
            "give both captures' cameras in one world and unit (docs/data.md, data=forward: Axes)",
        )


def _shown(pixels: Tensor, depth: Tensor, size: Tensor) -> Tensor:
    """(...): whether points at ``pixels`` (..., 2) and ``depth`` are in images of ``size``."""
    return (depth > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=-1)


def mean_share(masks: Iterable[Tensor]) -> float:
    """Mean of masks (H, W), read one by one: those of a large scene at once would be copied."""
    shares = [float(mask.float().mean()) for mask in masks]
    return sum(shares) / len(shares)


def masked_share(views: Views) -> float | None:
    """The share of the images' pixels that masks leave out; None without masks."""
    if views.valid_mask is None:
        return None
    masks = [image.valid_mask for image in views.singles()]
    if all(mask is None for mask in masks):
        return None
    return mean_share(torch.zeros(1) if mask is None else ~mask for mask in masks)


def _images(scene: Scene) -> Iterator[Advice]:
    """Problems of single images; sets may share files, and each is named once."""
    points = box_points(scene, scene.bounds.box, (9, 9, 9))

    def of_middle(views: Views) -> tuple[Tensor, Tensor]:
        """Pixels (N, 2) and depths (N,) of the middle of the box."""
        middle = points[4, 4, 4].expand(len(views), 3)
        return views.cameras.project(torch.arange(len(views)), middle)

    def away(views: Views) -> list[bool]:
        return (of_middle(views)[1] <= 0).tolist()

    def beside(views: Views) -> list[bool]:
        pixels, depth = of_middle(views)
        size = views.cameras.extents
        fine = (depth <= 0) | _shown(pixels, depth, size)
        for k in (~fine).nonzero()[:, 0].tolist():
            places, depths = views.cameras.project_into(k, points.view(-1, 3))
            fine[k] = _shown(places, depths, size[k]).any()
        return (~fine).tolist()

    pose = "check the pose (camera-to-world, x right, y up, looking along -z), or set data.box"
    for test, problem, remedy in (
        (away, "looks away from the middle of the box", pose),
        (beside, "does not have the box in the picture", pose),
        (_is_flat, "one colour all over", "look at the file, and leave it out if it is lost"),
        (
            _is_empty,
            "its alpha mask is empty: it shows background only",
            "look at the alpha channel, or leave the image out",
        ),
        (
            _is_opaque,
            "opaque all over, while others of its set are cut out: its background is learned too",
            "save it with the subject's alpha, or leave the image out",
        ),
        (
            _is_ambiguous,
            "its EXIF orientation says that it is to be seen turned; it is read as it is stored, "
            "since its camera does not tell",
            "if the cameras were found on turned images, turn the files too "
            "(mogrify -auto-orient); else take the orientation out (exiftool -Orientation=)",
        ),
    ):
        sets = {id(views): views for views in image_sets(scene).values()}.values()
        names = [
            name
            for views in sets
            for name, bad in zip(views.names, test(views), strict=True)
            if bad
        ]
        if names:
            yield Advice(listed(list(dict.fromkeys(names))), problem, remedy)


def _valid_pixels(views: Views, k: int) -> Tensor:
    """(M, 3 or 4) uint8."""
    pixels = views.pixels[k]
    return pixels.flatten(0, 1) if views.valid_mask is None else pixels[views.valid_mask[k]]


def _is_flat(views: Views) -> Iterator[bool]:
    for k in range(len(views)):
        if views.has_alpha:  # a subject of one colour still has an outline
            yield False
        else:
            pixels = _valid_pixels(views, k)
            # uint8: low is the less.
            low, high = pixels.aminmax(dim=0) if len(pixels) else pixels.new_zeros(2, 3)
            yield int((high - low).max()) <= FLAT


def _is_empty(views: Views) -> Iterator[bool]:
    for k in range(len(views)):
        yield views.has_alpha and int(_valid_pixels(views, k)[:, 3].max()) <= OPAQUE


def _is_opaque(views: Views) -> list[bool]:
    if not views.has_alpha:
        return [False] * len(views)
    least = views.pixels[..., 3].flatten(1).amin(dim=1)
    opaque = least > OPAQUE
    return (opaque & ~opaque.all()).tolist()  # of a whole set _alpha says so


def _is_ambiguous(views: Views) -> list[bool]:
    ambiguous = views.ambiguous_orientation
    return [False] * len(views) if ambiguous is None else ambiguous.tolist()


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
    sets = image_sets(scene).items()
    # Half of each image with an exposure of its own is not scored, and no mask says so.
    shares = {n: masked_share(views) or 0.0 for n, views in sets if views.exposure_mask is None}
    if much := {name: share for name, share in shares.items() if share > MUCH_MASKED}:
        yield Advice(
            listed(list(much), 4),
            f"masks leave out up to {100 * max(much.values()):.0f} % of the pixels, of which "
            "nothing is learned",
            "if they cut out the subject, set data.masks=alpha: "
            "what they leave out is background then",
        )


def _times(scene: Scene) -> Iterator[Advice]:
    views = scene.dynamic.train
    clock = scene.clock
    if not scene.moves:
        if cameras := standing(views.cameras.camera_to_world):
            yield Advice(
                "static training set",
                f"{cameras}, as if the scene moved, but all images have one time",
                "if it moves, give each image its time",
            )
        return
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
    views_at = defaultdict[int, set[int]](set)
    incomplete = []
    for frame, number in zip(
        clock.frames_of(views.times).tolist(), views.view.tolist(), strict=True
    ):
        views_at[frame].add(number)
    for frame in sorted(views_at):
        if missing := sorted(numbers - views_at[frame]):
            without = ", ".join(map(str, missing))
            incomplete.append(f"time {clock.times[frame]:.3g} without view {without}")
    if incomplete:
        yield Advice(
            "dynamic training set",
            f"not all views at every time: {listed(incomplete)}",
            "add the images, or leave these times or views out: motion is less certain there",
        )


def _flow(scene: Scene) -> Iterator[Advice]:
    views = scene.dynamic.train
    longest = max(views.width, views.height)
    if views.flow is None:
        length = 0.0 if views.by_moving_camera else _frame_to_frame(views)
        if length > FAR * longest:
            yield Advice(
                "optical flow",
                f"none, though parts move by {length:.0f} px from frame to frame, of {longest}",
                "film more frames a second, or try data.flow=dis, which estimates it",
            )
        return
    long = []
    broken = []
    covered = []
    for k, _ in frame_pairs(views):
        view = views.single(k)
        assert view.flow is not None
        vectors = view.flow.vectors[0]
        valid = view.flow.valid[0]
        inside = view.pixels[0, ..., 3] > OPAQUE if views.has_alpha else torch.ones_like(valid)
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
        problem = "valid where it is not a number"
        remedy = "mask these pixels, or set data.flow=none"
        yield Advice(f"flow of {listed(broken)}", problem, remedy)
    share = sum(covered) / max(len(covered), 1)
    if covered and share < MIN_FLOW:
        where = "the alpha masks" if views.has_alpha else "the pixels"
        yield Advice(
            "optical flow",
            f"valid on {100 * share:.1f} % of {where}",
            "check its masks, or set data.flow=dis to estimate it",
        )


def _frame_to_frame(views: Views) -> float:
    """Motion between two frames, in pixels: the 99th percentile of a few pairs."""
    longest = 0.0
    between = estimator("dis")
    pairs = frame_pairs(views)
    for image, earlier in (pairs[k] for k in evenly(len(pairs), SAMPLED_PAIRS)):
        vectors, valid = flow_between(views, image, earlier, between)
        lengths = vectors[valid].norm(dim=-1)
        if len(lengths):
            longest = max(longest, float(lengths.quantile(0.99)))
    return longest
