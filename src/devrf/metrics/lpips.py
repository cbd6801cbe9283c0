"""LPIPS: distance of two images in the features of an image classifier, and its weights.

Zhang et al. 2018, version 0.1: images in [−1, 1] are shifted and scaled by fixed constants;
after five of the trunk's layers the features are normalised to unit length over channels; the
squared differences, weighted by channel (the linear heads), are averaged over the image and
summed over the five layers. The trunks are VGG16's and AlexNet's convolutional parts with
torchvision's layer numbers, built here so that torchvision need not be installed.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal
from zipfile import ZipFile, is_zipfile

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from devrf.errors import DevrfError

log = logging.getLogger(__name__)

Network = Literal["vgg", "alex"]
PUBLISHED_AT = "https://download.pytorch.org/models"

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


@dataclass(frozen=True)
class Trunk:
    """The convolutional part of a network.

    Attributes:
        layers: (channels, kernel, stride, padding) of a convolution, which a ReLU follows, or
            (kernel, stride) of a max pooling.
        taps: numbers of the layers after which features are compared.
        smallest: the least image side, in pixels, that leaves features after every tap.
        file: name of torchvision's published weights.
    """

    layers: tuple[tuple[int, ...], ...]
    taps: tuple[int, ...]
    smallest: int
    file: str

    def build(self) -> nn.Sequential:
        """The layers, with weights yet to be loaded, numbered as torchvision's."""
        channels = 3
        built = nn.Sequential()
        for layer in self.layers:
            if len(layer) == 2:
                kernel, stride = layer
                built.append(nn.MaxPool2d(kernel, stride))
            else:
                width, kernel, stride, padding = layer
                built.append(nn.Conv2d(channels, width, kernel, stride, padding))
                built.append(nn.ReLU())
                channels = width
        return built


TRUNKS = {
    "vgg": Trunk(
        layers=tuple(
            layer
            for width, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
            for layer in (*[(width, 3, 1, 1)] * depth, (2, 2))
        )[:-1],
        taps=(3, 8, 15, 22, 29),
        smallest=16,
        file="vgg16-397923af.pth",
    ),
    "alex": Trunk(
        layers=(
            (64, 11, 4, 2),
            (3, 2),
            (192, 5, 1, 2),
            (3, 2),
            (384, 3, 1, 1),
            (256, 3, 1, 1),
            (256, 3, 1, 1),
        ),
        taps=(1, 4, 7, 9, 11),
        smallest=31,
        file="alexnet-owt-7be5be79.pth",
    ),
}


class Lpips(nn.Module):
    """Perceptual distance of two images; frozen."""

    shift: Tensor
    scale: Tensor

    def __init__(
        self, trunk: Trunk, features: Mapping[str, Tensor], heads: Iterable[Tensor]
    ) -> None:
        """Put a trunk with its weights, ``0.weight``, ``0.bias``, …, and its heads together.

        Heads are weights of each channel, (1, C, 1, 1), for each tap.

        Raises:
            RuntimeError: the weights are not those of the trunk.
        """
        super().__init__()
        self.trunk = trunk
        self.layers = trunk.build()
        self.layers.load_state_dict(dict(features))
        self.heads = nn.ParameterList(head.float() for head in heads)
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None])
        self.eval().requires_grad_(False)

    def forward(
        self, prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, fill: bool = True
    ) -> float | None:
        """LPIPS of two (H, W, 3) images in [0, 1], where ``mask`` (H, W) is True if one is given.

        The prediction counts as right outside it, unless ``fill`` is False; the layers'
        differences, interpolated to the image's size, are averaged inside. None where it is empty
        or the images are too small.
        """
        if mask is not None and fill:
            prediction = torch.where(mask[..., None], prediction, truth)
        maps = self.maps(prediction, truth)
        if maps is None or (mask is not None and not bool(mask.any())):
            return None
        if mask is not None:
            full = (interpolate(layer, mask.shape, mode="bilinear")[0, 0] for layer in maps)
            maps = [layer.cpu()[mask] for layer in full]
        return float(sum(layer.mean() for layer in maps))

    @torch.no_grad()
    def maps(self, prediction: Tensor, truth: Tensor) -> list[Tensor] | None:
        """Differences (1, 1, h, w) after each tap; None for images that are too small."""
        if min(truth.shape[:2]) < self.trunk.smallest:
            return None
        features = zip(self._features(prediction), self._features(truth), strict=True)
        return [
            (head * (a - b).square()).sum(dim=1, keepdim=True)
            for head, (a, b) in zip(self.heads, features, strict=True)
        ]

    def _features(self, image: Tensor) -> list[Tensor]:
        value = image.to(self.shift).permute(2, 0, 1)
        value = ((2 * value - 1 - self.shift) / self.scale)[None]
        features = []
        for number, layer in enumerate(self.layers):
            value = layer(value)
            if number in self.trunk.taps:
                features.append(normalize(value, dim=1, eps=1e-8))
        return features


def load_lpips(
    network: Network = "vgg", weights: str | Path | None = None, download: bool = False
) -> Lpips | None:
    """The metric, or None without its weights; one logged line says why.

    The trunk has the weights of torchvision's network trained on ImageNet: from the file
    ``weights``, else from torch's cache (``torch.hub.get_dir()/checkpoints``), else downloaded
    into it (528 MB for ``vgg``, 233 MB for ``alex``). The heads come with torchmetrics.

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
        cached.parent.mkdir(parents=True, exist_ok=True)
        try:
            digest = cached.stem.rpartition("-")[2]
            torch.hub.download_url_to_file(f"{PUBLISHED_AT}/{file}", str(cached), digest, False)
        except (OSError, RuntimeError) as error:  # no network; another file than expected
            log.info("LPIPS is null: %s/%s: %s", PUBLISHED_AT, file, error)
            return None
    return read_lpips(network, cached)


def read_lpips(network: Network, path: Path) -> Lpips:
    """The metric with the trunk's weights from a file.

    Raises:
        DevrfError: it holds something else, or is not there.
    """
    shipped = files("torchmetrics.functional.image") / "lpips_models" / f"{network}.pth"
    with as_file(shipped) as weights_file:
        linear = torch.load(weights_file, map_location="cpu", weights_only=True)
    heads = [linear[f"lin{number}.model.1.weight"] for number in range(5)]
    try:
        if is_zipfile(path):
            with ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > path.stat().st_size:  # torch packs nothing, and would read it all
                raise ValueError(unpacked)
        stored = torch.load(path, map_location="cpu", weights_only=True)
        start = "features."
        features = {k.removeprefix(start): stored[k] for k in stored if k.startswith(start)}
        return Lpips(TRUNKS[network], features, heads)
    except Exception:  # a damaged file makes the unpickler raise any exception
        raise DevrfError(
            f"{path}: not the weights of {network}; expected torchvision's, with names like "
            "features.0.weight"
        ) from None
