"""What a stage of any method defines: its phases, and what each iteration draws and learns.

A schedule is a list of phases. Within a phase the same tensors are learned; between two phases
grids grow or other frames become active.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import torch
from lightning import LightningModule
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.ops.adam import GridAdam
from devrf.rendering.view import Viewable
from devrf.scenes.scene import CaptureName, ImagesName, Scene, Views


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A range of iterations in which the same tensors are learned.

    Attributes:
        kind: what is learned, in a word or two: ``search``, ``fine``, ``level 2``.
        start: first iteration.
        stop: one past the last iteration.
        frame: the frame that is learned; None where all times are learned at once.
    """

    kind: str
    start: int
    stop: int
    frame: int | None = None

    @property
    def cost(self) -> float:
        """How long an iteration takes, about, in a unit that the stage's phases share."""
        return 1.0


class LearnedModel(Viewable, Protocol):
    """What a stage learns: a :class:`~devrf.methods.base.Renderable`."""

    def config(self) -> dict[str, Any]:
        """Plain data to build it from."""
        ...

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint."""
        ...


class Learner(LightningModule, ABC):
    """What is learned in each phase, from which pixels, and with what loss.

    Attributes:
        name: what files, messages and protocols call the stage.
        capture: the part of the scene that is learned from.
        memory_keys: the config keys of what to lower when memory runs out.
        rate_keys: the config keys of what to lower when training diverges.
        cost_follows_rays: whether an iteration on fewer rays takes less time.
        scene_model: what is learned.
        optimizer: steps over everything that is learned; the same object throughout.
        phase: the phase that grids and optimiser are ready for; None before the first.
        generator: draws pixels, on the stage's device.
    """

    name: str
    capture: CaptureName | Literal["both"]
    memory_keys: tuple[str, ...] = ()
    rate_keys: ClassVar[str] = "the learning rates"
    cost_follows_rays: bool = True
    scene_model: LearnedModel
    optimizer: GridAdam
    phase: Phase | None
    generator: torch.Generator

    @property
    @abstractmethod
    def total_iterations(self) -> int:
        """Iterations of the whole schedule."""

    @property
    @abstractmethod
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the grid that is learned; empty where there is none."""

    @abstractmethod
    def phase_at(self, iteration: int) -> Phase:
        """The phase that contains ``iteration``."""

    def cost(self, first: int, last: int) -> float:
        """How long iterations ``first`` to ``last`` take, in the unit of the phases' costs."""
        cost = 0.0
        while first < last:
            phase = self.phase_at(first)
            stop = min(phase.stop, last)
            cost, first = cost + (stop - first) * phase.cost, stop
        return cost

    @abstractmethod
    def learning_rate_factor(self, iteration: int) -> float:
        """Factor of the base learning rates at ``iteration``."""

    @abstractmethod
    def enter(self, phase: Any) -> None:
        """Make grids and optimiser ready for ``phase``; ends by binding the loop to them."""

    @abstractmethod
    def draw(self) -> Pixels:
        """The pixels of the next iteration, drawn with the stage's generator."""

    @abstractmethod
    def loss(self, views: Any, pixels: Pixels) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss () of pixels of ``views``, and its terms () by name."""

    @abstractmethod
    def restore(self, phase: Any, state: dict[str, Any]) -> None:
        """Continue ``phase`` with what :meth:`phase_state` gave; the model's tensors are loaded."""

    def phase_state(self) -> dict[str, Any]:
        """State of the present phase that does not follow from schedule and model: plain data."""
        return {}

    @classmethod
    def check_settings(cls, **settings: Any) -> None:
        """Find errors in the arguments of the stage before what it builds on has been learned.

        Raises:
            DevrfError: one is wrong.
        """

    def current_model(self) -> LearnedModel:
        """The model, with everything learned so far written back to it."""
        return self.scene_model

    def prepare(self) -> None:
        """Called before each iteration; may wait for the device."""

    def converged(self, loss: Tensor) -> bool:
        """Whether the rest of the present phase can be skipped.

        Args:
            loss: () mean over the last Lightning step.
        """
        return False

    def resize_to(self, state: dict[str, Tensor]) -> None:
        """Give modules the shapes of a stored ``state`` that is about to be loaded."""

    def describe(self, iteration: int) -> str:
        """An iteration of the present phase, with its frame and resolution, for messages."""
        number = None if self.phase is None else self.phase.frame
        frame = "" if number is None else f"frame {number}"
        shape = "x".join(str(n) for n in self.resolution)
        place = ", ".join(part for part in (frame, shape) if part)
        return f"iteration {iteration} of {self.total_iterations}{place and f' ({place})'}"

    @property
    def scene(self) -> Scene:
        """The scene of the trainer's datamodule."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    def training_views(self, images: ImagesName) -> Views:
        """The training views called so, on the stage's device."""
        views: Views = self.trainer.datamodule.training_views(  # type: ignore[attr-defined]
            images, self.device
        )
        return views

    @property
    def images(self) -> tuple[ImagesName, ...]:
        """What is learned from: the training views of these names."""
        return ("static", "dynamic") if self.capture == "both" else (self.capture,)

    @property
    def scored_capture(self) -> CaptureName:
        """The capture whose held-out views measure what was learned."""
        return "dynamic" if self.capture == "both" else self.capture
