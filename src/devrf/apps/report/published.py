"""The paper's own rows: Tables 1 to 3 of its supplementary material, as printed."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import pandas as pd

METRICS = ["PSNR", "SSIM", "LPIPS", "GPU (GB)", "Time"]


@dataclass(frozen=True)
class Published:
    """What the paper reports.

    Attributes:
        title: of the paper.
        authors: of the paper.
        venue: where it appeared, and in which tables.
        hardware: what it was measured on.
        tables: the number of the table that holds each scene, by devrf's name of the scene.
        texts: the cells as printed, indexed by scene and label; PSNR in dB, LPIPS with VGG, time
            in minutes or hours (``8mins``, ``22.4hrs``). The column ``method`` is the paper's own
            name: ``[7]`` is one of its references, and its "Ours" is DeVRF in the label.
        values: the same cells as numbers, the time in seconds.
    """

    title: str
    authors: str
    venue: str
    hardware: str
    tables: dict[str, int]
    texts: pd.DataFrame
    values: pd.DataFrame


@cache
def published() -> Published:
    """The paper's rows, from ``published.toml``."""
    data = tomllib.loads(files(__package__).joinpath("published.toml").read_text("utf-8"))
    rows = [(scene["name"], *row) for scene in data["scenes"] for row in scene["rows"]]
    texts = pd.DataFrame(rows, columns=["scene", "method", *METRICS], dtype=object)
    label = texts["method"].str.replace(r" \[\d+\]", "", regex=True).str.replace("Ours", "DeVRF")
    texts = texts.assign(label=label).set_index(["scene", "label"])
    values = texts[METRICS].assign(Time=texts["Time"].str.extract(r"([\d.]+)")[0]).astype(float)
    values["Time"] *= texts["Time"].str.endswith("hrs").map({True: 3600.0, False: 60.0})
    tables = {scene["name"]: scene["table"] for scene in data["scenes"]}
    return Published(**data["source"], tables=tables, texts=texts, values=values)
