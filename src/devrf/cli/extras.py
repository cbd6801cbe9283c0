"""Packages that only some settings need: looked for before anything is read."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig

from devrf.errors import DevrfError


def check_extras(config: DictConfig) -> None:
    """Check that what the config's settings need beyond devrf's own requirements is installed.

    Launchers and searchers of sweeps are Hydra's plugins: Hydra itself misses them.

    Raises:
        DevrfError: naming the setting and the extra to install.
    """
    if ".tensorboard." in config.logger.get("_target_", ""):
        _need("tensorboard", "logger=tensorboard", "tensorboard", "logger=csv")
    if config.stage == "view":
        _need("viser", "stage=view", "viewer", "stage=render")
    if config.viewer.get("training") is True:
        _need("viser", "viewer=true", "viewer", "viewer=false")
    # Flow that was estimated before is read from its file.
    cache = config.data.get("flow_cache")
    if config.data.get("flow") == "raft" and not (cache and Path(cache).is_file()):
        _need("torchvision", "data.flow=raft", "raft", "data.flow=dis")
    if config.stage == "export":
        _need_for_export(config.export)


def _need_for_export(settings: DictConfig) -> None:
    for package in ("skimage", "trimesh", "fast_simplification"):
        _need(package, "stage=export", "export")
    if settings.format == "usd":
        _need("pxr", "export.format=usd", "export", "export.format=gltf")


def _need(package: str, setting: str, extra: str, instead: str = "") -> None:
    if find_spec(package) is None:
        raise DevrfError(
            f'{setting}: {package} is not installed; run pip install "devrf[{extra}]"'
            + (f", or set {instead}" if instead else "")
        )
