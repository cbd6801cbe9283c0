"""Makes this folder's pictures from finished runs of embedded scenes.

Learn the scenes, then give the folders of their runs::

    python -m devrf experiment=quickstart
    python -m devrf experiment=quickstart data.shape=flower
    python docs/images/make.py outputs/robot/quickstart outputs/flower/quickstart
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from devrf.apps.camera_paths import orbit
from devrf.apps.still import sized, still
from devrf.apps.video import VideoSettings
from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.geometry.cameras import Cameras
from devrf.pictures.images import image_grid, scaled, to_bytes
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.scenes.procedural.filming import Filming, extent

HERE = Path(__file__).parent
# Of the renderings and of the tiles, in pixels; white pixels that stay around what is seen.
HEIGHT, TILE, MARGIN, TEXT = 400, 210, 8, 19
ROWS = [["truth"], ["rendered"], ["depth"]]


def opened(run: Path) -> tuple[Any, Renderable]:
    """The data of a run, and what its deformation stage learned from them."""
    data = instantiate(OmegaConf.load(run / "checkpoints" / "config.yaml").data)
    return data, load_checkpoint(run / "checkpoints" / "deformation.ckpt", data.scene).model


def scene_columns(run: Path) -> tuple[list[list[Tensor]], list[str]]:
    """Truth, rendering and depth of a run's scene in four columns, cut to what can be seen."""
    data, model = opened(run)
    scene, recipe = data.scene, data.recipe
    shape, film = recipe.model(), VideoSettings(frames=8, height=HEIGHT)
    camera = sized(scene.dynamic.test.cameras[[0]], HEIGHT)
    middle = torch.tensor(model.box.middle)
    around = orbit(sized(scene.static.train.cameras, HEIGHT), middle, film)
    filming = Filming(shape, extent(shape).reach, recipe.supersample, recipe.light)
    shots: list[tuple[Cameras, float, str]] = [
        *((camera, time, f"{scene.name}, t = {time:g}") for time in (0.0, 0.5, 1.0)),
        (around[[1]], 1.0, "another view, t = 1"),
    ]
    renderer, columns = Renderer(model), []
    for cameras, time, _ in shots:
        pixels = filming.pictures(cameras, time)[0][0].float() / 255
        truth = 1 + pixels[..., 3:] * (pixels[..., :3] - 1)
        columns.append([truth, *still(renderer, cameras, time, 1.0)])
    return cut(columns), [heading for _, _, heading in shots]


def cut(columns: Sequence[Sequence[Tensor]]) -> list[list[Tensor]]:
    """Images of one size cut to the smallest that holds all that is not white in any of them."""
    boxes = [[inked(column, axis) for axis in (0, 1)] for column in columns]
    size = [max(high - low for low, high in (box[axis] for box in boxes)) for axis in (0, 1)]
    found = []
    for column, box in zip(columns, boxes, strict=True):
        for axis, (low, high) in enumerate(box):
            start = (low + high - size[axis]) // 2 - MARGIN
            start = min(max(start, 0), column[0].shape[axis] - size[axis] - 2 * MARGIN)
            column = [image.narrow(axis, start, size[axis] + 2 * MARGIN) for image in column]
        found.append([scaled(image, TILE) for image in column])
    return found


def inked(images: Sequence[Tensor], axis: int) -> tuple[int, int]:
    """The range along an axis in which any of some images is not white."""
    ink = torch.stack([(image < 0.97).any(dim=-1).any(dim=1 - axis) for image in images])
    places = ink.any(dim=0).nonzero()[:, 0]
    return int(places[0]), int(places[-1]) + 1


def write_small(path: Path, image: Tensor) -> None:
    """Write a PNG of 256 colours."""
    pixels: Any = to_bytes(image).numpy()
    palette = Image.fromarray(pixels).quantize(256, dither=Image.Dither.NONE)
    palette.save(path, optimize=True)


def main(runs: Sequence[Path]) -> None:
    """Write ``scenes.png`` of the runs, and ``held_out.png``, the first one's contact sheet."""
    blocks = [scene_columns(run) for run in runs]
    width = max(column[0].shape[1] for columns, _ in blocks for column in columns)
    columns = [[padded(image, width) for image in one] for block, _ in blocks for one in block]
    headings = [heading for _, names in blocks for heading in names]
    rows = [list(row) for row in zip(*columns, strict=True)]
    write_small(HERE / "scenes.png", image_grid(rows, headings, ROWS, TEXT))
    sheet = Image.open(runs[0] / "images" / "dynamic.png").convert("RGB")
    sheet.quantize(256, dither=Image.Dither.NONE).save(HERE / "held_out.png", optimize=True)


def padded(image: Tensor, width: int) -> Tensor:
    """An image with white columns on both sides, ``width`` wide."""
    left = (width - image.shape[1]) // 2
    right = width - image.shape[1] - left
    return torch.nn.functional.pad(image, (0, 0, left, right), value=1.0)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
