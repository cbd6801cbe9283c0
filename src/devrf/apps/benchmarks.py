"""Frozen protocols of benchmarks (``benchmark/NAME.toml``), and which of them a run followed.

That is decided by what was scored. A protocol does not change: another one has another version.
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from devrf.data.datamodule import SceneDataModule
from devrf.data.recorded import READERS
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

FILES = Path(__file__).with_name("benchmark")
# The layout of scenes that no file has.
EMBEDDED = "embedded"
# Largest difference of a mean colour in [0, 1]: processors round pictures differently.
SAME_COLOR = 2e-3
# A reader's option that is null keeps all there is.
ALL = "all"


# What a protocol fixes of a scene; a key that is not there is left open. ``data``: the option of
# ``data=`` that reads it, or EMBEDDED; ``image_size`` of held-out images in pixels, the shorter
# side first; ``downscale``: the factor by which images are made smaller; ``frames``: times of the
# training images in motion; ``train_views`` that are learned from at one time; ``static_images``:
# training images of the static capture; ``test_frames``: held-out images in motion; ``masked``:
# whether some held-out pixels are not scored; ``background`` behind the alpha masks of held-out
# images; ``lpips_network``; ``mean_color`` of the held-out images' channels in [0, 1], a checksum
# of what they show; ``options`` of the scene's reader, in ``conf/data``, with ALL for null.
Facts = dict[str, Any]


@cache
def benchmarks() -> dict[str, dict[str, Facts]]:
    """What each protocol, by name and version (``dycheck 1``), fixes of its scenes.

    Beside ``version`` and ``scenes`` a file has what it fixes of all of them; what it fixes of one,
    in ``own``, counts before that.
    """
    found = {}
    for file in sorted(FILES.glob("*.toml")):
        shared = tomllib.loads(file.read_text("utf-8"))
        version, scenes, own = shared.pop("version"), shared.pop("scenes"), shared.pop("own", {})
        found[f"{file.stem} {version}"] = {scene: shared | own.get(scene, {}) for scene in scenes}
    return found


def followed(
    scene: Scene, datamodule: SceneDataModule, record: Mapping[str, Any], lpips_network: str
) -> str | None:
    """The protocol by which a scene was read and is scored, with its version: ``dycheck 1``.

    None if there is none; a line of the log says what differs from one that has the scene.
    ``record`` is :func:`devrf.apps.records.data_record`.
    """
    source = getattr(datamodule, "reader", None) or getattr(datamodule, "recipe", None)
    layout = next((name for name, kind in READERS.items() if type(source) is kind), EMBEDDED)
    seen = {
        **record,
        "data": layout,
        "image_size": sorted(record["image_size"]),
        "downscale": datamodule.downscale,
        "static_images": len(scene.static.train),
        "masked": scene.dynamic.test.valid_mask is not None,
        "background": "black" if scene.background == "black" else "white",
        "lpips_network": lpips_network,
        "mean_color": scene.dynamic.test.pixels,
    }
    differing: dict[str, list[str]] = {}
    for name, scenes in benchmarks().items():
        if scene.name in scenes and scenes[scene.name].get("data") == layout:
            differing[name] = [*_differences(scenes[scene.name], seen, source)]
            if not differing[name]:
                return name
    if differing:
        nearest = min(differing, key=lambda name: len(differing[name]))
        first = "; ".join(differing[nearest][:3])
        log.info("%s: not scored as benchmark %s is: %s", scene.name, nearest, first)
    return None


def _differences(facts: Facts, seen: Mapping[str, Any], source: object) -> Iterator[str]:
    """What was scored otherwise than a protocol says, in words.

    ``seen`` has pixels in place of their mean, which many real ones take too much memory for.
    """
    for option, value in facts.get("options", {}).items():
        has = getattr(source, option, None)
        if (ALL if has is None else has) != value:
            yield f"data.{option} is {has}, not {value}"
    for key, value in facts.items():
        if key == "mean_color":
            pairs = zip(seen[key].float().mean(dim=(0, 1, 2)) / 255, value, strict=False)
            if any(abs(here - there) > SAME_COLOR for here, there in pairs):
                yield "held-out images show something else"
        elif key != "options" and seen.get(key) != value:
            yield f"{key} is {seen.get(key)}, not {value}"
    if "exposure" in seen:
        yield "held-out images have an exposure of their own"
