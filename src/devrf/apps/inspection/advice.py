"""Advice on a scene, and the names of the images that it is about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from devrf.scenes.scene import Scene, Views


@dataclass(frozen=True)
class Advice:
    """A problem that lowers quality.

    Attributes:
        where: the file, the view or the part of the scene.
        what: what was found there.
        remedy: what to do.
    """

    where: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}; {self.remedy}"


def image_sets(scene: Scene) -> dict[str, Views]:
    """The sets of images by the names that a report gives them; empty ones are left out."""
    return {
        f"{name} {kind} set": views
        for name, capture in scene.captures.items()
        for kind, views in (("training", capture.train), ("test", capture.test))
        if len(views)
    }


def images_where(scene: Scene, test: Callable[[Views, int], bool]) -> list[str]:
    """Names of the images of all sets that pass a test of (views, position), each once.

    Sets may share files.
    """
    names = (
        views.names[k]
        for views in image_sets(scene).values()
        for k in range(len(views))
        if test(views, k)
    )
    return list(dict.fromkeys(names))


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first ``most`` names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
