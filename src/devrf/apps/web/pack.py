"""Packs a DeVRF scene into one HTML file, which a browser draws by itself.

``scene.html`` gets ``scene.js``, ``scene.glsl`` and its textures' contents, gzip in base64:

==================== ==============================================================================
``density``          raw densities v at rest, half precision
``rough``            preview colours: RGB as the nearest camera sees it; bytes
``features``         colour features f, a byte each: its share of its channel's range, which the
                     network's first layer knows; blocks of four channels, one behind another
``weights``          the colour network, single precision
``moving``           255 where a canonical point moves (docs/stages.md#moving), else 0
``palette``          the colours of stills' depths, from near to far; bytes
``distances-rest``   cells to the nearest occupied one at rest, a byte
``distances-K``      the same at all times between the frames K and K + 1
``displacement-K``   Δ_b of frame K in shares of a cell, half precision: devices may round what
                     they read between bytes to a byte
``residual-K``       A_t of frame K, half precision, if colours change
==================== ==============================================================================

Values are kept where samples read them, then or at any time; the others are all the same and take
no space. ``description``, JSON, holds boxes, sampling and cameras.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
import re
from collections.abc import Callable, Iterator
from functools import partial
from importlib.resources import files
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from devrf.apps.camera_paths import upward
from devrf.apps.captured_cameras import described, frustum_depth
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import deformed_occupancy, march_inputs
from devrf.ops.trilinear import shape_of
from devrf.pictures.images import depth_colors, to_bytes
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.renderable import Renderable
from devrf.rendering.seen_points import scene_radius
from devrf.scenes.scene import background_value
from devrf.system.printed import shown

# Displacements are rounded to this share of a cell, residual colours to this share of a logit:
# noise takes space.
ROUNDED = 1 / 64
# Grid points whose colours are found at once.
CHUNK = 2**16
# Colours of depths: as many as stills have.
COLORS = 256
# Texels in a texture's row of weights, four numbers each.
ROW = 64


def drawable(model: Renderable) -> bool:
    """Whether the page can draw a model: DeVRF's fields with a colour network."""
    return isinstance(model, DeVRFModel) and isinstance(model.canonical.decoder, ColorDecoder)


@torch.no_grad()
def page(model: Renderable, viewpoints: Viewpoints, name: str, checkpoint: str) -> str:
    """The page of the scene ``name``, with the cameras of ``viewpoints``.

    It names its ``checkpoint`` by the digest.

    Raises:
        DevrfError: the page cannot draw the model.
    """
    if not drawable(model):
        raise DevrfError(
            f"method={model.name}: the page draws DeVRF's fields with their colour network only; "
            "give export.format=ply, or look at it with viewer.renderer=server"
        )
    assert isinstance(model, DeVRFModel)
    sizes: dict[str, tuple[int, ...]] = {}
    elements = []
    for part, values in _parts(model, viewpoints.static):
        sizes[part.partition("-")[0]] = values.shape[2::-1]
        elements.append(_element(part, values))
    description = _description(model, viewpoints) | {"name": name, "shapes": sizes}
    folder = files("devrf.apps.web")
    texts = {
        "title": html.escape(shown(f"{name} · devrf")),
        "checkpoint": checkpoint,
        "shader": folder.joinpath("scene.glsl").read_text("utf-8"),
        "script": folder.joinpath("scene.js").read_text("utf-8"),
        # No name in it may end the element.
        "description": json.dumps(description).replace("<", "\\u003c"),
        "data": "\n".join(elements),
    }
    text = folder.joinpath("scene.html").read_text("utf-8")
    # In one pass: a scene's name may look like a word.
    return re.sub(r"\{\{(\w+)\}\}", lambda word: texts[word[1]], text)


def _element(part: str, values: Tensor) -> str:
    packed = gzip.compress(values.contiguous().cpu().numpy().tobytes(), compresslevel=6, mtime=0)
    return f'<script type="text/plain" id="{part}">{base64.b64encode(packed).decode()}</script>'


