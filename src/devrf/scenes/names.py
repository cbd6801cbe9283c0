"""Names of a scene's images: their order, and the file that a name in a list means.

Lists are written by other programs on other systems: a name may lack its suffix, be spelled in
another case or another Unicode form, have back slashes, or begin in a folder of another machine.
"""

from __future__ import annotations

import logging
import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Literal, TypeVar

from devrf.scenes.files import entries, from_elsewhere, inside
from devrf.scenes.images import SUFFIXES
from devrf.scenes.validation import scene_error
from devrf.system.options import abbreviated

log = logging.getLogger(__name__)

Item = TypeVar("Item")

_SUFFIX = re.compile(r"\.[a-z]\w*$", re.IGNORECASE)
# One decimal number at the end of a name without its suffix.
_DECIMAL = re.compile(r"(?<![\d.])\d+\.(\d+)$")
_NUMBER = re.compile(r"(\d+)")


def in_order(
    items: Iterable[Item],
    name: Callable[[Item], str],
    where: object,
    *,
    by_characters: bool = False,
) -> list[Item]:
    """``items`` in the order of their names, in which runs of digits count as numbers.

    A single number with a point before the suffix is a decimal one, unless such numbers look like
    counters: of several lengths, some with a zero at the end (``1.9``, ``1.10``).
    ``by_characters``: names are compared as text, as in LLFF's code, whose files have a row for
    each. If both orders differ, a line in the log names the chosen one; ``where`` holds the items.
    """
    as_text = sorted(items, key=name)
    stems = [_SUFFIX.sub("", name(item)) for item in as_text]
    fractions = [match[1] for stem in stems if (match := _DECIMAL.search(stem))]
    counted = len({*map(len, fractions)}) > 1 and any(
        len(digits) > 1 and digits.endswith("0") for digits in fractions
    )
    keys = [_by_number(stem, decimal=not counted) for stem in stems]
    order = sorted(range(len(as_text)), key=keys.__getitem__)
    differing = [(k, number) for k, number in enumerate(order) if k != number]
    if differing:
        way = "characters" if by_characters else "numbers"
        pair = (as_text[k] for k in differing[0][:: 1 if by_characters else -1])
        first, second = (name(item) for item in pair)
        log.info("%s: names are in the order of their %s: %s before %s", where, way, first, second)
    return as_text if by_characters else [as_text[k] for k in order]


def _by_number(stem: str, *, decimal: bool) -> list[str | int | Decimal]:
    """Text and numbers in turn: any two such keys can be compared."""
    end = _DECIMAL.search(stem) if decimal else None
    pieces = _NUMBER.split(stem[: end.start()] if end else stem)
    key: list[str | int | Decimal] = [int(p) if k % 2 else p for k, p in enumerate(pieces)]
    return [*key, Decimal(end[0]), ""] if end else key


def last_number(stem: str) -> int | None:
    """The last number in a name without its suffix, if there is any."""
    numbers = _NUMBER.findall(stem)
    return int(numbers[-1]) if numbers else None


class ImageFinder:
    """Finds the images below a scene's folder that lists name; each folder is read once.

    Attributes:
        root: the scene's folder, which no name may leave.
    """

    def __init__(self, root: Path) -> None:
        """A finder for the scene in ``root``."""
        self.root = root
        self._names_in = cache(_names_in)

    def find(self, path: Path) -> Path | None:
        """The image that ``path``, below the root, means; None: there is none.

        The name as it is written comes first, then one with a suffix appended, then one with
        another image suffix; of each, the same spelling before others.
        """
        folder = self.root
        for part in path.relative_to(self.root).parts[:-1]:
            same = self._names_in(folder).get(_spelling(part), [])
            if not same:
                return None
            folder /= part if part in same else same[0]
        names = self._names_in(folder)
        suffixed = path.suffix.lower() in SUFFIXES
        wanted = [path.name] if suffixed else []
        wanted += [path.name + suffix for suffix in SUFFIXES]
        wanted += [path.stem + suffix for suffix in SUFFIXES if suffixed]
        for name in wanted:
            same = names.get(_spelling(name), [])
            for spelled in ([name] if name in same else same)[:1]:
                if os.path.isfile(folder / spelled):
                    return folder / spelled
        return None


def _names_in(folder: Path) -> dict[str, list[str]]:
    """The names in a folder, by their common spelling; none if there is no such folder."""
    names: dict[str, list[str]] = {}
    if os.path.isdir(folder):
        for path in entries(folder):
            names.setdefault(_spelling(path.name), []).append(path.name)
    return names


def _spelling(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


Missing = Literal["error", "skip"]


def present_images(
    names: Sequence[str],
    file: Path,
    finder: ImageFinder,
    missing: Missing,
    relative_to: Path | None = None,
    *,
    once: bool = True,
) -> dict[int, Path]:
    """The existing images that ``file`` lists, by their positions in the list.

    Args:
        names: of N images, with or without their suffix; see :class:`ImageFinder`.
        file: the file that lists them.
        finder: of the scene.
        missing: whether absent images are an error, or left out with one warning.
        relative_to: the folder that names are relative to; None: the file's.
        once: whether an image may be listed only once, under whatever names.

    Raises:
        DevrfError: an image is absent and must not be, or all are; or one is listed twice.
    """
    root = finder.root
    listed = [inside(root, relative_to or file.parent, name, file) for name in names]
    present = {k: image for k, path in enumerate(listed) if (image := finder.find(path))}
    first = dict[Path, int]()
    for k, image in present.items():
        if first.setdefault(image, k) != k and once:
            raise scene_error(file, f"lists {abbreviated(names[k])} twice; list each image once")
    absent = [path for k, path in enumerate(listed) if k not in present]
    if absent and (missing == "error" or not present):
        add = "add them" if len(absent) > 1 else "correct its name or add it"
        skip = ", or leave absent images out with data.missing=skip" if present else ""
        raise scene_error(
            absent[0],
            f"no such image (looked for {', '.join(SUFFIXES)}); {len(absent)} of the {len(names)} "
            f"images in {file.name} are absent: {add}{skip}",
        )
    if absent:
        log.warning(
            "%s: %d of the %d images are absent and left out, %s the first of them",
            file,
            len(absent),
            len(names),
            absent[0].relative_to(root),
        )
    others = [
        k
        for k, image in present.items()
        if listed[k].suffix.lower() in SUFFIXES and image.suffix.lower() != listed[k].suffix.lower()
    ]
    if others:
        log.info(
            "%s: %d images have other suffixes than it lists, %s for %s",
            file,
            len(others),
            present[others[0]].name,
            listed[others[0]].name,
        )
    moved = [name for name in names if from_elsewhere(root, name)]
    if moved:
        log.info("%s: lists %s …; taken from below %s", file, moved[0], root)
    return present
