"""A stage of a protocol before it is built: its arguments, kernels, iterations and memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from warp import Kernel

from devrf.engine.needs import SIZE, StageNeeds, tensor_bytes
from devrf.engine.protocol import Protocol
from devrf.errors import expect
from devrf.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class StagePlan:
    """The class and the arguments of a stage; a stage class names its own as ``plan``.

    Attributes:
        stage: the class.
        settings: the arguments.
        protocol: the protocol that the stage is a part of.
        name: the stage's name there.
    """

    stage: Callable[..., Any]
    settings: Mapping[str, Any]
    protocol: Protocol
    name: str

    def check(self) -> None:
        """Find errors in the arguments before what the stage builds on has been learned.

        Raises:
            DevrfError: one is wrong, or the protocol asks what the stage cannot do.
        """
        own = "true, as the method's stages freeze what they build on"
        expect(self.protocol.freeze is True, "protocol.freeze", own, self.protocol.freeze)

    def build(self, **earlier: Any) -> Any:
        """The stage; with the result of the ``earlier`` one that it builds on, if on any."""
        return self.stage(**self.settings, **earlier)

    @property
    def kernels(self) -> Sequence[Kernel]:
        """Kernels that the stage launches, to be compiled before it learns."""
        return ()

    def iterations(self, scene: Scene) -> int:
        """Iterations for a scene."""
        total: int = self.settings["schedule"].total
        return total

    def needs(self, scene: Scene, earlier: StagePlan | None) -> StageNeeds:
        """Memory that the stage needs; if it does not say, that of the images.

        Args:
            scene: the scene that is learned.
            earlier: the plan of the stage that it builds on, if any.
        """
        return StageNeeds({SIZE: tensor_bytes(scene.captures.values())}, {SIZE: 0})

    def rehearsed(self) -> StagePlan:
        """The plan made to fit into seconds on a CPU.

        The schedule is scaled, so that all that happens still does; batches, grids and networks
        are smaller. All else is as it was.
        """
        return self

    def with_settings(self, **changed: Any) -> Self:
        """The plan with other arguments."""
        return replace(self, settings={**self.settings, **changed})