def _parts(model: DeVRFModel, cameras: Cameras) -> Iterator[tuple[str, Tensor]]:
    """The contents of all textures by the elements' names: (depth, height, width, …)."""
    field = model.canonical
    sampling = model.at(0.0).picture_settings
    occupied = partial(deformed_occupancy, field, model.occupancy, sampling)
    rest = occupied(GridWarp(None, model.box))
    visible = rest.points_near(field.density.shape, model.box)
    raw = field.density.values[..., 0]
    yield "density", torch.where(visible, raw, raw.min()).half()
    if not model.space.is_linear:  # rays end in the field's outer faces
        visible[[0, -1]] = visible[:, [0, -1]] = visible[:, :, [0, -1]] = True
    yield "rough", _rough(model, visible, cameras.positions.to(visible.device))
    low, high = field.color.values[visible | ~visible.any()].aminmax(dim=0)
    high = torch.maximum(high, low + 1e-6)
    shares = ((field.color.values - low) / (high - low)).clamp(0, 1) * visible[..., None]
    codes = pad((255 * shares).round().byte(), (0, -len(low) % 4))
    yield "features", torch.cat(torch.split(codes, 4, dim=-1))
    assert isinstance(field.decoder, ColorDecoder)
    yield "weights", _weights(field.decoder, low, high)
    moves = model.moving_points(scene_radius(model, cameras))
    yield "moving", 255 * moves.to(torch.uint8)
    depths = torch.linspace(0, 1, COLORS)[None]
    yield "palette", to_bytes(depth_colors(depths, torch.ones_like(depths), near=0, far=1))[None]
    deformation = model.deformation
    residual = model.color_residual
    seen = _seen(deformation, rest.cell, occupied) if deformation else []
    for part, mask in ({"rest": rest.mask} | dict(enumerate(seen))).items():
        yield f"distances-{part}", Occupancy(mask, model.box).distances.cells
    for k in range(len(deformation.clock) if deformation else 0):
        assert deformation is not None
        mask = torch.stack(seen[max(k - 1, 0) : k + 1]).any(dim=0)
        near = Occupancy(mask, model.box).points_near(deformation.shape, deformation.box)
        kept = near[..., None] * deformation.backward_slices[k].to(near.device).float()
        yield f"displacement-{k}", (kept / (ROUNDED * model.occupancy.cell)).round().half()
        if residual is not None:
            values = residual.values[k]
            near = rest.points_near(shape_of(values), residual.box)
            yield f"residual-{k}", ((values / ROUNDED).round() * ROUNDED * near[..., None]).half()


def _rough(model: DeVRFModel, visible: Tensor, eyes: Tensor) -> Tensor:
    """Colours (X, Y, Z, 3), bytes, as the nearest of the ``eyes`` (K, 3) sees them.

    They are 0 at grid points that are not ``visible`` (X, Y, Z).
    """
    field = model.canonical
    points = model.box.grid_points(field.density.shape, eyes)
    codes = torch.zeros(*field.density.shape, 3, dtype=torch.uint8, device=visible.device)
    for where in torch.split(visible.nonzero(), CHUNK):
        at = where.unbind(dim=1)
        world = model.space.to_world(points[at])
        views = normalize(world - eyes[torch.cdist(world, eyes).argmin(dim=1)], dim=1)
        every = torch.arange(len(views), device=views.device)
        color = field.decoder(field.color.values[at], views, every)
        codes[at] = (255 * color).round().byte()
    return codes


