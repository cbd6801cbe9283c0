"""Another program's pictures of a scene's held-out views, to be scored as a method's are.

They lie in a folder, or are a film with an image for each held-out one in their order. A scene
with two sets of held-out views has a folder or a film for each, ``static`` and ``dynamic``; those
that are not there are not scored. In a folder the images are told by

* ``predictions.json``: ``{"images": [{"file": "a.png", "image": "r_003.png"}, …]}``, or in place of
  ``image`` ``"view"`` and ``"time"``;
* else the names of the held-out images;
* else view and time in their own names: ``view0_time0.250.png``;
* else their order, if there are as many: ``00000.png``, ``00001.png``, …
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
from pydantic import BaseModel, Field
from torch import Tensor
from torch.nn.functional import interpolate

from devrf.evaluation.held_out import truth_image
from devrf.scenes.files import MOST_IMAGES, Name, Number, inside, read_json
from devrf.scenes.footage import VIDEOS, Picture, footage_header, frames_at
from devrf.scenes.image_folders import listed_images
from devrf.scenes.images import decode, read_header
from devrf.scenes.scene import Background, Views, background_value, on_background
from devrf.scenes.validation import scene_error
from devrf.system.options import abbreviated

log = logging.getLogger(__name__)

LIST = "predictions.json"
# A view's number and a time in [0, 1].
_PLACED = re.compile(r"view(\d{1,6})_time(\d+(?:\.\d+)?)")
# Largest difference of a stated time from the image's.
SAME_TIME = 1e-3
# Pictures have changed places if this share of their errors is left when each is compared with the
# image that it is most like, or less.
IN_ANOTHER_ORDER = 0.5
# Pictures have another background if they differ from it by so much, on average.
OTHER_BACKGROUND = 0.5
# Pixels of the sides of pictures when they are told apart.
SMALL = 32


class Listed(BaseModel):
    """An entry of ``predictions.json``.

    Attributes:
        file: the picture, relative to the folder.
        image: the name of the held-out image; None: ``view`` and ``time`` say which it is.
        view: the number of the held-out camera, from 0 on.
        time: in [0, 1].
    """

    file: Name
    image: Name | None = None
    view: Annotated[int, Field(ge=0, strict=True)] | None = None
    time: Number | None = None


class PredictionsFile(BaseModel):
    """The content of ``predictions.json``."""

    images: Annotated[list[Listed], Field(fail_fast=True, min_length=1, max_length=MOST_IMAGES)]


def picture_name(views: Views, index: int) -> str:
    """A name by which :func:`read_predictions` knows the picture of a held-out image."""
    number = sorted({*views.view.tolist()}).index(int(views.view[index]))
    return f"view{number}_time{float(views.times[index]):.4f}.png"


def read_predictions(
    path: Path, sets: Mapping[str, Views], background: Background
) -> dict[str, Callable[[int], Tensor]]:
    """The pictures in a folder, or in films (see above), of those ``sets`` that have some, by name.

    Each is read anew when it is asked for, by the position of its image: (H, W, 3) in [0, 1].

    Raises:
        DevrfError: a picture is missing, of another size than its image, or most like another
            image.
    """
    pictures: dict[str, Callable[[int], Tensor]] = {}
    for name, place in _places(path, sets).items():
        views = sets[name]
        found = _film(place, views) if os.path.isfile(place) else pictures_in(place, views)
        picture = partial(_color, found, background_value(background))
        _check_order(picture, views, background, place)
        _compare_background(picture, views, background, place)
        pictures[name] = picture
    return pictures


def _color(found: Callable[[int], Picture], behind: float, index: int) -> Tensor:
    return on_background(torch.tensor(found(index)), behind)


def _places(path: Path, sets: Iterable[str]) -> dict[str, Path]:
    """The folder or the film of each set that has one; else the folder itself, of the last set."""
    named = {name: [path / f"{name}{suffix}" for suffix in ("", *VIDEOS)] for name in sets}
    present = {name: [*filter(os.path.exists, places)] for name, places in named.items()}
    found = {name: places[0] for name, places in present.items() if places}
    # Pictures of one kind are of the scene in motion, if it moves.
    return found or {[*named][-1]: path}


def _film(film: Path, views: Views) -> Callable[[int], Picture]:
    """The frames of a film, one for each image in their order."""
    header = footage_header(film)
    count = header.frames
    for index in range(len(views)):
        _check_size(header.size, views, index, film)
    if count != len(views):
        raise scene_error(
            film,
            f"has {count} frames, but {len(views)} images are held out; one for each is needed",
        )
    return dict(frames_at(film, range(count))).__getitem__


def pictures_in(folder: Path, views: Views) -> Callable[[int], Picture]:
    """The pictures in a folder (see above), by the position of the image that each is of.

    Raises:
        DevrfError: one is missing, or of another size than its image.
    """
    files = _listed(folder, views) if os.path.isfile(folder / LIST) else _named(folder, views)
    lacking = [index for index in range(len(views)) if index not in files]
    if lacking:
        raise scene_error(
            folder,
            f"has no picture of {_in_words(views, lacking[0])}; {len(lacking)} of {len(views)} are "
            "missing: add them; pictures are called as the images "
            f"({Path(views.names[0]).stem}.png) or view0_time0.250.png, or {LIST} lists them",
        )

    def picture(index: int) -> Picture:
        file = files[index]
        header = read_header(file)
        _check_size((header.width, header.height), views, index, file)
        return decode(file, header, "RGBA")[:]

    return picture


def _listed(folder: Path, views: Views) -> dict[int, Path]:
    """The pictures that ``predictions.json`` lists, by the image that they show."""
    file = folder / LIST
    files: dict[int, Path] = {}
    # Whatever the folders and suffixes of names.
    stems = [Path(name).stem for name in views.names]
    for entry in read_json(file, PredictionsFile, "it lists the pictures; add it").images:
        path = inside(folder, folder, entry.file, file)
        if not os.path.isfile(path):
            raise scene_error(path, f"no such picture, but {LIST} lists it; add it")
        if entry.image is not None:
            wanted = Path(entry.image).stem
            meant = [k for k, stem in enumerate(stems) if stem == wanted]
        elif entry.view is not None and entry.time is not None:
            meant = _at(views, entry.view, entry.time)
        else:
            raise scene_error(
                file, f"{abbreviated(entry.file)} has neither image nor view and time"
            )
        if len(meant) != 1 or meant[0] in files:
            what = "several of the held-out images" if meant else "none of the held-out images"
            raise scene_error(file, f"{abbreviated(entry.file)} is a picture of {what}; correct it")
        files[meant[0]] = path
    return files


def _named(folder: Path, views: Views) -> dict[int, Path]:
    """The pictures in a folder by the image that their names say, or by their order."""
    images = listed_images(folder)
    numbers = {key: k for k, name in enumerate(views.names) for key in (name, Path(name).stem)}
    by_name = {numbers[path.stem]: path for path in images if path.stem in numbers}
    placed = [(path, match) for path in images if (match := _PLACED.fullmatch(path.stem))]
    by_place = {
        k: path for path, match in placed for k in _at(views, int(match[1]), float(match[2]))
    }
    # Some names may be those of images by chance: numbers are.
    if not placed and 2 * len(by_name) < len(images) == len(views):
        log.info("%s: %d pictures are taken in the order of their names", folder, len(images))
        return dict(enumerate(images))
    return max(by_name, by_place, key=len)


def _at(views: Views, view: int, time: float) -> list[int]:
    """The images of a camera at the time nearest to one, if any is near."""
    numbers = sorted({*views.view.tolist()})
    if view >= len(numbers):
        return []
    away = (views.times - time).abs().where(views.view == numbers[view], torch.inf)
    nearest = away.min()
    found: list[int] = (away == nearest).nonzero()[:, 0].tolist()
    return found if nearest < SAME_TIME else []


def _in_words(views: Views, index: int) -> str:
    return f"{views.names[index]} (time {float(views.times[index]):.3g})"


def _check_size(size: tuple[int, int], views: Views, index: int, where: Path) -> None:
    """DevrfError if a picture has not the size of its image."""
    camera = views.cameras.single(index)
    width, height = size
    if size != (camera.width, camera.height):
        raise scene_error(
            where,
            f"{width}x{height} px, but {_in_words(views, index)} has {camera.width}x"
            f"{camera.height}; render it at that size, or read the scene with another "
            "data.downscale",
        )


def _check_order(
    picture: Callable[[int], Tensor], views: Views, background: Background, place: Path
) -> None:
    """DevrfError if pictures have changed places: some, in another order, show one another's image.

    Those of a motion that was not learned, or lags behind, look like other images, too; but several
    like one, or one like an image that another picture shows well.
    """
    truths = torch.stack([_small(truth_image(views, k, background)) for k in range(len(views))])
    shown = torch.stack([_small(picture(k)) for k in range(len(views))])
    errors = torch.cdist(shown, truths).square()
    least, nearest = errors.min(dim=1)
    moved = (nearest != torch.arange(len(views))).nonzero()[:, 0]
    if not len(moved) or nearest[moved].sort().values.tolist() != moved.tolist():
        return
    said = errors.diagonal()[moved]
    if float(least[moved].sum()) < IN_ANOTHER_ORDER * float(said.sum()):
        first = int(moved[0])
        raise scene_error(
            place,
            f"the picture of {_in_words(views, first)} shows "
            f"{_in_words(views, int(nearest[first]))}: {len(moved)} are in another order; name "
            "them as the held-out images",
        )


def _compare_background(
    picture: Callable[[int], Tensor], views: Views, background: Background, place: Path
) -> None:
    """Say in a line if pictures have something else behind the alpha masks than the images."""
    behind = background_value(background)
    errors = []
    for k in range(len(views) if views.has_alpha else 0):
        clear = views.single(k).pixels[0, ..., 3] == 0
        if bool(clear.any()):
            errors.append(float((picture(k)[clear] - behind).abs().mean()))
    if errors and fmean(errors) > OTHER_BACKGROUND:
        log.warning(
            "%s: the images are %s behind the alpha masks, the pictures are not: scores count it; "
            "render the pictures so",
            place,
            "white" if behind else "black",
        )


def _small(picture: Tensor) -> Tensor:
    """A small version (SMALL · SMALL · 3,) of a picture (H, W, 3)."""
    small = interpolate(picture.permute(2, 0, 1)[None], (SMALL, SMALL), mode="area")
    return small.flatten()
