"""LPIPS: torchmetrics' own put together from our trunks; and no weights."""

from __future__ import annotations

import logging
from urllib.error import URLError
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
import torch
from torchmetrics.functional.image import lpips as theirs

from devrf.errors import DevrfError
from devrf.metrics.lpips import TRUNKS, Lpips, load_lpips, read_lpips


def random_weights(network, folder):
    """A file with weights of a network, as torchvision names them, and a classifier's."""
    torch.manual_seed(3)
    state = TRUNKS[network].build().state_dict()
    stored = {f"features.{name}": value for name, value in state.items()}
    path = folder / TRUNKS[network].file
    torch.save({**stored, "classifier.0.weight": torch.zeros(2)}, path)
    return path


@pytest.fixture
def pair(rng):
    """Two images of 40×48 pixels."""
    return torch.rand(40, 48, 3, generator=rng), torch.rand(40, 48, 3, generator=rng)


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """A torch cache without any weights: its folder of checkpoints."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    checkpoints = tmp_path / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    return checkpoints


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_agrees_with_torchmetrics_on_the_same_layers(network, pair, tmp_path, monkeypatch):
    ours = read_lpips(network, random_weights(network, tmp_path))

    def features(net, pretrained=False):
        return ours.layers

    # Which layers are compared, the constants, the heads: all but the layers is theirs.
    monkeypatch.setattr(theirs, "_get_tv_model_features", features)
    net = theirs._LPIPS(net=network)
    a, b = (image.permute(2, 0, 1)[None] for image in pair)
    expected = float(net(a, b, normalize=True))
    assert expected > 1e-3
    assert ours(*pair) == pytest.approx(expected, rel=1e-4)
    assert ours(pair[0], pair[0]) == 0


def test_only_what_lies_inside_the_mask_counts(pair, tmp_path):
    lpips = read_lpips("alex", random_weights("alex", tmp_path))
    truth, other = pair
    mask = torch.zeros(40, 48, dtype=torch.bool)
    mask[8:20, 10:30] = True
    outside = torch.where(mask[..., None], truth, other)
    assert lpips(outside, truth, mask) == 0
    inside = lpips(other, truth, mask)
    assert inside is not None and inside > 0
    assert lpips(other, truth, torch.zeros_like(mask)) is None
    # Unfilled, what is wrong outside is seen by what is compared inside.
    unfilled = lpips(outside, truth, mask, fill=False)
    assert unfilled is not None and unfilled > 0
    assert lpips(other, truth, torch.ones_like(mask), fill=False) == lpips(
        other, truth, torch.ones_like(mask)
    )


def test_images_that_are_too_small_have_none(tmp_path):
    lpips = read_lpips("alex", random_weights("alex", tmp_path))
    side = TRUNKS["alex"].smallest
    enough, less = torch.rand(side, side, 3), torch.rand(side - 1, side + 9, 3)
    assert lpips(enough, enough) == 0
    assert lpips(less, less) is None
    assert lpips(less, less, torch.ones(less.shape[:2], dtype=torch.bool)) is None


def test_without_weights_one_line_says_why(empty_cache, caplog):
    with caplog.at_level(logging.INFO):
        assert load_lpips() is None
    assert len(caplog.messages) == 1
    assert "LPIPS is null" in caplog.text and str(empty_cache) in caplog.text
    assert not list(empty_cache.iterdir())
    random_weights("alex", empty_cache)
    assert isinstance(load_lpips("alex"), Lpips)


def test_a_download_that_fails_is_told_in_one_line(empty_cache, caplog, monkeypatch):
    asked = []

    def fails(url, *_):
        asked.append(url)
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", fails)
    with caplog.at_level(logging.INFO):
        assert load_lpips(download=True) is None
    assert asked == ["https://download.pytorch.org/models/vgg16-397923af.pth"]
    assert len(caplog.messages) == 1 and "no network" in caplog.text


def test_weights_that_are_given_must_fit(tmp_path):
    noise = tmp_path / "noise.pth"
    noise.write_bytes(b"not weights")
    for path in (noise, tmp_path / "no.pth", random_weights("alex", tmp_path)):
        with pytest.raises(DevrfError, match="not the weights of vgg"):
            load_lpips("vgg", path)


def test_packed_weights_are_refused(tmp_path):
    """A small file of packed zeros would fill the memory; torch itself packs nothing."""
    packed = tmp_path / "packed.pth"
    with ZipFile(random_weights("alex", tmp_path)) as whole, ZipFile(packed, "w") as archive:
        for entry in whole.infolist():
            archive.writestr(entry.filename, whole.read(entry), ZIP_DEFLATED, compresslevel=1)
    with pytest.raises(DevrfError, match="not the weights of alex"):
        load_lpips("alex", packed)
