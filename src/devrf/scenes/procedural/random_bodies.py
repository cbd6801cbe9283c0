"""Bodies drawn at random, each from a number: scenes that no setting was chosen for.

A chain, a tree or a loop of boxes, capsules, ellipsoids and blades, thick and thin. Parts turn on
the part that carries them, or slide away from it along their own axis; parts that carry none may
bend, twist or be squashed, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from random import Random
from typing import Any

import torch
from torch import Tensor

from devrf.scenes.procedural.assembled import NO_SWING, Assembled, Part
from devrf.scenes.procedural.filming import extent
from devrf.scenes.procedural.motion import Swing
from devrf.scenes.procedural.rigs import STUDIO
from devrf.scenes.procedural.solids import Material, Paint, Rgb, Xyz

# At most so many bodies are drawn for a seed.
TRIES = 12
# A body is taken at once if a smaller share of its points than this enters other parts.
ENTERED = 0.02
# The share of a picture that the square around a body covers.
MIN_COVERED = 0.15
MAX_COVERED = 0.7
# Displacement of the point that moves most, as a share of the body's longest canonical edge.
MIN_MOVED = 0.1
MAX_MOVED = 0.8
# The spin of round parts if texture slides.
SPIN = Swing(1.5, 1.2, 0.0)
TIMES = tuple(k / 12 for k in range(13))


def random_body(seed: int, speed: float = 1.0, sliding: bool = False) -> Assembled:
    """The body of a ``seed``.

    ``sliding``: round parts spin, so that their texture slides over a fixed silhouette.
    """
    parts = drawn_body(seed).parts
    round_parts = [part.half[0] == part.half[1] and part.kind != "box" for part in parts]
    spins = (SPIN if sliding and is_round else NO_SWING for is_round in round_parts)
    spinning = (replace(part, spin=spin) for part, spin in zip(parts, spins, strict=True))
    return Assembled(tuple(spinning), speed)


@lru_cache(maxsize=32)
def drawn_body(seed: int) -> Assembled:
    """Among the bodies drawn for a ``seed``, the one whose parts enter each other the least."""
    best = Assembled(())
    least = math.inf
    for attempt in range(TRIES):
        draw = Random(f"{seed}/{attempt}")
        parts = _drawn(draw)
        covers = draw.uniform(MIN_COVERED, MAX_COVERED)
        moves = draw.uniform(MIN_MOVED, MAX_MOVED)
        body = _fitted(parts, covers, moves)
        entered = _entered(body)
        if entered < least:
            best = body
            least = entered
        if least < ENTERED:
            break
    return best


def placed(body: Assembled, center: Xyz, reach: float) -> Assembled:
    """The body about ``center``, made so small that it stays within ``reach`` of it."""
    size = min(1.0, reach / extent(body).reach)
    parts = (_scaled(part, size, 1.0) for part in body.parts)
    there = torch.tensor(center, dtype=torch.float64)
    return replace(body, parts=tuple(replace(part, base=part.base + there) for part in parts))


def _drawn(draw: Random) -> list[Part]:
    """Four to nine parts."""
    style = draw.choice(("chain", "tree", "loop"))
    count = draw.randint(4, 9)
    parts = _loop(draw) if style == "loop" else []
    bars = len(parts)
    while len(parts) < count:
        last = len(parts) - 1
        parent = last if style == "chain" or last < 0 else draw.randint(max(0, last - 3), last)
        parts.append(_carried(draw, parts, parent))
    free = set(range(bars, count)) - {part.parent for part in parts}
    return [_soft(draw, part) if k in free else part for k, part in enumerate(parts)]


def _loop(draw: Random) -> list[Part]:
    """Four equal bars on hinges that stay closed: a rhombus that opens and shuts."""
    along = draw.uniform(0.2, 0.3)
    thick = draw.uniform(0.03, 0.08)
    side, normal, ahead = _axes(draw, _direction(draw)).unbind(1)
    angle = draw.uniform(0.3, 0.6)
    swing = _swing(draw, 0.2, 0.4)
    base = -2 * along * math.cos(angle) * ahead
    bars: list[Part] = []
    # A bar lies at φ, −φ, φ + π or π − φ; so each turns back twice on the one before.
    for k, (at, factor) in enumerate(
        ((angle, 1.0), (-angle, -2.0), (angle + math.pi, 2.0), (math.pi - angle, -2.0))
    ):
        lead = math.cos(at) * ahead + math.sin(at) * side
        axes = torch.stack([torch.linalg.cross(normal, lead), normal, lead], dim=1)
        turns = replace(swing, amplitude=factor * swing.amplitude)
        half = (thick, thick, along)
        bars.append(Part("capsule", half, k - 1, base, axes, _xyz(normal), _paint(draw), turns))
        base = base + 2 * along * lead
    return bars


def _carried(draw: Random, parts: Sequence[Part], parent: int) -> Part:
    """A part that turns on the part ``parent``, or slides away from it; −1: on the ground."""
    along = draw.uniform(0.12, 0.35)
    thick = draw.uniform(0.03, 0.06) if draw.random() < 0.3 else draw.uniform(0.1, 0.22)
    kind = draw.choice(("box", "capsule", "ellipsoid", "blade"))
    across = min(thick, 0.7 * along)
    half = {
        "box": (across, across * draw.uniform(0.4, 1.0), along),
        "capsule": (across, across, along),
        "ellipsoid": (1.3 * across, 1.3 * across, along),
        "blade": (0.45 * along, 0.03, along),
    }[kind]
    swing = _swing(draw, 0.3, 1.1)
    slides = draw.random() < 0.2
    amount = draw.uniform(0.1, 0.3)
    lead = _direction(draw)
    base = torch.zeros(3, dtype=torch.float64)
    if parent >= 0:
        carrier = parts[parent]
        ahead = carrier.axes[:, 2]
        lead = torch.nn.functional.normalize(lead + draw.uniform(0.3, 1.0) * ahead, dim=0)
        share = 1.0 if draw.random() < 0.5 else draw.uniform(0.3, 1.0)
        base = carrier.base + share * carrier.along * ahead
    hinge = _xyz(_direction(draw))
    part = Part(kind, half, parent, base, _axes(draw, lead), hinge, _paint(draw))
    if slides and parent >= 0:
        return replace(part, slide=Swing(amount, draw.uniform(1.0, 1.5), 0.0))
    return replace(part, swing=swing)


def _soft(draw: Random, part: Part) -> Part:
    """The part, which may bend, twist or be squashed, too."""
    way = draw.choice(("", "bend", "twist", "squash"))
    most = {"bend": 1.2, "twist": 1.2, "squash": 0.4}
    swing = _swing(draw, 0.3 * most.get(way, 1.0), most.get(way, 1.0))
    changed: dict[str, Any] = {way: swing} if way else {}
    return replace(part, **changed)


def _fitted(parts: Sequence[Part], covers: float, moves: float) -> Assembled:
    """The body about the origin, in its size, with its motion."""
    motion = 1.0
    for _ in range(6):
        body = Assembled(tuple(_scaled(part, 1.0, motion) for part in parts))
        outline = body.outline()
        canonical = outline.canonical
        paths = torch.stack([body.forward(outline, time) for time in TIMES])
        edge = float((canonical.amax(dim=0) - canonical.amin(dim=0)).max())
        went = float((paths - canonical).norm(dim=-1).max())
        motion *= min(max(moves * edge / max(went, 1e-6), 0.3), 2.0)
    points = paths.reshape(-1, 3)
    middle = (points.amin(dim=0) + points.amax(dim=0)) / 2
    picture = 2 * STUDIO.distance * math.tan(STUDIO.field_of_view / 2)
    size = math.sqrt(covers) * picture / edge
    placed = (replace(part, base=part.base - middle.double()) for part in body.parts)
    return Assembled(tuple(_scaled(part, size, 1.0) for part in placed))


def _scaled(part: Part, size: float, motion: float) -> Part:
    """The part ``size`` times as large about the origin, moving ``motion`` times as far."""
    moving: dict[str, Any] = {
        name: replace(swing, amplitude=motion * swing.amplitude)
        for name in ("swing", "bend", "twist", "squash")
        if (swing := getattr(part, name)) is not NO_SWING
    }
    slide = replace(part.slide, amplitude=size * motion * part.slide.amplitude)
    a, b, c = part.half
    half = (size * a, size * b, size * c)
    base = size * part.base
    return replace(part, half=half, base=base, slide=slide, **moving)


def _entered(body: Assembled) -> float:
    """The share of the parts' axes that enters a part which it is not in canonically."""
    share = torch.linspace(0, 1, 9, dtype=torch.float64)
    axes = [part.base + share[:, None] * part.along * part.axes[:, 2] for part in body.parts]
    part = torch.arange(len(axes)).repeat_interleave(len(share))
    canonical = torch.cat(axes).float()
    material = Material(canonical, part)
    before = body.distances(canonical, 0.0) < 0
    inside = [
        (body.distances(body.forward(material, time), time) < 0) & ~before for time in TIMES[::3]
    ]
    others = torch.arange(len(axes))[:, None] != part
    return float((torch.stack(inside).any(dim=0) & others).any(dim=0).float().mean())


