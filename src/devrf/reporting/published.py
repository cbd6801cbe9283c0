"""The paper's own rows: Tables 1 to 3 of its supplementary material, as printed."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

UNITS = {"mins": 60.0, "hrs": 3600.0}


@dataclass(frozen=True)
class PublishedRow:
    """A method on a scene, as the paper prints it.

    Attributes:
        method: its name there; ``[7]`` is one of the paper's references, "Ours" its authors'.
        psnr: dB.
        ssim: structural similarity.
        lpips: with VGG.
        gpu: memory in GB.
        time: of optimisation, in minutes or hours: ``8mins``, ``22.4hrs``.
    """

    method: str
    psnr: str
    ssim: str
    lpips: str
    gpu: str
    time: str

    @property
    def label(self) -> str:
        """The name for a table in which "Ours" is somebody else."""
        return re.sub(r" \[\d+\]", "", self.method).replace("Ours", "DeVRF")

    @property
    def texts(self) -> tuple[str, ...]:
        """The five cells, in the order of the table's columns."""
        return (self.psnr, self.ssim, self.lpips, self.gpu, self.time)

    @property
    def values(self) -> tuple[float, ...]:
        """The five cells as numbers, the time in seconds."""
        amount, unit = re.fullmatch(r"([\d.]+)(mins|hrs)", self.time).groups()  # type: ignore[union-attr]
        return (*map(float, self.texts[:-1]), float(amount) * UNITS[unit])


@dataclass(frozen=True)
class Published:
    """What the paper reports.

    Attributes:
        title: of the paper.
        authors: of the paper.
        venue: where it appeared, and in which tables.
        hardware: what it was measured on.
        scenes: the rows of each scene, by the name that devrf gives the scene.
        tables: the number of the table that holds each scene.
    """

    title: str
    authors: str
    venue: str
    hardware: str
    scenes: dict[str, tuple[PublishedRow, ...]]
    tables: dict[str, int]


@cache
def published() -> Published:
    """The paper's rows, from ``published.toml``."""
    data = tomllib.loads(files(__package__).joinpath("published.toml").read_text("utf-8"))
    scenes = data["scenes"]
    return Published(
        **data["source"],
        scenes={s["name"]: tuple(PublishedRow(*row) for row in s["rows"]) for s in scenes},
        tables={s["name"]: s["table"] for s in scenes},
    )
