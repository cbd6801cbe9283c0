"""Protocols: which data trains which parts of a method, as data (``conf/protocol``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from devrf.errors import DevrfError, expect

CaptureChoice = Literal["static", "dynamic", "both"]


@dataclass(frozen=True)
class ProtocolStage:
    """One stage of a protocol.

    Attributes:
        name: of the stage, its checkpoint, and ``stage=``.
        capture: the part of the scene that is learned from.
        iterations: share of the method's iterations, in (0, 1]; of ``schedule.seconds``, too.
        frozen: parts of the method that stay as they are; ``canonical*`` is every part whose name
            begins so.
        builds_on: the stage that it continues; None begins afresh.
    """

    name: str
    capture: CaptureChoice
    iterations: float = 1.0
    frozen: Sequence[str] = ()
    builds_on: str | None = None

    def __post_init__(self) -> None:
        key, captures = f"protocol.stages.{self.name}", get_args(CaptureChoice)
        expected = "static, dynamic or both"
        expect(self.capture in captures, f"{key}.capture", expected, repr(self.capture))
        holds = type(self.iterations) in (int, float) and 0 < self.iterations <= 1
        expect(holds, f"{key}.iterations", "a share above 0, at most 1", self.iterations)

    def share_of(self, iterations: int) -> int:
        """The stage's share of a method's iterations."""
        return max(1, round(iterations * self.iterations))


@dataclass(frozen=True)
class Protocol:
    """An order of stages.

    Attributes:
        name: the choice of ``protocol=``, and the word of tables.
        stages: settings of each :class:`ProtocolStage` by its name, in their order.
        static_share: share of static rays in each batch of a stage that learns from both
            captures.
        freeze: the part of the stages' ``frozen`` that holds: ``true``, all; ``false``, nothing is
            frozen; ``all``, their parts with all that enters these (of a method whose frozen part
            has inputs that an earlier stage left shut, such as HyperNeRF).
    """

    name: str
    stages: Mapping[str, Any]
    static_share: float = 0.5
    freeze: bool | Literal["all"] = True
    order: tuple[ProtocolStage, ...] = field(init=False)

    def __post_init__(self) -> None:
        share = self.static_share
        expect(0 < share < 1, "protocol.static_share", "between 0 and 1", share)
        try:
            order = tuple(
                self._frozen_as_asked(ProtocolStage(name, **settings))
                for name, settings in self.stages.items()
            )
        except TypeError as error:
            raise DevrfError(f"protocol.stages: {error}") from None
        names = [stage.name for stage in order]
        for k, stage in enumerate(order):
            holds, key = stage.builds_on in (None, *names[:k]), f"protocol.stages.{stage.name}"
            expect(holds, f"{key}.builds_on", "an earlier stage", repr(stage.builds_on))
        object.__setattr__(self, "order", order)

    def _frozen_as_asked(self, stage: ProtocolStage) -> ProtocolStage:
        if self.freeze is True:
            return stage
        return replace(stage, frozen=[f"{part}*" for part in stage.frozen] if self.freeze else ())

    def __getitem__(self, name: str) -> ProtocolStage:
        """The stage called ``name``.

        Raises:
            KeyError: there is none.
        """
        return {stage.name: stage for stage in self.order}[name]

    def time_share(self, name: str, learned: Sequence[str]) -> float:
        """The part of the method's seconds that is the stage's ``name``, of those ``learned``."""
        return self[name].iterations / sum(self[other].iterations for other in learned)
