"""What every method is: a scene that can be rendered, and, of most, a module that learns from rays.

:class:`RayTrainable` methods are learned by ``methods.ray_stage``; DeVRF has stages of its own
(``methods.devrf``), and is :class:`Renderable` alone. Everything that shows a learned scene
(videos, stills, evaluation) asks for :meth:`Renderable.at`; exports also for
:meth:`Renderable.surface` and :meth:`Renderable.forward_map`, which a method may have.
"""

from __future__ import annotations

import fnmatch
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_class import StoredClass
from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.space import Space
from devrf.methods.protocol import ProtocolStage
from devrf.rendering.output import RenderOutput
from devrf.rendering.view import SurfaceField, View
from devrf.scenes.scene import Scene, Views


class Renderable(StoredClass, nn.Module, ABC):
    """A scene, learned by some method, to be rendered from any view at any time.

    Attributes:
        name: the method's name: what ``method=`` chooses, and tables say.
        box: what holds the scene, in the space of the fields.
        space: the space that the fields live in: world units, or NDC.
        depth_limits: distances along a ray before and behind which nothing is sampled, in the
            space of the fields.
    """

    name: ClassVar[str]
    box: Box
    space: Space
    depth_limits: tuple[float, float]

    @abstractmethod
    def config(self) -> dict[str, Any]:
        """Plain data from which :meth:`from_config` builds a module that takes this one's state.

        A checkpoint holds it, beside the class.
        """

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Renderable:
        """The module that :meth:`config` described, with other values in it."""
        return cls(**config)

    @abstractmethod
    def at(self, time: float, *, half: bool = False) -> View:
        """The scene at ``time`` in [0, 1], ready to be looked at from anywhere.

        Args:
            time: in [0, 1].
            half: let networks work in half precision where device and method can.
        """

    def surface(self) -> SurfaceField | None:
        """The scene at rest as a field of which a surface can be taken; None: there is none.

        Of a method that has not this and :meth:`forward_map`, nor :meth:`surface_at`, exports take
        what :meth:`at` shows.
        """
        return None

    def surface_at(self, time: float) -> SurfaceField | None:
        """The scene at ``time`` as a field of which a surface can be taken; None: there is none.

        Of a method whose surface is not carried through time by :meth:`forward_map`.
        """
        return None

    def forward_map(self, time: float) -> Callable[[Tensor], Tensor] | None:
        """q → x(q, t): where canonical points (M, 3) are at ``time``, both in the fields' space.

        The identity at time 0. None: the method knows only the way back, from x to q, or none.
        """
        return None

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    @property
    def moves(self) -> bool:
        """Whether it has learned to move: False for a rest state alone."""
        return True

    @property
    def size(self) -> int:
        """How many numbers are learned."""
        return sum(parameter.numel() for parameter in self.parameters())

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint: tensors and plain data, as small as can be."""
        return self.state_dict()

    def load_stored_state(self, state: Mapping[str, Any]) -> None:
        """Take what :meth:`stored_state` gave, or a full state.

        Raises:
            RuntimeError | KeyError | ValueError | TypeError: it does not fit.
        """
        self.load_state_dict(dict(state))


class RayTrainable(Renderable):
    """A method that renders a batch of rays and says its losses.

    Attributes:
        losses: the names of its loss terms.
        protocols: the names of the protocols that it learns by; None: every one.
        priors: what it wants of a scene beside images and backward flow, where it can be had:
            ``forward_flow``.
        keeps_batches: whether whole batches learn more in a time than more, smaller ones: a time
            budget then cuts them only where not even a hundred iterations would fit, nor a quarter.
        random_background: whether it learns before random colours where all images have masks.
    """

    losses: ClassVar[tuple[str, ...]] = ("color",)
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
            known = " or ".join(f"protocol={name}" for name in self.protocols)
            raise DevrfError(
                f"protocol: method={self.name} does not learn by protocol={protocol}; give {known}"
            )

    def setup(self, scene: Scene) -> None:
        """Take from a scene what the method needs: bounds, the frames' times, priors.

        Called once, before anything is learned; not for a model that was loaded.

        Raises:
            DevrfError: the scene lacks what the method needs.
        """

    def learn_from(self, views: Sequence[Views], terms: Collection[str]) -> None:
        """Look at the images whose rays will be rendered; called when a stage begins or goes on.

        Args:
            views: on the model's device; a batch numbers their images through, in this order.
            terms: the loss terms that count.
        """

    def further_pixels(
        self, generator: torch.Generator, share: float
    ) -> tuple[Tensor, Tensor] | None:
        """Pixels that the next batch has beside those drawn from all images; None: none.

        Args:
            generator: draws them.
            share: the part of the schedule's batches that this process draws.

        Returns:
            image (K,), numbered as for :meth:`learn_from`, and row-major number (K,), int64.
        """
        return None

    @abstractmethod
    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render a batch of R rays, each at its own time; differentiable in the parameters."""

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """Unweighted loss terms () by name; may render again.

        ``color`` is the mean squared colour error over rays and channels.

        Args:
            output: what :meth:`forward` gave.
            batch: the rays and the truth at their pixels.
            names: of the terms that count: the others need not be computed.
        """
        return {"color": nn.functional.mse_loss(output.color, batch.color)}

    @abstractmethod
    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The parameters by the name of the part they belong to, as protocols call it."""

    def param_groups(self) -> list[dict[str, Any]]:
        """Groups for an optimiser: ``name`` and ``params`` of each part that is not frozen.

        A method may add ``rate`` to a group: a factor of the configured learning rate.
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
                known = ", ".join(parts_by_name)
                raise DevrfError(f"protocol: {self.name} has no part {name!r}; it has {known}")
            frozen.update(matching)
        for name, parameters in parts_by_name.items():
            for parameter in parameters:
                parameter.requires_grad_(name not in frozen)

    def follow(self, step: ProtocolStage) -> None:
        """Called when a stage of a protocol begins: keeps its frozen parts as they are."""
        self.freeze(step.frozen)

    def rehearsed(self, factor: float) -> RayTrainable:
        """The method, not set up yet, at a size for seconds on a CPU and ``factor`` times as long.

        Nothing is left out: what it samples by, and what it says of its losses, is as it was.
        """
        return self

    def milestones(self, total: int) -> Mapping[str, int]:
        """What :meth:`on_iteration` brings about in a stage of ``total`` iterations: when each."""
        return {}

    def on_iteration(self, step: int, total: int) -> None:
        """Called before iteration ``step`` of ``total``: for encoding windows and curricula."""

    @property
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the grid that is learned; empty where there is none."""
        return ()

    def growths(self, total: int) -> Sequence[int]:
        """Iterations, ascending, of a stage of ``total`` at which grids grow."""
        return ()

    def grow(self, count: int) -> None:
        """Give grids the size that they have after ``count`` growths, unless they are as large.

        A grid that grows becomes another parameter, whose optimiser begins without moments.
        """

    @property
    def grid_channels(self) -> Collection[int]:
        """Channels of its grids, for whose numbers kernels are compiled before it learns."""
        return ()

    @property
    def sample_outputs(self) -> int:
        """How many numbers all layers give for one sample of a ray, to estimate memory by."""
        return sum(layer.out_features for layer in self.modules() if isinstance(layer, nn.Linear))

    @property
    def has_hull(self) -> bool:
        """Whether the scene's alpha masks tell which space rays need not be sampled in."""
        return False
