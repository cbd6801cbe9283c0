"""Where LPIPS gets its weights from: a file, torch's cache, or the download that fills it."""

from __future__ import annotations

import logging
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.metrics.perceptual import TRUNKS, Lpips

log = logging.getLogger(__name__)

Network = Literal["vgg", "alex"]
PUBLISHED_AT = "https://download.pytorch.org/models"


def load_lpips(
    network: Network = "vgg", weights: str | Path | None = None, download: bool = False
) -> Lpips | None:
    """The metric, or None where its weights cannot be had; one logged line says why.

    The weights of the trunk are those of torchvision's network trained on ImageNet: from
    ``weights``, else from torch's cache (``torch.hub.get_dir()/checkpoints``), else downloaded
    into it. The heads come with torchmetrics.

    Args:
        network: ``vgg`` (what papers on radiance fields report) or ``alex``.
        weights: a file with the network's weights, or with those of its ``features`` alone.
        download: whether they may be downloaded (528 MB for ``vgg``, 233 MB for ``alex``).

    Raises:
        DevrfError: ``weights`` is no file, or holds something else.
    """
    if weights is not None:
        return read_lpips(network, Path(weights))
    file = TRUNKS[network].file
    cached = Path(torch.hub.get_dir()) / "checkpoints" / file
    if not cached.is_file():
        if not download:
            log.info(
                "LPIPS is null: no weights in %s; give evaluation.lpips_weights=PATH or "
                "evaluation.download=true",
                cached,
            )
            return None
        try:
            torch.hub.load_state_dict_from_url(
                f"{PUBLISHED_AT}/{file}",
                map_location="cpu",
                progress=False,
                check_hash=True,
                weights_only=True,
            )
        except (OSError, RuntimeError) as error:  # no network; another file than expected
            log.info("LPIPS is null: %s/%s: %s", PUBLISHED_AT, file, error)
            return None
    return read_lpips(network, cached)


def read_lpips(network: Network, path: Path) -> Lpips:
    """The metric with the trunk's weights from a file.

    Raises:
        DevrfError: no such file, or it holds something else.
    """
    if not path.is_file():
        raise DevrfError(f"{path}: no such file; set evaluation.lpips_weights to {network} weights")
    heads = _heads(network)
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        features = {
            name.removeprefix("features."): value
            for name, value in stored.items()
            if name.startswith("features.")
        }
        return Lpips(TRUNKS[network], features, heads)
    except Exception:  # a damaged file makes the unpickler raise any exception
        raise DevrfError(
            f"{path}: not the weights of {network}; expected torchvision's, with names like "
            "features.0.weight"
        ) from None


def _heads(network: Network) -> list[Tensor]:
    shipped = files("torchmetrics.functional.image") / "lpips_models" / f"{network}.pth"
    with as_file(shipped) as path:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    return [stored[f"lin{number}.model.1.weight"] for number in range(5)]