def _swing(draw: Random, least: float, most: float) -> Swing:
    amplitude = draw.choice((-1, 1)) * draw.uniform(least, most)
    return Swing(amplitude, draw.uniform(1.0, 2.4), draw.uniform(-1.3, 0.1))


def _direction(draw: Random) -> Tensor:
    """A unit vector (3,) float64, uniformly distributed."""
    drawn = torch.tensor([draw.gauss(0, 1) for _ in range(3)], dtype=torch.float64)
    return torch.nn.functional.normalize(drawn, dim=0)


def _axes(draw: Random, along: Tensor) -> Tensor:
    """Right-handed axes (3, 3) as columns, the third ``along`` a unit vector."""
    across = torch.linalg.cross(_direction(draw), along)
    y = torch.nn.functional.normalize(across, dim=0)
    return torch.stack([torch.linalg.cross(y, along), y, along], dim=1)


def _xyz(vector: Tensor) -> Xyz:
    x, y, z = vector.tolist()
    return x, y, z


def _paint(draw: Random) -> Paint:
    """Two colours that can be told apart, as stripes or checks."""

    def color() -> Rgb:
        return draw.uniform(0.05, 0.95), draw.uniform(0.05, 0.95), draw.uniform(0.05, 0.95)

    base = color()
    accent = color()
    while math.dist(base, accent) < 0.4:
        accent = color()
    # Six pixels or more of an image of 64: finer texture would be lost in any small image.
    x, y, z = (draw.choice((0.0, draw.uniform(0.27, 0.5))) for _ in range(3))
    return Paint(base, accent, (x, y, z or draw.uniform(0.27, 0.5)), draw.uniform(-0.1, 0.35))
