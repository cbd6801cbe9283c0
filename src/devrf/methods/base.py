"""A method that learns from rays or from images.

:class:`~devrf.methods.ray_stage.RayStage` and :class:`~devrf.methods.image_stage.ImageStage` train
it. DeVRF has stages of its own (``methods.devrf``), and is a
:class:`~devrf.rendering.renderable.Renderable` alone.
"""

from __future__ import annotations

import fnmatch
from abc import abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor, nn
from warp import Kernel

from devrf.data.batch import ImageBatch, RayBatch
from devrf.engine.needs import tensor_bytes
from devrf.engine.protocol import ProtocolStage
from devrf.errors import DevrfError
from devrf.kernels.ahead import grid_kernels
from devrf.rendering.output import RenderOutput
from devrf.rendering.renderable import Renderable
from devrf.scenes.scene import Scene, Views

Batch = TypeVar("Batch", RayBatch, ImageBatch)


class Trainable(Renderable, Generic[Batch]):
    """A method that renders a batch and computes its losses.

    Attributes:
        losses: the names of its loss terms.
        protocols: the names of the protocols that it learns by; None: every one.
        priors: data that it uses beside images and backward flow, if a scene has it:
            ``forward_flow``.
        keeps_batches: whether a budget of time leaves out iterations before it makes batches
            smaller: it cuts them only where not even a hundred iterations would fit, nor a quarter.
        random_background: whether it learns before random colours if all images have masks.
    """

    losses: ClassVar[tuple[str, ...]] = ("render",)
    protocols: ClassVar[tuple[str, ...] | None] = None
    priors: ClassVar[tuple[str, ...]] = ()
    keeps_batches: ClassVar[bool] = False
    random_background: ClassVar[bool] = False

    def check_protocol(self, protocol: str) -> None:
        """Refuse a protocol that the method cannot learn by.

        Raises:
            DevrfError: :attr:`protocols` does not name it.
        """
        if self.protocols is not None and protocol not in self.protocols:
            names = " or ".join(f"protocol={name}" for name in self.protocols)
            raise DevrfError(
                f"protocol: method={self.name} does not learn by protocol={protocol}; give {names}"
            )

    def setup(self, scene: Scene) -> None:
        """Take from a scene the method's inputs: bounds, the frames' times, priors.

        It is called once, before training; not for a model that was loaded.

        Raises:
            DevrfError: the scene lacks an input of the method.
        """

    def prepare_priors(self, views: Sequence[Views], terms: Collection[str]) -> None:
        """Look at the images whose rays will be rendered; called when a stage begins or goes on.

        Args:
            views: on the model's device; a batch numbers their images through, in this order.
            terms: the loss terms that count.
        """

    def extra_pixels(
        self, generator: torch.Generator, share: float
    ) -> tuple[Tensor, Tensor] | None:
        """Pixels that the next batch has beside those drawn from all images; None: none.

        Args:
            generator: draws them.
            share: the part of the schedule's batches that this process draws.

        Returns:
            image (K,), numbered as for :meth:`prepare_priors`, and row-major number (K,), int64.
        """
        return None

    @abstractmethod
    def forward(self, batch: Batch) -> RenderOutput:
        """Render a batch: R rays, each at its own time, or the R pixels of an image.

        It is differentiable in the parameters.
        """

    def loss_terms(
        self, output: RenderOutput, batch: Batch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """Unweighted loss terms () by name; may render again.

        ``render`` is the mean squared colour error over rays and channels.

        Args:
            output: the result of :meth:`forward`.
            batch: the rays or pixels, and the truth there.
            names: the terms that count; the others need not be computed.
        """
        return {"render": nn.functional.mse_loss(output.color, batch.color)}

    @abstractmethod
    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The parameters by the name of the part they belong to, as protocols call it."""

    def param_groups(self) -> list[dict[str, Any]]:
        """Groups for an optimiser: ``name`` and ``params`` of each part that is not frozen.

        A method may add ``rate`` to a group, a factor of the configured learning rate, and
        ``decay``, the power that the schedule's factor of it has; 0: the rate stays.
        """
        parts = {n: [p for p in group if p.requires_grad] for n, group in self.parts().items()}
        return [{"name": name, "params": free} for name, free in parts.items() if free]

    def freeze(self, parts: Sequence[str]) -> None:
        """Keep some parts as they are, and let the others learn.

        Args:
            parts: their names; ``canonical*`` is every part whose name begins so.

        Raises:
            DevrfError: the method has no such part.
        """
        parts_by_name, frozen = self.parts(), set[str]()
        for name in parts:
            matching = fnmatch.filter(parts_by_name, name)
            if not matching:
                names = ", ".join(parts_by_name)
                raise DevrfError(f"protocol: {self.name} has no part {name!r}; it has {names}")
            frozen.update(matching)
        for name, parameters in parts_by_name.items():
            for parameter in parameters:
                parameter.requires_grad_(name not in frozen)

    def begin_stage(self, stage: ProtocolStage) -> None:
        """Called when a stage of a protocol begins: keeps its frozen parts as they are."""
        self.freeze(stage.frozen)

    def rehearsed(self, factor: float) -> Trainable[Batch]:
        """The method, not set up yet, at a size for seconds on a CPU and ``factor`` times as long.

        Nothing is left out: its way of sampling and its losses are the same.
        """
        return self

    def milestones(self, total: int) -> Mapping[str, int]:
        """Iteration of each change by :meth:`on_iteration` in a stage of ``total``, by name."""
        return {}

    def on_iteration(self, step: int, total: int) -> None:
        """Called before iteration ``step`` of ``total``: for encoding windows and curricula."""

    def growths(self, total: int) -> Sequence[int]:
        """Iterations, ascending, of a stage of ``total`` at which grids grow."""
        return ()

    def grow(self, count: int) -> Mapping[str, Tensor] | None:
        """Give grids the size that they have after ``count`` growths, unless they are as large.

        A grid that grows becomes another parameter, whose optimiser begins without moments.

        Returns:
            by the names of groups of parameters (:meth:`param_groups`) whose rows have come and
            gone, the rows (M,) int64 of the old parameters that the M rows of the new ones were,
            −1 for new ones: these alone begin without moments. None: there are no such groups.
        """
        return None

    @property
    def grid_channels(self) -> Collection[int]:
        """Channels of its grids, for whose numbers kernels are compiled before it learns."""
        return ()

    @property
    def kernels(self) -> Sequence[Kernel]:
        """Kernels that it launches, which are compiled before it learns."""
        return grid_kernels(self.grid_channels)

    @property
    def sample_outputs(self) -> int:
        """Numbers that all layers give for one sample of a ray, to estimate memory by."""
        return sum(layer.out_features for layer in self.modules() if isinstance(layer, nn.Linear))

    @property
    def most_bytes(self) -> int:
        """Bytes of its parameters, of those that grow at their largest."""
        return tensor_bytes(self.parameters())

    @property
    def has_hull(self) -> bool:
        """Whether the scene's alpha masks tell which space rays need not be sampled in."""
        return False


class RayTrainable(Trainable[RayBatch]):
    """A method that renders rays, and learns from random ones of all images."""


class ImageTrainable(Trainable[ImageBatch]):
    """A method that renders whole images, and learns from one at a time."""

    @property
    def sample_outputs(self) -> int:
        """0: rays have no samples."""
        return 0
