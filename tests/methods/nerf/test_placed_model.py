"""What a checkpoint holds of a placed method is put back, or refused."""

from __future__ import annotations

from typing import Any

import pytest

from devrf.methods.gaussians.model import DeformableGaussians
from devrf.methods.kplanes.model import KPlanes
from devrf.methods.nerf.placed_model import PlacedModel
from devrf.methods.nerfies.model import Nerfies
from devrf.methods.nsff.model import NSFF


@pytest.mark.parametrize("method", [DeformableGaussians, KPlanes, Nerfies, NSFF])
def test_attributes_of_a_checkpoint_have_their_types(method: type[PlacedModel[Any]]) -> None:
    config = method(method.settings_class().rehearsed(0.01)).config()
    assert method.from_config(config).config() == config
    assert method.checkpointed_attributes
    for name in method.checkpointed_attributes:
        with pytest.raises(ValueError, match="validation error"):
            method.from_config({**config, name: "neither"})
