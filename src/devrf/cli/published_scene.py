"""What ``data=lego`` sets, said where ``experiment=paper`` reads that scene by its folder alone."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from devrf.cli.complete import completed
from devrf.cli.config import choices, group_choices, overrides, reader_of
from devrf.scenes.formats import LAYOUTS

log = logging.getLogger(__name__)


def suggest_published_scene(config: DictConfig) -> None:
    """Log the published settings that a run of ``experiment=paper`` lacks for want of ``data=``.

    That is so where the scene's folder has the layout and the name of one of DeVRF's scenes.
    """
    chosen = choices()
    if not str(chosen.get("experiment")).startswith("paper") or "root" not in config.data:
        return
    root = Path(config.data.root).expanduser()
    name = root.resolve().name.lower().replace("-", "_")
    if name == chosen["data"] or name not in group_choices()["data"]:
        return
    of_devrf = [layout for layout in LAYOUTS if layout.name.startswith("DeVRF")]
    if reader_of(name) not in [layout.choice for layout in of_devrf if not layout.missing(root)]:
        return
    published = compose("config", completed(["experiment=paper", f"data={name}"]))
    typed = {text.partition("=")[0].lstrip("+") for text in overrides()}
    parts: Any = OmegaConf.to_container(OmegaConf.masked_copy(published, ["data", "schedule"]))
    if differing := ", ".join(_differing(parts, config, {*typed, "data.root", "data.name"})):
        log.info("%s: one of DeVRF's scenes; data=%s would set %s", root, name, differing)


def _differing(
    parts: Mapping[str, Any], config: DictConfig, typed: Collection[str], above: str = ""
) -> Iterator[str]:
    """``KEY=VALUE`` of each value that is another in ``config``; ``typed`` keys are left out."""
    for name, value in parts.items():
        key = f"{above}{name}"
        if isinstance(value, Mapping):
            yield from _differing(value, config, typed, f"{key}.")
        elif key not in typed and not str(value).startswith("${"):
            if OmegaConf.select(config, key) != value:
                yield f"{key}={'null' if value is None else value}"