def _seen(
    deformation: DeformationField, cell: float, occupied: Callable[[GridWarp], Occupancy]
) -> list[Tensor]:
    """Occupancy at any time between two consecutive frames: masks (X, Y, Z).

    Nothing moves by more than a ``cell`` from the nearest of some times: masks are grown by one.
    """
    masks = []
    times = deformation.clock.times
    at_frames = [occupied(deformation.backward_warp(time)) for time in times]
    for k, (first, second) in enumerate(pairwise(at_frames)):
        mask = first.mask | second.mask
        near = Occupancy(mask, first.box).points_near(deformation.shape, deformation.box)
        before, after = (deformation.backward_slices[n].to(near.device).float() for n in (k, k + 1))
        # Points that move by more than this come from empty space.
        change = min(float(((after - before).norm(dim=-1) * near).amax()), first.box.diagonal)
        steps = math.ceil(change / (2 * cell))
        for time in torch.linspace(times[k], times[k + 1], steps + 1)[1:-1].tolist():
            mask |= occupied(deformation.backward_warp(time)).mask
        masks.append(dilate(mask, 1))
    return masks


def _weights(decoder: ColorDecoder, low: Tensor, high: Tensor) -> Tensor:
    """The colour network as scene.glsl reads it: vec4s, in rows of ``ROW``.

    The first layer takes shares of the features' ranges from ``low`` to ``high`` (C,).
    """
    first, hidden, output = decoder.from_feature, decoder.hidden, decoder.output
    parts = (
        (first.bias + first.weight @ low)[:, None],
        first.weight * (high - low),
        decoder.from_direction.weight,
        hidden.bias[:, None],
        hidden.weight,
        output.bias[:, None],
        output.weight,
    )
    # Contributions of one input after the other to all outputs, each number a multiple of four.
    whole = [pad(part, (0, -part.shape[1] % 4, 0, -part.shape[0] % 4)).T for part in parts]
    flat = torch.cat([part.flatten() for part in whole])
    return pad(flat, (0, -len(flat) % (4 * ROW))).view(1, -1, ROW, 4)


def _description(model: DeVRFModel, viewpoints: Viewpoints) -> dict[str, Any]:
    """The page's data beside its textures."""
    field = model.canonical
    deformation = model.deformation
    space = model.space
    sampling = model.at(0.0).picture_settings
    path = march_inputs(field, model.occupancy, sampling).range
    inner = space.inner(model.box)
    decoder = field.decoder
    assert isinstance(decoder, ColorDecoder)
    defines = {
        "SPACE": 0,
        "FEATURES": math.ceil(decoder.from_feature.in_features / 4),
        "WIDTH": math.ceil(decoder.hidden.in_features / 4),
        "FREQUENCIES": len(decoder.octaves),
        "MOVES": int(deformation is not None),
        "RESIDUAL": int(model.color_residual is not None),
    }
    uniforms: dict[str, Any] = {
        "low": model.box.low,
        "high": model.box.high,
        "near": path.near,
        "far": min(path.far, 1e30),  # JSON has no infinity
        "stepLength": path.step,
        "shift": field.shift,
        "delta": field.step_in_base_voxels(sampling.step),
        "threshold": sampling.alpha_threshold,
        "background": [background_value(viewpoints.background)] * 3,
        "center": inner.middle,
        "reach": inner.diagonal / 3,
    }
    if isinstance(space, NormalizedDevice):
        defines["SPACE"] = 1
        uniforms["ndc"] = (*space.slopes, space.near)
    if isinstance(space, ContractedSpace):
        defines["SPACE"] = 2
        uniforms |= {"innerHalf": [edge / 2 for edge in inner.size], "shell": space.shell}
    if deformation is not None:
        box = deformation.box
        uniforms |= {"displacementLow": box.low, "displacementHigh": box.high}
        uniforms["zeroOutsideBox"] = deformation.zero_outside_box
        uniforms["displacementStep"] = ROUNDED * model.occupancy.cell
    static = viewpoints.static
    return {
        "defines": defines,
        "uniforms": uniforms,
        "times": [0.0] if deformation is None else deformation.clock.times,
        "up": upward(static).tolist(),
        "offset": viewpoints.offset,
        "frustum": frustum_depth(static),
        "cameras": list(described(model, viewpoints)),
    }
