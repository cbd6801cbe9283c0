"""Frozen protocols of benchmarks (``benchmark/NAME.toml``), and which of them a run followed.

That is decided by what was scored. A protocol does not change: another one has another version.
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from devrf.data.datamodule import SceneDataModule
from devrf.data.recorded import READERS, RecordedDataModule
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

FILES = Path(__file__).with_name("benchmark")
# The layout of the embedded scenes.
EMBEDDED = "embedded"
# Largest difference of a mean colour in [0, 1]: processors round pictures differently.
SAME_COLOR = 2e-3
# Differences that a line names.
NAMED = 3
# A reader's option that is null keeps all there is.
ALL = "all"


class Facts(BaseModel):
    """What a protocol fixes of a scene; None, or a key that is not there, is left open.

    Attributes:
        data: the option of ``data=`` that reads it, or ``embedded``.
        image_size: of held-out images in pixels, the shorter side first.
        downscale: the factor by which images are made smaller.
        frames: times of the training images in motion.
        train_views: views that are learned from at one time.
        static_images: training images of the static capture.
        test_frames: held-out images in motion.
        background: what is behind the alpha masks of held-out images.
        lpips_network: that of LPIPS.
        mean_color: mean of the held-out images' channels in [0, 1]: a checksum of what they show.
        options: of the scene's reader, in ``conf/data``; ``all`` stands for null.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    data: str | None = None
    image_size: tuple[int, int] | None = None
    downscale: int | None = None
    frames: int | None = None
    train_views: int | None = None
    static_images: int | None = None
    test_frames: int | None = None
    background: Literal["white", "black"] | None = None
    lpips_network: Literal["vgg", "alex"] | None = None
    mean_color: tuple[float, ...] | None = None
    options: dict[str, str | int | bool] = {}


class Benchmark(Facts):
    """A file of ``benchmark/``: the protocol of some scenes.

    Attributes:
        version: of the protocol.
        title: the scenes, in words.
        source: where the facts are from, and which of them are this file's own.
        scenes: by name; what is fixed of one scene counts before that of all.
    """

    version: int
    title: str
    source: str
    scenes: dict[str, Facts]

    def of_scene(self, scene: str) -> Facts:
        """What is fixed of a scene."""
        facts = self.scenes[scene]
        shared = {key: getattr(self, key) for key in Facts.model_fields}
        return Facts(**(shared | facts.model_dump(exclude_unset=True)))


@cache
def benchmarks() -> dict[str, Benchmark]:
    """All protocols by name."""
    return {
        file.stem: Benchmark.model_validate(tomllib.loads(file.read_text("utf-8")))
        for file in sorted(FILES.glob("*.toml"))
    }


def followed(
    scene: Scene, datamodule: SceneDataModule, record: Mapping[str, Any], lpips_network: str
) -> str | None:
    """The protocol by which a scene was read and is scored, with its version: ``dycheck 1``.

    None if there is none; a line of the log says what differs from one that has the scene.
    ``record`` is :func:`devrf.apps.records.data_record`.
    """
    source = getattr(datamodule, "reader", None) or getattr(datamodule, "recipe", None)
    layouts = [name for name, reader in READERS.items() if type(source) is reader]
    layout = EMBEDDED if not isinstance(datamodule, RecordedDataModule) else [*layouts, ""][0]
    seen = {
        **record,
        "data": layout,
        "image_size": tuple(sorted(record["image_size"])),
        "downscale": datamodule.downscale,
        "static_images": len(scene.static.train),
        "background": "black" if scene.background == "black" else "white",
        "lpips_network": lpips_network,
        "mean_color": scene.dynamic.test.pixels.float().mean(dim=(0, 1, 2)).div(255).tolist(),
    }
    differing: dict[str, list[str]] = {}
    for name, benchmark in benchmarks().items():
        facts = benchmark.of_scene(scene.name) if scene.name in benchmark.scenes else None
        if facts is not None and facts.data == layout:
            called = f"{name} {benchmark.version}"
            differing[called] = [*_differences(facts, seen, source)]
            if not differing[called]:
                return called
    if differing:
        nearest = min(differing, key=lambda called: len(differing[called]))
        what = "; ".join(
            [*differing[nearest][:NAMED], *["others"] * (len(differing[nearest]) > NAMED)]
        )
        log.info("%s: not scored as benchmark %s is: %s", scene.name, nearest, what)
    return None


def _differences(facts: Facts, seen: Mapping[str, Any], source: object) -> Iterator[str]:
    """What was scored otherwise than a protocol says, in words."""
    stated = facts.model_dump(exclude_none=True)
    for option, value in stated.pop("options").items():
        has = getattr(source, option, None)
        if (ALL if has is None else has) != value:
            yield f"data.{option} is {has}, not {value}"
    for key, value in stated.items():
        if key == "mean_color":
            pairs = zip(seen[key], value, strict=False)
            if any(abs(here - there) > SAME_COLOR for here, there in pairs):
                yield "held-out images show something else"
        elif seen[key] != value:
            yield f"{key} is {seen[key]}, not {value}"
    if "exposure" in seen:
        yield f"data.exposure is {source.exposure}, not none"  # type: ignore[attr-defined]
