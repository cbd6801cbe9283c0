"""A scene as Lightning sees it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import repeat
from typing import Any, Literal

import torch
from lightning import LightningDataModule

from devrf.data.priors import Priors, without_priors
from devrf.scenes.scene import CaptureName, ImagesName, Scene, Views


class SceneDataModule(LightningDataModule, ABC):
    """Serves a scene to the stages.

    A training batch is the whole set of the stage's training views (its attribute ``images``:
    ``static``, ``dynamic``, both, or ``at_rest``), moved to the device once. The stage draws its
    rays from it on the device, under its own schedule: no pixel crosses from the host during
    training. A test batch is the position of one held-out image.
    """

    # The factor by which images were made smaller as they were read.
    downscale = 1
    # Whether methods get the scene's priors beside its images.
    priors: Priors = "all"
    # Whether validation views are served, too, where the scene has any.
    validation = False
    # A change of the scene that was read; None: it is served as it is.
    change: Callable[[Scene], Scene] | None = None

    def __init__(self) -> None:
        super().__init__()
        self._scene: Scene | None = None
        self._on_device: dict[tuple[ImagesName, torch.device], Views] = {}

    def __str__(self) -> str:
        """As :func:`repr`: Lightning's measures loaders, which have no lengths before a fit."""
        return repr(self)

    @abstractmethod
    def load(self) -> Scene:
        """Read or make the scene; called once, when it is first needed."""

    @property
    def scene(self) -> Scene:
        """The scene, on the host."""
        if self._scene is None:
            scene = self.load()
            scene = without_priors(scene) if self.priors == "none" else scene
            self._scene = scene if self.change is None else self.change(scene)
        return self._scene

    def provide(self, priors: Collection[str]) -> None:
        """Add priors that a method needs to the scene, if it has them.

        Args:
            priors: their names: ``forward_flow`` of the dynamic training views.
        """

    def replace(self, scene: Scene) -> None:
        """Serve ``scene`` from now on: the same images with more priors."""
        self._scene = scene
        self._on_device = {}

    def prepare_data(self) -> None:
        """Read the scene in one process of several first: it fills caches for the others."""
        _ = self.scene

    def setup(self, stage: str) -> None:
        """Read the scene, if that was not done yet."""
        _ = self.scene

    def train_dataloader(self) -> Iterable[None]:
        """The same batch without end: the training views of the stage's capture."""
        return repeat(None)

    def test_dataloader(self) -> Iterable[int]:
        """The positions of the held-out images, one at a time."""
        return range(len(self.test_views))

    def val_dataloader(self) -> Sequence[int]:
        """The positions of the validation views: the middle one first."""
        count = len(self.validation_views)
        return sorted(range(count), key=lambda index: abs(index - count // 2))

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """The training views on ``device``; the positions of a test batch pass through.

        Returns:
            :class:`Views`, or a tuple of them.
        """
        if batch is not None:
            return batch
        views = tuple(self.training_views(images, device) for images in self._stage.images)
        return views if len(views) > 1 else views[0]

    def training_views(self, images: ImagesName, device: torch.device) -> Views:
        """The training views called ``images`` on ``device``, moved there at the first call."""
        key = (images, device)
        if key not in self._on_device:
            needed = set(self._stage.images) if self.trainer is not None else {images}
            self._on_device = {k: v for k, v in self._on_device.items() if k[0] in needed}
            self._on_device[key] = self.scene.training_views(images).to(device)
        return self._on_device[key]

    @property
    def scored_capture(self) -> CaptureName:
        """The capture whose held-out views measure what the stage learns."""
        capture: CaptureName | Literal["both"] = self._stage.capture
        return "dynamic" if capture == "both" else capture

    @property
    def test_views(self) -> Views:
        """The held-out views that measure what the stage learns, on the host."""
        return self.scene.capture(self.scored_capture).test

    @property
    def validation_views(self) -> Views:
        """Those of the validation split; the held-out ones where there is none."""
        views = self.scene.capture(self.scored_capture).validation
        return self.test_views if views is None else views

    @property
    def _stage(self) -> Any:
        """The stage that the trainer carries out."""
        assert self.trainer is not None
        return self.trainer.lightning_module
